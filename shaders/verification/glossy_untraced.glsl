// For bundles without maps to trace rays through.

vec3 lobeRadiance(vec3 position, vec3 ng, vec3 ns, vec3 wo, Gloss gloss) {
    return lobeFromIrradiance(position, ns, wo, lobeMean(ns, gloss), gloss);
}
