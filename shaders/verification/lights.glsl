// Punctual and directional lights, and their shadow maps.

layout(set = 0, binding = 12) readonly buffer Lights { vec4 lightRows[]; };  // 4 rows a light, see below
layout(set = 0, binding = 13) readonly buffer Views { mat4 views[]; };       // 2 a shadow map: local frame to reversed clip space, and back
layout(set = 0, binding = 14) uniform sampler2DArray shadows;

// Which face of a cube a direction goes through: +x, -x, +y, -y, +z, -z.
int cubeFace(vec3 d) {
    vec3 a = abs(d);
    if (a.x >= a.y && a.x >= a.z) return d.x >= 0.0 ? 0 : 1;
    if (a.y >= a.z) return d.y >= 0.0 ? 2 : 3;
    return d.z >= 0.0 ? 4 : 5;
}

// Share of light that reaches a point past the depths in one shadow map: four texels, bilinearly weighted, each compared with the depth
// that the receiver's own plane has at that texel's centre (Isidoro 2006, "Shadow Mapping: GPU-based Tips and Techniques"). A plane
// therefore does not shade itself at any slope, and what is left of a bias is rounding, in proportion to the texel's footprint.
float lit(int view, vec3 p, vec3 ng) {
    mat4 toClip = views[2 * view];
    vec3 depthRow = vec3(toClip[0].w, toClip[1].w, toClip[2].w);
    vec4 clip = toClip * vec4(p, 1.0);
    vec3 ndc = clip.xyz / clip.w;
    // The receiver's plane in clip space, and from it how its depth changes across the map.
    vec4 plane = vec4(ng, -dot(ng, p)) * views[2 * view + 1];
    vec2 slope = -plane.xy / plane.z;
    vec2 size = vec2(textureSize(shadows, 0).xy);
    vec2 at = (ndc.xy * 0.5 + 0.5) * size - 0.5;
    // Vertices are snapped to 1/256 of a texel, so a rasterised plane may be off by its slope over that; the rest is float32. A parallel
    // projection's depths are rounded relative to 1, a perspective one's relative to themselves.
    float rounding = dot(abs(slope), 2.0 / size) / 64.0 + 4e-6 * (depthRow == vec3(0.0) ? 1.0 : ndc.z);
    float reached = 0.0;
    float known = 0.0;
    for (int corner = 0; corner < 4; ++corner) {
        vec2 texel = floor(at) + vec2(corner & 1, corner >> 1);
        float stored = texelFetch(shadows, ivec3(clamp(texel, vec2(0.0), size - 1.0), view), 0).x;
        float own = ndc.z + dot(slope, (texel - at) * 2.0 / size);
        vec2 weights = 1.0 - abs(texel - at);
        float weight = weights.x * weights.y;
        // Reversed depth: greater is nearer to the light. A texel that sees past the receiver's plane lies beyond the receiver's edge and
        // knows nothing of it; to count it as lit would draw a thread of light where a dark wall meets the wall that shades it.
        reached += abs(stored - own) <= rounding ? weight : 0.0;
        known += stored >= own - rounding ? weight : 0.0;
    }
    return known > 0.0 ? reached / known : 1.0;
}

// Irradiance of one light on a plane facing it, and where it comes from. KHR_lights_punctual. Rows of a light:
// position, kind (0 directional, 1 point, 2 spot); direction of travel, range; value, first view; cone scale, cone offset, views, 0.
vec3 arriving(int light, vec3 p, out vec3 wi) {
    vec4 where = lightRows[4 * light];
    vec4 toward = lightRows[4 * light + 1];
    vec4 cone = lightRows[4 * light + 3];
    vec3 value = lightRows[4 * light + 2].xyz;
    wi = -toward.xyz;
    if (where.w == 0.0) {
        return value;
    }
    vec3 d = where.xyz - p;
    float squared = dot(d, d);
    if (squared <= 0.0) {
        return vec3(0.0);
    }
    wi = d * inversesqrt(squared);
    float ratio = squared / (toward.w * toward.w);
    float gain = max(0.0, 1.0 - ratio * ratio) / squared;
    if (where.w == 2.0) {
        float ramp = clamp(-dot(wi, toward.xyz) * cone.x + cone.y, 0.0, 1.0);
        gain *= ramp * ramp;
    }
    return value * gain;
}

// Irradiance of a light as far as it is not shaded; 0 unless some of `wi` is above the surface.
vec3 shining(int light, vec3 p, vec3 ng, out vec3 wi) {
    vec3 irradiance = arriving(light, p, wi);
    if (dot(wi, ng) <= 0.0 || irradiance == vec3(0.0)) {
        return vec3(0.0);
    }
    int view = int(lightRows[4 * light + 2].w) + (lightRows[4 * light + 3].z > 1.0 ? cubeFace(-wi) : 0);
    return irradiance * lit(view, p, ng);
}
