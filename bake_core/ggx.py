"""The GGX microfacet distribution in kernels, in a frame whose third axis is the normal.

Walter et al. 2007, "Microfacet Models for Refraction"; Smith shadowing correlated by height after Heitz 2014, "Understanding the
Masking-Shadowing Function in Microfacet-Based BRDFs". With s(c) = √(α² + (1 - α²) c²), Λ(c) = (s(c)/c - 1)/2, so that

    G₁(o)/o.z = 2 / (o.z + s(o.z))        G₂/G₁ = i.z (s(o.z) + o.z) / (s(o.z) i.z + s(i.z) o.z)

and nothing is divided by a cosine that may vanish.
"""

from __future__ import annotations

import math

from bake_core.ggx_albedo import MIN_ROUGHNESS
from bake_core.kernels import kernel


@kernel
def smith(cosine, alpha):  # type: ignore[no-untyped-def]
    """s(c) above."""
    a2 = alpha * alpha
    return math.sqrt(a2 + (1 - a2) * cosine * cosine)


@kernel
def sample_visible_normal(ox, oy, oz, alpha, u, v):  # type: ignore[no-untyped-def]
    """The direction that a normal visible from o mirrors o into; it may point below the surface.

    Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps". Pdf: :func:`reflection_pdf`.
    """
    sx, sy, sz = alpha * ox, alpha * oy, oz
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    sx, sy, sz = sx / length, sy / length, sz / length
    phi = 2 * math.pi * u
    z = (1 - v) * (1 + sz) - sz
    r = math.sqrt(max(0.0, 1 - z * z))
    hx, hy, hz = alpha * (r * math.cos(phi) + sx), alpha * (r * math.sin(phi) + sy), z + sz
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    if length <= 0:
        return -ox, -oy, oz
    hx, hy, hz = hx / length, hy / length, hz / length
    across = 2 * (ox * hx + oy * hy + oz * hz)
    return across * hx - ox, across * hy - oy, across * hz - oz


@kernel
def half_vector(ox, oy, oz, wx, wy, wz):  # type: ignore[no-untyped-def]
    """The normal that mirrors o into w, and its cosine with either; (0, 0, 0), 0 where they are opposite."""
    hx, hy, hz = ox + wx, oy + wy, oz + wz
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    if length <= 0:
        return 0.0, 0.0, 0.0, 0.0
    hx, hy, hz = hx / length, hy / length, hz / length
    return hx, hy, hz, ox * hx + oy * hy + oz * hz


@kernel
def reflection_pdf(hx, hy, hz, oz, s, alpha):  # type: ignore[no-untyped-def]
    """Per solid angle, of :func:`sample_visible_normal`, where h is the half vector and s is :func:`smith` of o: G₁ D / (4 o.z).

    D = α²/(π (h.x² + h.y² + α² h.z²)²): the usual formula without its difference of nearly equal numbers.
    """
    if hz <= 0:
        return 0.0
    a2 = alpha * alpha
    d = hx * hx + hy * hy + a2 * hz * hz
    return a2 / (math.pi * d * d) * 0.5 / (oz + s)


@kernel
def shadowing(oz, wz, s, alpha):  # type: ignore[no-untyped-def]
    """G₂/G₁, what a visible normal's reflection of o keeps: 0 where it goes below the surface. Times the pdf it is f·cosθ at F = 1."""
    if wz <= 0:
        return 0.0
    return wz * (s + oz) / (s * wz + smith(wz, alpha) * oz)


@kernel
def read_albedo(g, cosine, roughness):  # type: ignore[no-untyped-def]
    """E and B of :mod:`bake_core.ggx_albedo`, bilinear in its coordinates."""
    rows, columns = g.values.shape[0], g.values.shape[1]
    y = (roughness - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS) * (rows - 1)
    t = math.sqrt(cosine)
    x = t * (1 + roughness) / (t + roughness) * (columns - 1)
    i, j = min(max(int(y), 0), rows - 2), min(int(x), columns - 2)
    b, a = y - i, x - j
    p, q = g.values[i], g.values[i + 1]
    e = (1 - b) * ((1 - a) * p[j, 0] + a * p[j + 1, 0]) + b * ((1 - a) * q[j, 0] + a * q[j + 1, 0])
    rest = (1 - b) * ((1 - a) * p[j, 1] + a * p[j + 1, 1]) + b * ((1 - a) * q[j, 1] + a * q[j + 1, 1])
    m = 1 - cosine
    return e, rest + e * (m * m) * (m * m) * m


@kernel
def read_average(g, roughness):  # type: ignore[no-untyped-def]
    """Hemispherical averages of E and B."""
    rows = g.averages.shape[0]
    y = (roughness - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS) * (rows - 1)
    i = min(max(int(y), 0), rows - 2)
    b = y - i
    return (1 - b) * g.averages[i, 0] + b * g.averages[i + 1, 0], (1 - b) * g.averages[i, 1] + b * g.averages[i + 1, 1]
