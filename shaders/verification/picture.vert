// A triangle's corner as the camera sees it. Back faces of single-sided surfaces are left out here, a whole triangle at a time, so that
// the fragment shader need not discard.

layout(location = 0) out vec3 position;
layout(location = 1) out vec3 normal;
layout(location = 2) out vec3 color;
layout(location = 3) flat out vec3 front;
layout(location = 4) flat out int material;

void main() {
    uint vertex = indices[gl_VertexIndex];
    uint triangle = uint(gl_VertexIndex) / 3u;
    int flags = int(camera.w);
    front = normalize(obTransformNormal(gl_InstanceIndex, triangles[triangle].xyz));
    material = int(triangles[triangle].w);
    position = obTransform(gl_InstanceIndex, obPosition(vertex));
    normal = vec3(0.0);
    if ((flags & 1) != 0) {
        normal = obTransformNormal(gl_InstanceIndex, vec3(normals[3 * vertex], normals[3 * vertex + 1], normals[3 * vertex + 2]));
    }
    color = (flags & 2) != 0 ? vec3(colors[4 * vertex], colors[4 * vertex + 1], colors[4 * vertex + 2]) : vec3(1.0);
    // All three corners ask the same corner, so that they agree.
    vec3 first = obTransform(gl_InstanceIndex, obPosition(indices[3u * triangle]));
    bool seen = materials[2 * material].w > 0.0 || dot(front, camera.xyz - first) > 0.0;
    gl_Position = seen ? viewProjection * vec4(position, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}
