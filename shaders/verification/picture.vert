// A triangle's corner as the camera sees it. Back faces of single-sided surfaces are left out here, a whole triangle at a time, so that
// the fragment shader need not discard.

layout(location = 0) out vec3 position;
layout(location = 1) out vec3 normal;
layout(location = 2) out vec4 color;
layout(location = 3) flat out vec4 front;  // normal; twice the triangle's area
layout(location = 4) flat out int triangle;
layout(location = 5) out vec2 inside;

void main() {
    uint vertex = indices[gl_VertexIndex];
    triangle = gl_VertexIndex / 3;
    inside = cornerOf(gl_VertexIndex);
    color = colorOf(vertex);
    position = obTransform(gl_InstanceIndex, obPosition(vertex));
    normal = vec3(0.0);
    if ((int(camera.w) & 1) != 0) {
        normal = obTransformNormal(gl_InstanceIndex, vec3(normals[3 * vertex], normals[3 * vertex + 1], normals[3 * vertex + 2]));
    }
    // All three corners ask the same corner, so that they agree.
    vec3 first = obTransform(gl_InstanceIndex, obPosition(indices[3 * triangle]));
    vec3 second = obTransform(gl_InstanceIndex, obPosition(indices[3 * triangle + 1]));
    vec3 third = obTransform(gl_InstanceIndex, obPosition(indices[3 * triangle + 2]));
    front = vec4(normalize(obTransformNormal(gl_InstanceIndex, triangles[triangle].xyz)), length(cross(second - first, third - first)));
    bool seen = baseColorOf(int(triangles[triangle].w)).w > 0.0 || dot(front.xyz, camera.xyz - first) > 0.0;
    gl_Position = seen ? viewProjection * vec4(position, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}
