// Depth as a light sees it. Every surface casts a shadow, back faces too.

layout(location = 0) flat out int triangle;
layout(location = 1) out vec2 inside;
layout(location = 2) out float alpha;

void main() {
    uint vertex = indices[gl_VertexIndex];
    triangle = gl_VertexIndex / 3;
    inside = cornerOf(gl_VertexIndex);
    alpha = colorOf(vertex).a;
    gl_Position = viewProjection * vec4(obTransform(gl_InstanceIndex, obPosition(vertex)), 1.0);
}
