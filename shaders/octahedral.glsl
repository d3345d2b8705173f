// The octahedral map of the sphere onto a square.
// Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit Vectors", JCGT 3(2).
// Mirrors bake_core/octahedral.py.

// 1 where v >= 0, else -1. A zero of either sign counts as positive: sign() would give 0 there and fold whole half-planes onto one point.
vec2 obSigns(vec2 v) {
    return vec2(v.x >= 0.0 ? 1.0 : -1.0, v.y >= 0.0 ? 1.0 : -1.0);
}

// A direction (any length but zero) to a point of the square [-1, 1]^2. Inverse of obOctToDir.
vec2 obDirToOct(vec3 w) {
    vec2 p = w.xy / (abs(w.x) + abs(w.y) + abs(w.z));
    return w.z < 0.0 ? (1.0 - abs(p.yx)) * obSigns(p) : p;
}

// A point of the square to a unit direction. Inverse of obDirToOct.
vec3 obOctToDir(vec2 p) {
    float z = 1.0 - abs(p.x) - abs(p.y);
    return normalize(vec3(p - obSigns(p) * max(-z, 0.0), z));
}
