// One sample of the verification picture: direct light with shadow maps, indirect light from the probes, emission.

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec4 color;
layout(location = 3) flat in vec4 front;
layout(location = 4) flat in int triangle;
layout(location = 5) in vec2 inside;

layout(location = 0) out vec4 outDirect;
layout(location = 1) out vec4 outIndirect;
layout(location = 2) out vec4 outEmission;  // alpha: 1 where there is a surface

// Lambert about a shading normal, folded at the geometric surface so that it reflects its albedo exactly. Times albedo / pi.
float lambertCosine(vec3 wi, vec3 ng, vec3 ns) {
    float above = dot(wi, ng);
    vec3 mirrored = wi - 2.0 * above * ng;
    return above > 0.0 ? max(dot(wi, ns), 0.0) + max(dot(mirrored, ns), 0.0) : 0.0;
}

#ifdef HOLES
// A nested uniform scramble of this frame's number: over all frames, a surface's thresholds are one in each of so many equal steps, and
// another surface's are in another order (Laine and Karras 2011, "Stratified Sampling for Stochastic Transparency").
float threshold() {
    uint seed = hashOf(triangle);
    uint x = uint(lights.z);
    x ^= x * 0x3D20ADEAu;
    x = (x + seed) * ((seed >> 16u) | 1u);
    x ^= x * 0x05526C56u;
    x ^= x * 0x53A22864u;
    return float(bitfieldReverse(x) >> 8u) * exp2(-24.0);
}
#endif

void main() {
#ifdef HOLES
    if (threshold() >= opacityAt(triangle, inside, color.a)) discard;
#endif
    vec3 wo = normalize(camera.xyz - position);
    vec3 ng = front.xyz;
    vec3 ns = dot(normal, normal) > 0.0 ? normalize(normal) : ng;
    if (dot(ng, wo) < 0.0) {
        // The back of a double-sided surface: backs of single-sided ones never get here.
        ng = -ng;
        ns = -ns;
    }
    float width = lens.x / gl_FragCoord.w;
    float share = front.w > 0.0 ? 2.0 * width * width / (max(dot(ng, wo), 1e-3) * front.w) : 0.0;
    vec2 finish;
    vec3 base = color.rgb * reflectanceAt(triangle, inside, share, finish);
    bool glossy = finish.x > 0.0 || finish.y < 1.0;
    Gloss gloss = glossOf(base, finish.x, finish.y, wo, ns);
    vec3 direct = vec3(0.0);
    for (int light = lights.x; light < lights.y; ++light) {
        vec3 wi;
        vec3 irradiance = shining(light, position, ng, wi);
        if (irradiance != vec3(0.0)) {
            direct += irradiance * (glossy ? glossValue(gloss, wi, ng) : base / PI * lambertCosine(wi, ng, ns));
        }
    }
    vec3 indirect = (glossy ? gloss.under : base) / PI * obIrradiance(position, ns, wo);
    if (glossy) {
        indirect += gloss.specular * lobeRadiance(position, ng, ns, wo, gloss);
    }
    outDirect = vec4(direct, 1.0);
    outIndirect = vec4(indirect, 1.0);
    outEmission = vec4(emissionAt(triangle, inside, color.rgb), 1.0);
}
