// Textures and holes, looked up as bake_core/textures.py does: what differs between two pictures of a scene is then its light alone.

layout(set = 0, binding = 7) readonly buffer Coordinates { vec2 coordinates[]; };  // by triangle, corner and set
layout(set = 0, binding = 8) readonly buffer Textures { vec4 textureRows[]; };     // 4 a texture, see below
layout(set = 0, binding = 9) readonly buffer Levels { ivec4 levels[]; };           // first texel, width, height
layout(set = 0, binding = 10) uniform sampler2DArray texels;                        // one texel after another: rows, then layers

const int CLAMP = 2, REPEAT = 0;
const int OPAQUE = 0, MASK = 1;

// Rows of a texture: first level, levels, wrap along u, along v; nearest, set of coordinates, sRGB, sets in all; two rows of a transform.

float reduced(float c, int wrap) {
    if (!(abs(c) < 1e12)) return 0.0;
    if (wrap == CLAMP) return clamp(c, -1.0, 2.0);
    return wrap == REPEAT ? c - floor(c) : c - 2.0 * floor(c / 2.0);
}

// For an index from one at most two texels outside its period.
int wrapped(int i, int n, int wrap) {
    if (wrap == CLAMP) return clamp(i, 0, n - 1);
    if (wrap == REPEAT) return (i + n) % n;
    i = (i + 2 * n) % (2 * n);
    return i < n ? i : 2 * n - 1 - i;
}

vec3 srgbToLinear(vec3 c) {
    return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), greaterThan(c, vec3(0.04045)));
}

vec4 texelAt(int i, bool srgb) {
    ivec2 size = textureSize(texels, 0).xy;
    vec4 texel = texelFetch(texels, ivec3(i % size.x, i / size.x % size.y, i / size.x / size.y), 0);
    return srgb ? vec4(srgbToLinear(texel.rgb), texel.a) : texel;
}

vec4 sampleTexture(int k, vec2 at, int level) {
    vec4 how = textureRows[4 * k];
    vec4 more = textureRows[4 * k + 1];
    ivec4 where = levels[int(how.x) + level];
    ivec2 wrap = ivec2(how.zw);
    bool srgb = more.z > 0.0;
    vec2 p = vec2(reduced(at.x, wrap.x), reduced(at.y, wrap.y)) * vec2(where.yz);
    if (more.x > 0.0) {
        return texelAt(where.x + wrapped(int(floor(p.y)), where.z, wrap.y) * where.y + wrapped(int(floor(p.x)), where.y, wrap.x), srgb);
    }
    vec2 corner = floor(p - 0.5);
    vec2 share = p - 0.5 - corner;
    ivec2 columns = ivec2(wrapped(int(corner.x), where.y, wrap.x), wrapped(int(corner.x) + 1, where.y, wrap.x));
    ivec2 rows = where.x + where.y * ivec2(wrapped(int(corner.y), where.z, wrap.y), wrapped(int(corner.y) + 1, where.z, wrap.y));
    vec4 above = mix(texelAt(rows.x + columns.x, srgb), texelAt(rows.x + columns.y, srgb), share.x);
    vec4 below = mix(texelAt(rows.y + columns.x, srgb), texelAt(rows.y + columns.y, srgb), share.x);
    return mix(above, below, share.y);
}

// A corner's coordinates in a texture's own set.
vec2 coordinateOf(int k, int triangle, int corner) {
    vec4 more = textureRows[4 * k + 1];
    return coordinates[(3 * triangle + corner) * int(more.w) + int(more.y)];
}

vec2 texturePoint(int k, int triangle, vec2 inside) {
    vec2 first = coordinateOf(k, triangle, 0);
    vec2 at = (1.0 - inside.x - inside.y) * first + inside.x * coordinateOf(k, triangle, 1) + inside.y * coordinateOf(k, triangle, 2);
    return vec2(dot(textureRows[4 * k + 2].xyz, vec3(at, 1.0)), dot(textureRows[4 * k + 3].xyz, vec3(at, 1.0)));
}

// The finest level of which at most four texels fall on this share (area over area) of a triangle.
int textureLevel(int k, int triangle, float share) {
    vec4 how = textureRows[4 * k];
    vec2 e = coordinateOf(k, triangle, 1) - coordinateOf(k, triangle, 0);
    vec2 f = coordinateOf(k, triangle, 2) - coordinateOf(k, triangle, 0);
    vec2 u = textureRows[4 * k + 2].xy;
    vec2 v = textureRows[4 * k + 3].xy;
    ivec4 finest = levels[int(how.x)];
    float covered = 0.5 * abs((e.x * f.y - e.y * f.x) * (u.x * v.y - u.y * v.x)) * float(finest.y) * float(finest.z) * share;
    return covered > 1.0 ? min(int(0.5 * log2(min(covered, 1e30))), int(how.y) - 1) : 0;
}

vec4 lookUp(int k, int triangle, vec2 inside, float share) {
    return sampleTexture(k, texturePoint(k, triangle, inside), textureLevel(k, triangle, share));
}

// How much of a point is there; `alpha` is its vertices'.
float opacityAt(int triangle, vec2 inside, float alpha) {
    int material = int(triangles[triangle].w);
    ivec4 slots = texturesOf(material);
    if (slots.w == OPAQUE) return 1.0;
    vec4 finish = finishOf(material);
    float there = finish.z * alpha;
    if (slots.x >= 0) there *= sampleTexture(slots.x, texturePoint(slots.x, triangle, inside), 0).a;
    return slots.w == MASK ? float(there >= finish.w) : there;
}

// Base colour without the vertices', and metallic and roughness, averaged over a share of the triangle.
vec3 reflectanceAt(int triangle, vec2 inside, float share, out vec2 finish) {
    int material = int(triangles[triangle].w);
    ivec4 slots = texturesOf(material);
    vec3 base = baseColorOf(material).rgb;
    finish = finishOf(material).xy;
    if (slots.x >= 0) base *= lookUp(slots.x, triangle, inside, share).rgb;
    if (slots.y >= 0) finish *= lookUp(slots.y, triangle, inside, share).bg;
    return base;
}

vec3 emissionAt(int triangle, vec2 inside, vec3 color) {
    int material = int(triangles[triangle].w);
    int slot = texturesOf(material).z;
    vec4 emission = emissionOf(material);
    vec3 radiance = emission.w > 0.0 ? emission.rgb * color : emission.rgb;
    return slot >= 0 ? radiance * lookUp(slot, triangle, inside, 0.0).rgb : radiance;
}

// PCG (Jarzynski and Olano 2020, "Hash Functions for GPU Rendering").
uint scrambled(uint v) {
    v = v * 747796405u + 2891336453u;
    v = ((v >> ((v >> 28u) + 4u)) ^ v) * 277803737u;
    return (v >> 22u) ^ v;
}

// One number for this pixel of this triangle.
uint hashOf(int triangle) {
    uvec2 pixel = uvec2(gl_FragCoord.xy);
    return scrambled(scrambled(scrambled(uint(triangle)) ^ pixel.x) ^ pixel.y);
}
