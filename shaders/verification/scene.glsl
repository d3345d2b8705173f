// The scene as the verification's shaders read it. Everything is in the scene's local frame, metres.

layout(set = 0, binding = 0) readonly buffer Positions { float positions[]; };    // 3 a vertex
layout(set = 0, binding = 1) readonly buffer Normals { float normals[]; };        // 3 a vertex; zero, or none at all: shade flat
layout(set = 0, binding = 2) readonly buffer Colors { float colors[]; };          // 4 a vertex, or none
layout(set = 0, binding = 3) readonly buffer Indices { uint indices[]; };         // 3 a triangle
layout(set = 0, binding = 4) readonly buffer Triangles { vec4 triangles[]; };     // front normal in its mesh's space, material index
layout(set = 0, binding = 5) readonly buffer Instances { vec4 instances[]; };     // 3 rows of a transform
layout(set = 0, binding = 6) readonly buffer Materials { vec4 materials[]; };     // 4 a material, see below

layout(push_constant) uniform Push {
    mat4 viewProjection;
    vec4 camera;   // position, and 1 if vertices have normals, plus 2 if they have colours
    ivec4 lights;  // first light, light after the last; number of this frame, of so many
    vec4 lens;     // width of a pixel at distance 1
};

// Rows of a material.
vec4 baseColorOf(int material) { return materials[4 * material]; }          // base colour, and 1 if double-sided
vec4 emissionOf(int material) { return materials[4 * material + 1]; }       // emission, and 1 if unlit
vec4 finishOf(int material) { return materials[4 * material + 2]; }         // metallic, roughness, alpha, alpha cutoff
ivec4 texturesOf(int material) { return ivec4(materials[4 * material + 3]); }  // base colour's, metallic and roughness's, emission's (-1: none); alpha mode

vec3 obTransform(int instance, vec3 p) {
    vec4 q = vec4(p, 1.0);
    return vec3(dot(instances[3 * instance], q), dot(instances[3 * instance + 1], q), dot(instances[3 * instance + 2], q));
}

vec3 obPosition(uint vertex) {
    return vec3(positions[3 * vertex], positions[3 * vertex + 1], positions[3 * vertex + 2]);
}

vec4 colorOf(uint vertex) {
    bool has = (int(camera.w) & 2) != 0;
    return has ? vec4(colors[4 * vertex], colors[4 * vertex + 1], colors[4 * vertex + 2], colors[4 * vertex + 3]) : vec4(1.0);
}

// Where in its triangle a corner lies: the weights of the second and the third.
vec2 cornerOf(int vertexIndex) {
    int corner = vertexIndex % 3;
    return vec2(corner == 1, corner == 2);
}

// Normals follow the inverse transpose, here up to a positive factor: the cofactors, times the determinant's sign.
vec3 obTransformNormal(int instance, vec3 n) {
    vec3 a = instances[3 * instance].xyz;
    vec3 b = instances[3 * instance + 1].xyz;
    vec3 c = instances[3 * instance + 2].xyz;
    vec3 bc = cross(b, c);
    float side = dot(a, bc) < 0.0 ? -1.0 : 1.0;
    return side * vec3(dot(bc, n), dot(cross(c, a), n), dot(cross(a, b), n));
}
