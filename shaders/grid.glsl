// Where probes stand, and where their tiles lie in the atlases.
// Comes before constants.glsl, which is generated for each bundle and fills the struct below.

// One volume: a grid of probes. Lengths in metres, in the frame that constants.glsl was generated for (world unless it says otherwise).
struct ObVolume {
    vec3 origin;            // lattice point of probe (0, 0, 0)
    vec3 spacing;           // between neighbouring lattice points
    ivec3 counts;           // probes along x, y, z
    ivec2 tiles;            // columns and rows of tiles in one layer of every atlas, and of texels in one of the probe table
    int irradianceTexels;   // interior texels along the side of a tile, without its border
    int wallTexels;         // likewise, of the walls; 0: the bundle has none, every probe counts as visible
    float wallUnit;         // the length in which the walls' distances are given
    float distanceLimit;    // to which they were clamped
    float normalBias;       // how far a point is moved along its normal before visibility is asked for
    float viewBias;         // how far along the direction to the viewer
    float visibilitySoftness; // over what part of the distance a wall's shadow fades
    float visibilityFloor;  // least weight of a probe that is not visible, so that a point that no probe sees is not black
};

// What glossy light is traced through in a volume (trace.glsl); all 0 where the bundle has no such maps.
struct ObLightField {
    int distanceTexels;     // interior texels along the side of a tile
    int normalTexels;
    int radianceTexels;
    int nearestLevels;      // of the chain "nearest"
    int glossLevels;        // of the chain "gloss"
    float glossAlpha;       // alpha of GGX that the first of them is blurred with; the last has 1
    float texel;            // side of a distance texel of mean solid angle, radians
    float miss;             // distance that stands for nothing
};

// The cell around a point: its lowest probe, and how far through the cell the point is.
struct ObCell {
    ivec3 base;
    vec3 fraction;
};

// The cell of a point, the nearest one where the point is outside. An axis with one probe has fraction 0.
ObCell obCell(ObVolume volume, vec3 position) {
    vec3 last = vec3(volume.counts - 1);
    vec3 g = clamp((position - volume.origin) / volume.spacing, vec3(0.0), last);
    vec3 base = min(floor(g), max(last - 1.0, vec3(0.0)));
    return ObCell(ivec3(base), g - base);
}

// How far outside of a volume's box a point is along each axis, 0 inside. An axis with one probe reaches half a spacing to both sides.
vec3 obBeyond(ObVolume volume, vec3 position) {
    vec3 last = vec3(volume.counts - 1);
    vec3 margin = vec3(equal(volume.counts, ivec3(1))) * 0.5 * volume.spacing;
    vec3 p = position - volume.origin;
    return max(max(-margin - p, p - last * volume.spacing - margin), vec3(0.0));
}

// Flat index of probe (i, j, k): i + nx * (j + ny * k).
int obIndex(ObVolume volume, ivec3 probe) {
    return probe.x + volume.counts.x * (probe.y + volume.counts.y * probe.z);
}

// Column, row and layer of a tile, the same in every atlas; of a probe's texel in the probe table, where the index is the probe's own.
ivec3 obTile(ObVolume volume, int index) {
    int row = index / volume.tiles.x;
    int layer = row / volume.tiles.y;
    return ivec3(index - row * volume.tiles.x, row - layer * volume.tiles.y, layer);
}

// Texture coordinates (u, v, layer) of a point of the octahedral square in a tile of n x n interior texels.
// The border of one texel around a tile wraps octahedrally, so bilinear filtering is right up to its edge.
vec3 obTileCoordinates(ObVolume volume, ivec3 tile, int n, vec2 oct) {
    float side = float(n + 2);
    vec2 texel = vec2(tile.xy) * side + 1.0 + (oct * 0.5 + 0.5) * float(n);
    return vec3(texel / (vec2(volume.tiles) * side), float(tile.z));
}
