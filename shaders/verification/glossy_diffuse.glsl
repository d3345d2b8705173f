// What a glossy surface reflects of light that only irradiance maps know.

// Radiance over the lobe from irradiance on two planes, across its mean direction (Lagarde and de Rousiers 2014, "Moving Frostbite to
// Physically Based Rendering"): exact where light varies in proportion to a cosine, for then either is pi (L0 +- 2/3 L1).
vec3 lobeFromIrradiance(vec3 position, vec3 ns, vec3 wo, vec3 mean, Gloss gloss) {
    float length = 1.5 * lobeCosine(gloss);
    vec3 before = obIrradianceToward(position, ns, wo, mean);
    vec3 behind = obIrradianceToward(position, ns, wo, -mean);
    return max(0.5 * (1.0 + length) * before + 0.5 * (1.0 - length) * behind, 0.0) / PI;
}

// The lobe's mean direction; of a smooth surface the mirror's, of a rough one nearer to the normal (Lagarde and de Rousiers 2014).
vec3 lobeMean(vec3 ns, Gloss gloss) {
    float smoothness = 1.0 - gloss.roughness;
    return normalize(mix(ns, reflect(-gloss.wo, ns), smoothness * (sqrt(smoothness) + gloss.roughness)));
}
