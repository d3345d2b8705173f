// Depth as a light sees it. Every surface casts a shadow, back faces too.

void main() {
    uint vertex = indices[gl_VertexIndex];
    gl_Position = viewProjection * vec4(obTransform(gl_InstanceIndex, obPosition(vertex)), 1.0);
}
