// Glossy light from probes: rays traced through what the probes around them saw.
// McGuire, Mara, Nowrouzezahrai and Luebke 2017, "Real-Time Global Illumination using Precomputed Light Field Probes", for the march through
// octahedral distance maps; bake_core/light_field.py, which this mirrors, says what differs. Karis 2013, "Real Shading in Unreal Engine 4", and
// Lagarde and de Rousiers 2014, "Moving Frostbite to Physically Based Rendering", for radiance blurred beforehand.
// Needs octahedral.glsl, grid.glsl, constants.glsl, irradiance.glsl with its macros, and five more of the host (see README.md):
//   OB_DISTANCE(v, texel)   float, one texel, from volume v's distance atlas
//   OB_NORMAL(v, texel)     vec3, one texel, from volume v's normal atlas
//   OB_NEAREST(v, texel)    float, one texel, from volume v's chain "nearest"
//   OB_RADIANCE(v, uvw)     vec3, bilinear, from volume v's radiance atlas
//   OB_GLOSS(v, uvw)        vec3, bilinear, from volume v's chain "gloss"

const int OB_UNKNOWN = 0;
const int OB_HIT = 1;
const int OB_MISS = 2;

// Of a texel's footprint: less than this apart across a surface, two texels are on one surface, and a ray is on it rather than behind it. A map
// places a surface no better: half a texel is how far its centre lies from where else in the texel a ray may go.
const float OB_TOLERANCE = 0.5;
// Of a cell's diagonal: a ray that starts on a probe has no direction from there. Nothing but the probe itself is so near to it.
const float OB_START = 1.0 / 1048576.0;
// Of a cell's diagonal and the way behind: a probe that takes a ray less far has only rounded it otherwise, and would answer for others.
const float OB_PROGRESS = 1.0 / 4096.0;
// Where there is none before the end of the ray, which is 1.
const float OB_NEVER = 2.0;
const float OB_FAR = 3.0e38;

// What became of a ray.
struct ObTrace {
    int verdict;     // OB_HIT; OB_MISS: seen to leave for the sky; OB_UNKNOWN: no probe can tell
    float distance;  // along the ray: to the hit; how far it is known to be free where the verdict is OB_UNKNOWN; OB_FAR for a miss
    vec3 normal;     // of the surface that is hit; zero where none is
    int volume;      // who answered; who followed the ray farthest where the verdict is OB_UNKNOWN, -1: nobody could follow it at all
    ivec3 probe;     // which of its probes
    vec3 radiance;   // that arrives along the ray; from obTraceRadiance only
};

// One probe's part of it: a verdict, a distance and a normal; of a cell, a place along the ray instead of the distance.
struct ObStep {
    int verdict;
    float at;
    vec3 normal;
};

// What a probe knows of one direction: a point of a surface and the plane through it.
struct ObTexel {
    float distance;
    vec3 direction;
    vec3 normal;
    float offset;    // how high above the plane the probe stands
};

// The ray as one probe sees it, which stands at zero: (1 - s) q + s e, s from 0 to 1. The point stands (1 - s) times as far away as it says, so
// that s = 1 is the ray's own direction, and whatever is linear along the ray is linear in s.
struct ObSweep {
    vec3 q;
    vec3 e;
};

// Where it has come to at s, as the probe sees it.
vec3 obPoint(ObSweep sweep, float s) {
    return (1.0 - s) * sweep.q + s * sweep.e;
}

// Points a little outside the square, as texels of a border are, to the points that they stand for.
vec2 obWrapOct(vec2 p) {
    if (abs(p.x) > 1.0) {
        p = vec2((p.x > 0.0 ? 2.0 : -2.0) - p.x, -p.y);
    }
    return abs(p.y) > 1.0 ? vec2(-p.x, (p.y > 0.0 ? 2.0 : -2.0) - p.y) : p;
}

// Side of a tile of the chain "nearest" at one level, in blocks of 2^level cells; 1 is the finest.
int obNearestSide(int n, int level) {
    int side = (n + 2) / 2;
    for (int k = 1; k < level; ++k) {
        side = (side + 1) / 2;
    }
    return side;
}

// Where in a tile of that chain a level begins: the first stands at the left, the others one below another at its right.
ivec2 obNearestPlace(int n, int level) {
    int y = 0;
    for (int k = 2; k < level; ++k) {
        y += obNearestSide(n, k);
    }
    return level > 1 ? ivec2(obNearestSide(n, 1), y) : ivec2(0);
}

// Size of a whole tile of that chain.
ivec2 obNearestSize(ObLightField field) {
    int first = obNearestSide(field.distanceTexels, 1);
    if (field.nearestLevels == 1) {
        return ivec2(first);
    }
    ivec2 last = obNearestPlace(field.distanceTexels, field.nearestLevels);
    return ivec2(first + obNearestSide(field.distanceTexels, 2), max(first, last.y + obNearestSide(field.distanceTexels, field.nearestLevels)));
}

// The cell, between four texel centres, in which the ray's point at s lies. `q` and `e` are of the ray within one octant, where the octahedral map
// takes it to a straight line: the square's coordinates are xy / z.
ivec2 obCellOf(vec3 q, vec3 e, float s, int n) {
    vec3 p = (1.0 - s) * q + s * e;
    vec2 oct = p.z > 0.0 ? p.xy / p.z : vec2(0.0);
    return clamp(ivec2(floor((oct * 0.5 + 0.5) * float(n) + 0.5)), 0, n);
}

// A ray that comes out of the probe itself has any direction there, but none that it turns back from.
ivec2 obFirstCell(ivec2 atStart, ivec2 halfway, vec2 turn) {
    ivec2 least = min(atStart, halfway);
    ivec2 most = max(atStart, halfway);
    return ivec2(turn.x > 0.0 ? least.x : turn.x < 0.0 ? most.x : halfway.x, turn.y > 0.0 ? least.y : turn.y < 0.0 ? most.y : halfway.y);
}

// Where along the ray a coordinate of the square meets the lower edge of a cell; OB_NEVER where not before b. `turn` is which way it goes.
float obCrossing(float q, float e, float lq, float le, int edge, int n, float b, float turn) {
    float c = float(2 * edge - n - 1) / float(n);
    float atQ = q - c * lq;
    float atE = e - c * le;
    // A ratio has a pole, and meets the edge behind that, too: ask on which side it ends.
    return atQ != atE && ((1.0 - b) * atQ + b * atE) * turn > 0.0 ? atQ / (atQ - atE) : OB_NEVER;
}

// Whether the ray's point at s is nearer to the probe than a distance.
bool obNearer(ObSweep sweep, float s, float distance) {
    vec3 p = obPoint(sweep, s);
    float reach = (1.0 - s) * distance;
    return dot(p, p) < reach * reach;
}

// Texel (0, 0) is the border's.
ObTexel obTexel(int v, ObLightField field, ivec3 tile, ivec2 texel) {
    int n = field.distanceTexels;
    int m = field.normalTexels;
    ObTexel found;
    found.direction = obOctToDir(obWrapOct((2.0 * vec2(texel) - float(n) - 1.0) / float(n)));
    found.distance = OB_DISTANCE(v, ivec3(tile.xy * (n + 2) + texel, tile.z));
    // Where there are more or fewer normals: the one in whose texel the centre lies.
    ivec2 inner = (2 * texel - 1) * m / (2 * n) + 1;
    ivec2 at = ivec2(texel.x == 0 ? 0 : texel.x == n + 1 ? m + 1 : inner.x, texel.y == 0 ? 0 : texel.y == n + 1 ? m + 1 : inner.y);
    found.normal = OB_NORMAL(v, ivec3(tile.xy * (m + 2) + at, tile.z));
    found.offset = found.distance * max(-dot(found.normal, found.direction), 0.0);
    return found;
}

// How high a point, `weight` times as far away as it says, stands above a texel's plane.
float obHeight(ObTexel texel, vec3 point, float weight) {
    return dot(texel.normal, point) + texel.offset * weight;
}

// Whether four points are one surface that is hollow or flat (x), or one that bulges (y). Hollow: none of the points is behind the plane of
// another; what is solid is behind any plane. Bulging: none is before the plane of another; what is solid is behind all of them.
bvec2 obShape(float miss, float texel, ObTexel corners[4]) {
    bool hollow = true;
    bool bulging = true;
    for (int i = 0; i < 4; ++i) {
        if (corners[i].distance >= miss) {
            // Nothing is behind the sky.
            bulging = false;
            continue;
        }
        for (int j = 0; j < 4; ++j) {
            float along = dot(corners[i].normal, corners[j].direction);
            if (corners[j].distance >= miss) {
                // A point as far as can be: behind the plane, unless the plane never gets there.
                hollow = hollow && along >= 0.0;
                continue;
            }
            float slack = OB_TOLERANCE * texel * min(corners[i].distance, corners[j].distance);
            float height = corners[j].distance * along + corners[i].offset;
            hollow = hollow && height >= -slack;
            bulging = bulging && height <= slack;
        }
    }
    return bvec2(hollow, bulging);
}

// From a to b the ray is within a cell; `begins`: at a it does, else it came there through empty space.
// OB_MISS: nothing there. OB_UNKNOWN: free up to there. OB_HIT: how far along the ray, in units of the length of e.
ObStep obTraceCell(int v, ObLightField field, ivec3 tile, ivec2 cell, ObSweep sweep, float a, float b, bool begins) {
    vec3 atA = obPoint(sweep, a);
    vec3 atB = obPoint(sweep, b);
    float texel = field.texel;
    float slack = OB_TOLERANCE * texel * length(atA);
    ObTexel corners[4];
    // When the ray goes behind the first and behind the last of the four planes, and when it comes out of one again.
    float first = OB_NEVER;
    float last = -1.0;
    float outside = OB_NEVER;
    vec3 firstNormal = vec3(0.0);
    vec3 lastNormal = vec3(0.0);
    // How high above its planes the ray enters: above the one that it is farthest behind, and above the one that it is least behind.
    float lowest = OB_FAR;
    float highest = -OB_FAR;
    for (int i = 0; i < 4; ++i) {
        corners[i] = obTexel(v, field, tile, cell + ivec2(i & 1, i >> 1));
        if (corners[i].distance >= field.miss) {
            last = OB_NEVER;
            highest = OB_FAR;
            continue;
        }
        float heightA = obHeight(corners[i], atA, 1.0 - a);
        float heightB = obHeight(corners[i], atB, 1.0 - b);
        // Leaves the surface, from on it or from before it.
        float crossed = OB_NEVER;
        if (heightB < heightA) {
            crossed = a + (b - a) * heightA / (heightA - heightB);
        } else if (heightA < -slack) {
            // Comes out of what it is behind: behind from before.
            crossed = -1.0;
            outside = min(outside, heightB > heightA ? a + (b - a) * heightA / (heightA - heightB) : OB_NEVER);
        }
        if (crossed < first) {
            first = crossed;
            firstNormal = corners[i].normal;
        }
        if (crossed > last) {
            last = crossed;
            lastNormal = corners[i].normal;
        }
        lowest = min(lowest, heightA);
        highest = max(highest, heightA);
    }
    if (first > b) {
        return ObStep(OB_MISS, 0.0, vec3(0.0));
    }
    bvec2 shape = obShape(field.miss, texel, corners);
    float enters = first;
    float depth = lowest;
    vec3 normal = firstNormal;
    if (!shape.x) {
        if (!shape.y) {
            return ObStep(OB_UNKNOWN, max(first, a), vec3(0.0));
        }
        enters = last;
        depth = highest;
        normal = lastNormal;
        if (enters > b || enters > outside) {
            return ObStep(OB_MISS, 0.0, vec3(0.0));
        }
    }
    // Who comes from empty space and is a little behind the surface has just met it; who begins there may be anywhere.
    if (enters < a && (begins || depth < -slack)) {
        return ObStep(OB_UNKNOWN, a, vec3(0.0));
    }
    float at = max(enters, a);
    return ObStep(OB_HIT, at / (1.0 - at), normal);
}

// What one probe says of a ray that is free up to t0. `scale` is a length of the grid's, `fromProbe` the ray's origin as seen from the probe.
ObStep obTraceProbe(int v, ObLightField field, ivec3 tile, float scale, vec3 fromProbe, vec3 direction, float t0) {
    ObSweep sweep = ObSweep(fromProbe, direction * scale);
    int n = field.distanceTexels;
    ivec3 nearestTile = ivec3(tile.xy * obNearestSize(field), tile.z);
    bool begins = t0 <= 0.0;
    bool fresh = begins;
    float a = max(t0 / (t0 + scale), OB_START);
    int level = 0;
    // An octant at a time; there are four at most.
    for (int octant = 0; octant < 4; ++octant) {
        float b = 1.0;
        for (int axis = 0; axis < 3; ++axis) {
            float q = sweep.q[axis];
            float e = sweep.e[axis];
            if (q * e < 0.0 && q / (q - e) > a) {
                b = min(b, q / (q - e));
            }
        }
        vec3 middle = obPoint(sweep, 0.5 * (a + b));
        vec3 side = vec3(obSigns(middle.xy), middle.z >= 0.0 ? 1.0 : -1.0);
        vec2 fold = side.z > 0.0 ? vec2(0.0) : side.xy;
        vec3 lineQ = vec3(sweep.q.xy - fold * sweep.q.z, dot(side, sweep.q));
        vec3 lineE = vec3(sweep.e.xy - fold * sweep.e.z, dot(side, sweep.e));
        vec2 turn = lineE.xy * lineQ.z - lineQ.xy * lineE.z;
        ivec2 ahead = ivec2(greaterThan(turn, vec2(0.0)));
        ivec2 cell = obFirstCell(obCellOf(lineQ, lineE, a, n), obCellOf(lineQ, lineE, 0.5 * (a + b), n), turn);
        // No line crosses more than 2 (n + 1) cells, each of which is looked at on two levels at most, and the levels once.
        for (int i = 0; i < 8 * (n + 2); ++i) {
            ivec2 block = cell >> level;
            ivec2 edge = (block + ahead) << level;
            float crossU = obCrossing(lineQ.x, lineE.x, lineQ.z, lineE.z, edge.x, n, b, turn.x);
            float crossV = obCrossing(lineQ.y, lineE.y, lineQ.z, lineE.z, edge.y, n, b, turn.y);
            float end = max(min(min(crossU, crossV), b), a);
            if (level > 0) {
                float nearest = OB_NEAREST(v, nearestTile + ivec3(obNearestPlace(n, level) + block, 0));
                if (nearest < field.miss && !(obNearer(sweep, a, nearest) && obNearer(sweep, end, nearest))) {
                    --level;
                    continue;
                }
            } else {
                ObStep found = obTraceCell(v, field, tile, cell, sweep, a, end, fresh);
                if (found.verdict == OB_HIT) {
                    return ObStep(OB_HIT, found.at * scale, found.normal);
                }
                if (found.verdict == OB_UNKNOWN) {
                    // Lost where it begins, it has not come any farther.
                    return ObStep(OB_UNKNOWN, fresh && found.at <= a ? 0.0 : scale * found.at / (1.0 - found.at), vec3(0.0));
                }
            }
            fresh = false;
            if (end >= b) {
                break;
            }
            ivec2 low = block << level;
            ivec2 high = min(low + (1 << level) - 1, ivec2(n));
            a = end;
            cell = clamp(obCellOf(lineQ, lineE, a, n), low, high);
            ivec2 next = edge - 1 + ahead;
            cell = clamp(crossU <= crossV ? ivec2(next.x, cell.y) : ivec2(cell.x, next.y), ivec2(0), ivec2(n));
            level = min(level + 1, field.nearestLevels);
        }
        if (b >= 1.0) {
            break;
        }
        a = b;
    }
    return ObStep(OB_MISS, OB_FAR, vec3(0.0));
}

// What becomes of a ray: the nearest of the eight probes around it is asked first; where one has lost the ray the next takes it up, and where
// all have, the eight around the place that it has come to. Without its radiance.
//   position   in the open, or on a surface that the ray leaves; in the frame of constants.glsl
//   direction  unit
ObTrace obTrace(vec3 position, vec3 direction) {
    float t = 0.0;
    ObTrace lost = ObTrace(OB_UNKNOWN, 0.0, vec3(0.0), -1, ivec3(0), vec3(0.0));
    // A ray crosses no more cells than a volume has along its sides.
    for (int rounds = 0; rounds < OB_ROUNDS; ++rounds) {
        vec3 reached = position + t * direction;
        int v = obSelectVolume(reached);
        ObVolume volume = obVolume(v);
        ObLightField field = obLightField(v);
        ObCell cell = obCell(volume, reached);
        ivec3 nearest = ivec3(greaterThan(cell.fraction, vec3(0.5)));
        float scale = length(volume.spacing);
        float before = t;
        for (int k = 0; k < 8; ++k) {
            // By how many sides of the cell lie between a corner and the nearest one.
            int corner = (0x76534210 >> (4 * k)) & 7;
            ivec3 probe = cell.base + (nearest ^ ivec3(corner & 1, (corner >> 1) & 1, corner >> 2));
            if (any(greaterThanEqual(probe, volume.counts))) {
                continue;
            }
            vec4 entry = OB_PROBE(v, obTile(volume, obIndex(volume, probe)));
            if (entry.w == 0.0) {
                continue;
            }
            vec3 stands = volume.origin + volume.spacing * vec3(probe) + entry.xyz;
            ObStep found = obTraceProbe(v, field, obTile(volume, int(entry.w) - 1), scale, position - stands, direction, t);
            if (found.verdict != OB_UNKNOWN) {
                return ObTrace(found.verdict, found.at, found.normal, v, probe, vec3(0.0));
            }
            if (found.at > t + OB_PROGRESS * (t + scale)) {
                t = found.at;
                lost.distance = t;
                lost.volume = v;
                lost.probe = probe;
            }
        }
        // No probe of its cell takes it any farther.
        if (t <= before) {
            break;
        }
    }
    return lost;
}

// Interior texels along the side of level `level` (from 1 on) of the chain "gloss": half as many each time, 8 at least.
int obGlossTexels(int n, int level) {
    return min(n, max(8, n >> level));
}

// Radiance that a probe sees, blurred by a lobe of GGX of this alpha: the chain's levels are blurred ever twice as much, about (level 0 is not).
vec3 obBlurred(int v, ObVolume volume, ObLightField field, ivec3 tile, int level, vec2 oct) {
    int n = field.radianceTexels;
    if (level == 0) {
        return OB_RADIANCE(v, obTileCoordinates(volume, tile, n, oct));
    }
    int first = obGlossTexels(n, 1) + 2;
    ivec2 place = ivec2(0);
    ivec2 size = ivec2(first);
    for (int k = 2; k <= field.glossLevels; ++k) {
        int side = obGlossTexels(n, k) + 2;
        place = k == level ? ivec2(first, k == 2 ? 0 : size.y) : place;
        size = ivec2(first + obGlossTexels(n, 2) + 2, k == 2 ? side : size.y + side);
    }
    size.y = max(size.y, first);
    vec2 texel = vec2(tile.xy * size + place) + 1.0 + (oct * 0.5 + 0.5) * float(obGlossTexels(n, level));
    return OB_GLOSS(v, vec3(texel / vec2(volume.tiles * size), float(tile.z)));
}

// The same for any alpha, between two levels of the chain. Karis 2013 and Lagarde and de Rousiers 2014 look up levels likewise.
vec3 obRadianceOfProbe(int v, ObVolume volume, ivec3 tile, vec3 direction, float alpha) {
    ObLightField field = obLightField(v);
    float level = alpha <= field.glossAlpha
        ? alpha / field.glossAlpha
        : 1.0 + float(field.glossLevels - 1) * (1.0 - log(alpha) / log(field.glossAlpha));
    int lower = clamp(int(level), 0, field.glossLevels - 1);
    vec2 oct = obDirToOct(direction);
    vec3 sharper = obBlurred(v, volume, field, tile, lower, oct);
    float share = clamp(level - float(lower), 0.0, 1.0);
    return share == 0.0 ? sharper : mix(sharper, obBlurred(v, volume, field, tile, lower + 1, oct), share);
}

// The entry point for glossy light: radiance that arrives at a point from a direction, averaged over a lobe about it; and what the ray met.
// The same for reflected and for refracted rays.
//   position   in the open, or on a surface that the ray leaves; in the frame of constants.glsl
//   direction  unit, the way the ray goes
//   roughness  perceptual, as in glTF; alpha of GGX is its square. 0: a mirror
// Where no probe can tell (OB_UNKNOWN) the radiance is that of where the ray was lost, as who followed it there sees it; where none did, it is
// what a matt white surface at the point would show that faces the direction.
ObTrace obTraceRadiance(vec3 position, vec3 direction, float roughness) {
    ObTrace trace = obTrace(position, direction);
    if (trace.volume < 0) {
        int v = obSelectVolume(position);
        trace.radiance = obIrradianceInVolume(v, position, direction, direction, direction).xyz / 3.14159265;
        return trace;
    }
    ObVolume volume = obVolume(trace.volume);
    vec4 entry = OB_PROBE(trace.volume, obTile(volume, obIndex(volume, trace.probe)));
    vec3 seen = direction;
    float alpha = roughness * roughness;
    if (trace.verdict != OB_MISS) {
        // The lobe opens from the point; the probe sees what it covers under another angle.
        seen = position + trace.distance * direction - (volume.origin + volume.spacing * vec3(trace.probe) + entry.xyz);
        alpha *= trace.distance / max(length(seen), 1e-20);
    }
    trace.radiance = obRadianceOfProbe(trace.volume, volume, obTile(volume, int(entry.w) - 1), seen, min(alpha, 1.0));
    return trace;
}
