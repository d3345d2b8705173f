// Leaves holes in shadows; only in programs for scenes that have any.

layout(location = 0) flat in int triangle;
layout(location = 1) in vec2 inside;
layout(location = 2) in float alpha;

void main() {
    // What is blended shades texels at random: a pixel looks at many (Wyman and McGuire 2017, "Hashed Alpha Testing").
    if (float(hashOf(triangle) >> 8) * exp2(-24.0) >= opacityAt(triangle, inside, alpha)) discard;
}
