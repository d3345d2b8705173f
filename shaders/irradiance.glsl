// Diffuse light from probes: irradiance at a surface point from the eight probes around it.
// Majercik et al. 2019, "Dynamic Diffuse Global Illumination with Ray-Traced Irradiance Fields", JCGT 8(2), section 5;
// Majercik et al. 2021, "Scaling Probe-Based Real-Time Dynamic Global Illumination for Production", JCGT 10(2), for the surface bias.
// Mirrors bake_core/irradiance.py. Needs octahedral.glsl, grid.glsl, constants.glsl, and three macros of the host (see README.md):
//   OB_IRRADIANCE(v, uvw)   vec3, bilinear, from volume v's irradiance atlas
//   OB_WALLS(v, uvw)        float, bilinear, from volume v's walls atlas
//   OB_PROBE(v, texel)      vec4, one texel, from volume v's probe table

// How much a probe counts by where it stands: most in front of the surface, little behind it, never nothing (a cell may have no other).
// Majercik et al. 2019, section 5.2, the "wrap shading" weight. 0.2 is theirs: without it, cells with probes on one side only flicker.
float obFacing(vec3 toProbe, vec3 normal) {
    // The floor under the length is for a point that stands on the probe: it has no direction, and counts as seen edge-on.
    float wrap = 0.5 + 0.5 * dot(toProbe, normal) / max(length(toProbe), 1e-20);
    return wrap * wrap + 0.2;
}

// How much of a probe's surroundings lets it see a point. Its walls hold, for each direction, the inverse of how far away the nearest surface is
// by the 1-norm: linear in the octahedral square on any plane, so that the look-up between four texels places a flat wall where it is
// (bake_core/walls.py). How far behind that the point lies, as a part of the distance, fades as Chebyshev's bound does (Donnelly and Lauritzen
// 2006, "Variance Shadow Maps"), cubed against leaks as in Majercik et al. 2019, section 5.2.
float obVisibility(int v, ObVolume volume, ivec3 tile, vec3 fromProbe) {
    float r = length(fromProbe);
    if (volume.wallTexels == 0 || r == 0.0) {
        return 1.0;
    }
    float inverse = OB_WALLS(v, obTileCoordinates(volume, tile, volume.wallTexels, obDirToOct(fromProbe)));
    vec3 a = abs(fromProbe);
    float behind = inverse * (a.x + a.y + a.z) * min(1.0, volume.distanceLimit / r) / volume.wallUnit - 1.0;
    if (behind <= 0.0) {
        return 1.0;
    }
    float soft = volume.visibilitySoftness * volume.visibilitySoftness;
    float bound = soft / (soft + behind * behind);
    return max(bound * bound * bound, volume.visibilityFloor);
}

// Small weights made smaller still, without a step: light from a probe that hardly counts is mostly leaked light.
// Majercik et al. 2019, section 5.2; the threshold is theirs.
float obCrush(float weight) {
    const float threshold = 0.2;
    return weight < threshold ? weight * weight * weight / (threshold * threshold) : weight;
}

// Trilinear weight of a probe, all lengths in spacings: along each axis 1 where it stands, falling to 0 at the lattice points next to its own. Of a
// probe that has not been moved, that is linear interpolation; and where it has, weights still change without a step from cell to cell.
float obTent(vec3 fromLattice, vec3 offset) {
    vec3 fromProbe = fromLattice - offset;
    vec3 axes = max(1.0 - abs(fromProbe) / (1.0 + mix(-offset, offset, vec3(lessThan(fromProbe, vec3(0.0))))), 0.0);
    return axes.x * axes.y * axes.z;
}

// Irradiance from one volume. Probe weights are (trilinear, from the point itself: at a lattice point the answer is its probe's) times
// (facing times visibility, crushed); probes inside geometry have no tile and no weight. They are the surface's, whichever way is asked.
// w is 1, or 0 where none of the eight has a tile.
vec4 obIrradianceInVolume(int v, vec3 position, vec3 normal, vec3 wo, vec3 toward) {
    ObVolume volume = obVolume(v);
    ObCell cell = obCell(volume, position);
    vec3 biased = position + normal * volume.normalBias + wo * volume.viewBias;
    vec2 octToward = obDirToOct(toward);
    vec4 sum = vec4(0.0);
    vec4 rest = vec4(0.0);
    for (int corner = 0; corner < 8; ++corner) {
        ivec3 upper = ivec3(corner & 1, (corner >> 1) & 1, corner >> 2);
        ivec3 probe = min(cell.base + upper, volume.counts - 1);
        vec4 entry = OB_PROBE(v, obTile(volume, obIndex(volume, probe)));
        // A probe without a tile counts for nothing.
        if (entry.w == 0.0) {
            continue;
        }
        ivec3 tile = obTile(volume, int(entry.w) - 1);
        vec3 probePosition = volume.origin + volume.spacing * vec3(probe) + entry.xyz;
        float weight = obFacing(probePosition - position, normal) * obVisibility(v, volume, tile, biased - probePosition);
        weight = obCrush(weight);
        vec3 irradiance = OB_IRRADIANCE(v, obTileCoordinates(volume, tile, volume.irradianceTexels, octToward));
        sum += vec4(irradiance, 1.0) * (weight * obTent(cell.fraction - vec3(upper), entry.xyz / volume.spacing));
        rest += vec4(irradiance, 1.0) * weight;
    }
    // Nothing in the first sum: the point stands on a probe, an edge or a face of the grid all of whose probes are inside geometry.
    vec4 chosen = sum.w > 0.0 ? sum : rest;
    return chosen.w > 0.0 ? vec4(chosen.xyz / chosen.w, 1.0) : vec4(0.0);
}

// The finest volume that contains a point; the nearest one where none does.
int obSelectVolume(vec3 position) {
    int nearest = 0;
    float least = 3.4e38;
    for (int rank = 0; rank < OB_VOLUMES; ++rank) {
        int v = obFinest(rank);
        vec3 beyond = obBeyond(obVolume(v), position);
        float d = dot(beyond, beyond);
        if (d < least) {
            least = d;
            nearest = v;
        }
    }
    return nearest;
}

// The entry point for diffuse light: irradiance E (the integral of radiance times cosine over the hemisphere, no 1/pi inside) that arrives at
// a surface point, except the direct light of punctual and directional lights. Reflected radiance is albedo * E / pi.
//   position  the point, in the frame of constants.glsl
//   normal    unit shading normal, on the side that is seen
//   wo        unit, from the point to the viewer; the normal itself where there is none
//   toward    unit, the way that the plane faces on which light arrives: the normal, but for lobes that are not about it
// A volume reaches all of its box, and over half a spacing beyond it less and less. The finest one has what it reaches, and leaves the rest to the
// next: a fine volume inside a coarse one fades into it, and neighbours fade into each other. What none reaches, the nearest has. One whose probes
// about the point are all inside geometry has no answer, and leaves all of it to the next.
vec3 obIrradianceToward(vec3 position, vec3 normal, vec3 wo, vec3 toward) {
    int nearest = obSelectVolume(position);
    vec4 sum = vec4(0.0);
    float rest = 1.0;
    for (int rank = 0; rank < OB_VOLUMES; ++rank) {
        int v = obFinest(rank);
        ObVolume volume = obVolume(v);
        vec3 beyond = obBeyond(volume, position) / (0.5 * volume.spacing);
        // So little for the nearest counts only where it is alone.
        float reach = max(1.0 - min(max(beyond.x, max(beyond.y, beyond.z)), 1.0), v == nearest ? 1e-20 : 0.0);
        if (reach > 0.0) {
            vec4 found = obIrradianceInVolume(v, position, normal, wo, toward);
            sum += rest * reach * found;
            rest *= 1.0 - reach * found.w;
        }
        if (rest == 0.0) {
            break;
        }
    }
    return sum.w > 0.0 ? sum.xyz / sum.w : vec3(0.0);
}

vec3 obIrradiance(vec3 position, vec3 normal, vec3 wo) {
    return obIrradianceToward(position, normal, wo, normal);
}
