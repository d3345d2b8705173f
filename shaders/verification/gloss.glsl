// GGX as bake_core/materials.py has it, energy that it gives back included: see there for the formulas and where they come from.

layout(set = 0, binding = 11) readonly buffer Albedo { vec2 albedoTable[]; };  // bake_core/ggx_albedo.py: 64 rows of 64, then 64 averages

const float PI = 3.14159265358979;
const float DIELECTRIC = 0.04;
const float MIN_ROUGHNESS = 0.01;
const int SIDE = 64;

struct Gloss {
    vec3 normal;
    vec3 wo;
    float alpha;
    float roughness;
    vec3 c0;
    vec3 c1;
    vec3 diffuse;   // of f, without what depends on wi
    vec3 under;     // all that the diffuse part reflects
    vec3 specular;  // all that the rest reflects
};

float rowOf(float roughness) {
    return (roughness - MIN_ROUGHNESS) / (1.0 - MIN_ROUGHNESS) * float(SIDE - 1);
}

// E and B.
vec2 readAlbedo(float cosine, float roughness) {
    float y = rowOf(roughness);
    float t = sqrt(cosine);
    float x = t * (1.0 + roughness) / (t + roughness) * float(SIDE - 1);
    int i = clamp(int(y), 0, SIDE - 2);
    int j = clamp(int(x), 0, SIDE - 2);
    vec2 above = mix(albedoTable[SIDE * i + j], albedoTable[SIDE * i + j + 1], x - float(j));
    vec2 below = mix(albedoTable[SIDE * (i + 1) + j], albedoTable[SIDE * (i + 1) + j + 1], x - float(j));
    vec2 e = mix(above, below, y - float(i));
    return vec2(e.x, e.y + e.x * pow(1.0 - cosine, 5.0));
}

vec2 readAverage(float roughness) {
    float y = rowOf(roughness);
    int i = clamp(int(y), 0, SIDE - 2);
    return mix(albedoTable[SIDE * SIDE + i], albedoTable[SIDE * SIDE + i + 1], y - float(i));
}

float smith(float cosine, float alpha) {
    float a2 = alpha * alpha;
    return sqrt(a2 + (1.0 - a2) * cosine * cosine);
}

Gloss glossOf(vec3 base, float metallic, float roughness, vec3 wo, vec3 normal) {
    Gloss g;
    g.roughness = max(roughness, MIN_ROUGHNESS);
    g.alpha = g.roughness * g.roughness;
    // A viewer behind the shading normal is mirrored to its front.
    float oz = min(abs(dot(wo, normal)), 1.0);
    g.normal = normal;
    g.wo = wo + (oz - dot(wo, normal)) * normal;
    vec2 e = readAlbedo(oz, g.roughness);
    vec2 average = readAverage(g.roughness);
    vec3 f0 = min(base, vec3(1.0));
    float outside = DIELECTRIC * e.x + (1.0 - DIELECTRIC) * e.y;
    float outsideAverage = DIELECTRIC * average.x + (1.0 - DIELECTRIC) * average.y;
    vec3 mean = f0 + (1.0 - f0) / 21.0;
    vec3 scale = 1.0 + (1.0 - e.x) / e.x * mean * average.x / (1.0 - mean * (1.0 - average.x));
    g.c0 = (1.0 - metallic) * DIELECTRIC + metallic * scale * f0;
    g.c1 = (1.0 - metallic) * (1.0 - DIELECTRIC) + metallic * scale * (1.0 - f0);
    g.diffuse = (1.0 - metallic) / PI * (1.0 - outside) / (1.0 - outsideAverage) * f0;
    g.under = (1.0 - metallic) * (1.0 - outside) * f0;
    g.specular = g.c0 * e.x + g.c1 * e.y;
    return g;
}

// f cos, of a surface that has only its shading normal.
vec3 unfolded(Gloss g, vec3 wi) {
    float iz = dot(wi, g.normal);
    float oz = dot(g.wo, g.normal);
    if (iz <= 0.0) return vec3(0.0);
    vec3 h = normalize(g.wo + wi);
    float hz = dot(h, g.normal);
    vec3 aside = h - hz * g.normal;
    float a2 = g.alpha * g.alpha;
    float d = dot(aside, aside) + a2 * hz * hz;
    float s = smith(oz, g.alpha);
    float reflected = a2 / (PI * d * d) * 0.5 / (oz + s) * iz * (s + oz) / (s * iz + smith(iz, g.alpha) * oz);
    vec2 e = readAlbedo(min(iz, 1.0), g.roughness);
    float inside = iz * (1.0 - (DIELECTRIC * e.x + (1.0 - DIELECTRIC) * e.y));
    return (g.c0 + g.c1 * pow(max(1.0 - dot(g.wo, h), 0.0), 5.0)) * reflected + g.diffuse * inside;
}

// f cos, folded at the geometric surface.
vec3 glossValue(Gloss g, vec3 wi, vec3 ng) {
    float above = dot(wi, ng);
    return above > 0.0 ? unfolded(g, wi) + unfolded(g, wi - 2.0 * above * ng) : vec3(0.0);
}

// Mean cosine of a lobe about its mean direction, as far as light that varies slowly can tell lobes apart. At roughness 1 GGX is symmetric
// about the normal: f cos is iz / (oz + iz), up to a factor. A mirror's is 1. Between the two by alpha.
float lobeCosine(Gloss g) {
    float c = max(dot(g.wo, g.normal), 1e-4);
    float l = log((1.0 + c) / c);
    return mix(1.0, (0.5 - c + c * c * l) / (1.0 - c * l), g.alpha);
}
