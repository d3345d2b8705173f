// For bundles with maps to trace rays through: the split sum of Karis 2013, "Real Shading in Unreal Engine 4", its one factor the light along a
// ray, blurred as the lobe is wide; the other, what the surface reflects of even light, is the caller's.

vec3 lobeRadiance(vec3 position, vec3 ng, vec3 ns, vec3 wo, Gloss gloss) {
    vec3 mean = lobeMean(ns, gloss);
    float above = dot(mean, ng);
    // A shading normal may mirror into the surface; light that comes from there is folded at it, as the surface's own is.
    vec3 traced = obTraceRadiance(position, above < 0.0 ? mean - 2.0 * above * ng : mean, gloss.roughness).radiance;
    // One ray stands for the lobe the worse the wider it is; what knows the whole hemisphere takes over as it widens.
    return mix(traced, lobeFromIrradiance(position, ns, wo, mean, gloss), gloss.alpha);
}
