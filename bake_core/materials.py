"""Materials as the kernels see them: what they reflect, and how a direction is drawn from it.

Metallic 0 with roughness 1 is exactly Lambert. All else is glTF's mix of a dielectric (reflectance 0.04 at normal incidence, diffuse
beneath) and a metal, both GGX: a material of metallic 0 and roughness just below 1 is a dielectric with a rough gloss, not nearly Lambert.

Either is taken about the shading normal ns, and folded at the geometric surface ng so that it loses nothing there: with g(w) what the
surface would reflect if ns were its only normal,

    f(wi) cosθ = g(wi) + g(mirror(wi))   for wi above the surface,   mirror(wi) = wi - 2 (wi·ng) ng

Directions that sampling about ns puts below the surface come back mirrored, and the second term is their density. (Without it,
interpolated normals darken a Lambert furnace by (1 - cos δ)/2 for an angle δ between the two.) A wo that is behind ns is mirrored there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.ggx import half_vector, read_albedo, read_average, reflection_pdf, sample_visible_normal, shadowing, smith
from bake_core.ggx_albedo import MIN_ROUGHNESS, AlbedoTable, albedo_table
from bake_core.kernels import either, kernel
from bake_core.sampling import basis, cosine_hemisphere
from bake_core.scene import Scene

INV_PI = 1 / math.pi
# Schlick's F₀ of a dielectric in glTF: an index of refraction of 1.5.
_DIELECTRIC = 0.04
_BLACK = (0.0, 0.0, 0.0)


class MaterialTable(NamedTuple):
    """Columns by material index: albedo (m, 3), metallic (m,), roughness (m,), emission (m, 3) float32, double_sided (m,) bool."""

    albedo: NDArray[np.float32]
    metallic: NDArray[np.float32]
    roughness: NDArray[np.float32]
    emission: NDArray[np.float32]
    double_sided: NDArray[np.bool_]


def material_table(scene: Scene) -> MaterialTable:
    """The kernels' view of a scene's materials."""
    m = scene.materials
    return MaterialTable(
        albedo=np.ascontiguousarray(m.base_color),
        metallic=np.ascontiguousarray(m.metallic),
        roughness=np.ascontiguousarray(m.roughness),
        emission=np.ascontiguousarray(m.emission),
        double_sided=np.ascontiguousarray(m.double_sided),
    )


def gloss_table(scene: Scene) -> AlbedoTable | None:
    """What gives back the energy that one bounce off a rough surface loses; None where all that is in use is exactly Lambert."""
    return None if scene.materials.lambert[np.unique(scene.triangle_material)].all() else albedo_table()


@kernel
def lambert_cosine(wx, wy, wz, n):  # type: ignore[no-untyped-def]
    """(wi·ns)+ + (mirror(wi)·ns)+ for wi above the surface, else 0; over π it is the pdf of :func:`sample_lambert`.

    `n` is (ng, ns) as six numbers, both on the side of wo.
    """
    above = wx * n[0] + wy * n[1] + wz * n[2]
    if above <= 0:
        return 0.0
    direct = wx * n[3] + wy * n[4] + wz * n[5]
    mirrored = direct - 2 * above * (n[0] * n[3] + n[1] * n[4] + n[2] * n[5])
    return max(direct, 0.0) + max(mirrored, 0.0)


@kernel
def sample_lambert(u, v, n):  # type: ignore[no-untyped-def]
    """A direction with pdf :func:`lambert_cosine` / π; `n` as there."""
    lx, ly, lz = cosine_hemisphere(u, v)
    tx, ty, tz, bx, by, bz = basis(n[3], n[4], n[5])
    return _above(lx * tx + ly * bx + lz * n[3], lx * ty + ly * by + lz * n[4], lx * tz + ly * bz + lz * n[5], n)


@kernel
def _above(wx, wy, wz, n):  # type: ignore[no-untyped-def]
    """A direction, mirrored at the geometric surface where it is below."""
    above = wx * n[0] + wy * n[1] + wz * n[2]
    if above < 0:
        wx -= 2 * above * n[0]
        wy -= 2 * above * n[1]
        wz -= 2 * above * n[2]
    return wx, wy, wz


@kernel
def _gloss(t, base, metallic, roughness, dx, dy, dz, n):  # type: ignore[no-untyped-def]
    """A glossy surface as one ray sees it: all of its reflection that does not depend on wi.

    The specular part is (c₀ + c₁ (1 - wo·h)⁵) D G / (4 cosθo cosθi): dielectric and metal have one distribution, and differ in Fresnel's
    factor only (Schlick 1994, "An Inexpensive BRDF Model for Physically-based Rendering").

    Metal: scaled by 1 + (1 - E)/E · Favg Eavg / (1 - Favg (1 - Eavg)): what does not leave at the first bounce, (1 - E)/E of what does,
    meets the surface again, is reflected by Favg and leaves by Eavg, or meets it again, and so on: 1/E where Favg is 1. The series is
    that of Kulla and Conty 2017, "Revisiting Physically Based Shading at Imageworks"; to give it the shape of the first bounce, with no
    lobe of its own to sample, is Turquin's idea (2019, "Practical Multiple Scattering Compensation for Microfacet Models").

    Dielectric: what the first bounce off its surface does not reflect, 1 - Es, comes out of the diffuse base:
    base/π · (1 - Es(o)) (1 - Es(i)) / (1 - Es,avg), which is reciprocal and reflects base · (1 - Es(o)) in all (Kelemen and Szirmay-Kalos
    2001, "A Microfacet Based Coupled Specular-Matte BRDF Model with Importance Sampling").

    Parameters
    ----------
    t : bake_core.tracer.Tables
    base : 3 float64
        Taken as 1 where above: more than all of the light has no series.
    dx, dy, dz : float
        The ray that comes.
    n : 6 float64
        Geometric and shading normal, both on the side of wo.

    Returns
    -------
    (6, 3, 1, 1, 1, 3, 3, 3, 1) float64
        Tangents, wo in their frame, its :func:`smith`, alpha, roughness, c₀, c₁, the diffuse factor without (1 - Es(i)), and the chance to
        sample visible normals.
    """
    g = t.gloss
    roughness = max(roughness, MIN_ROUGHNESS)
    alpha = roughness * roughness
    tx, ty, tz, bx, by, bz = basis(n[3], n[4], n[5])
    ox, oy = -(dx * tx + dy * ty + dz * tz), -(dx * bx + dy * by + dz * bz)
    oz = abs(dx * n[3] + dy * n[4] + dz * n[5])
    e, b = read_albedo(g, oz, roughness)
    e_avg, b_avg = read_average(g, roughness)
    plain = 1 - metallic
    lost = (1 - e) / e
    outside = _DIELECTRIC * e + (1 - _DIELECTRIC) * b
    inside = plain * INV_PI * (1 - outside) / (1 - (_DIELECTRIC * e_avg + (1 - _DIELECTRIC) * b_avg))
    red, green, blue = min(base[0], 1.0), min(base[1], 1.0), min(base[2], 1.0)
    r0, r1 = _metal(red, lost, e_avg)
    g0, g1 = _metal(green, lost, e_avg)
    b0, b1 = _metal(blue, lost, e_avg)
    # Single scattering alone: what the sampling of visible normals knows of.
    f0 = red + green + blue
    first = plain * 3 * outside + metallic * (f0 * e + (3 - f0) * b)
    flat, edge = plain * _DIELECTRIC, plain * (1 - _DIELECTRIC)
    c0 = (flat + metallic * r0, flat + metallic * g0, flat + metallic * b0)
    c1 = (edge + metallic * r1, edge + metallic * g1, edge + metallic * b1)
    specular = (c0[0] + c0[1] + c0[2]) * e + (c1[0] + c1[1] + c1[2]) * b
    diffuse = plain * (1 - outside) * (red + green + blue)
    # What leaves after more bounces is spread like a matt surface's light, and so is sampled as that. By visible normals alone a white
    # metal of roughness 1 loses 2 of 3 directions below its horizon, weighs the others by 3, and a path of ten bounces by 3^10.
    chance = first / (specular + diffuse) if specular > 0 else 0.0
    return (
        (tx, ty, tz, bx, by, bz),
        (ox, oy, oz),
        smith(oz, alpha),
        alpha,
        roughness,
        c0,
        c1,
        (inside * red, inside * green, inside * blue),
        chance,
    )


@kernel
def _metal(f0, lost, e_avg):  # type: ignore[no-untyped-def]
    """c₀ and c₁ of a metal in one channel."""
    # Favg = 2 ∫ F cosθ dcosθ.
    f_avg = f0 + (1 - f0) / 21
    scale = 1 + lost * f_avg * e_avg / (1 - f_avg * (1 - e_avg))
    return scale * f0, scale * (1 - f0)


@kernel
def _unfolded(g, look, wx, wy, wz):  # type: ignore[no-untyped-def]
    """f·cosθ and pdf of a direction in the shading frame, above or below it."""
    _, o, s, alpha, roughness, c0, c1, inside, chance = look
    hx, hy, hz, across = half_vector(o[0], o[1], o[2], wx, wy, wz)
    pdf = reflection_pdf(hx, hy, hz, o[2], s, alpha)
    if wz <= 0:
        return 0.0, 0.0, 0.0, chance * pdf
    reflected = pdf * shadowing(o[2], wz, s, alpha)
    m = max(1 - across, 0.0)
    k = (m * m) * (m * m) * m
    diffuse = 0.0
    if inside[0] + inside[1] + inside[2] > 0:
        e, b = read_albedo(g, wz, roughness)
        diffuse = wz * (1 - (_DIELECTRIC * e + (1 - _DIELECTRIC) * b))
    return (
        (c0[0] + c1[0] * k) * reflected + inside[0] * diffuse,
        (c0[1] + c1[1] * k) * reflected + inside[1] * diffuse,
        (c0[2] + c1[2] * k) * reflected + inside[2] * diffuse,
        chance * pdf + (1 - chance) * wz * INV_PI,
    )


@kernel
def _glossy_value(t, look, wx, wy, wz, n):  # type: ignore[no-untyped-def]
    above = wx * n[0] + wy * n[1] + wz * n[2]
    if above <= 0:
        return 0.0, 0.0, 0.0, 0.0
    f = look[0]
    r, g, b, pdf = _unfolded(
        t.gloss, look, wx * f[0] + wy * f[1] + wz * f[2], wx * f[3] + wy * f[4] + wz * f[5], wx * n[3] + wy * n[4] + wz * n[5]
    )
    mx, my, mz = wx - 2 * above * n[0], wy - 2 * above * n[1], wz - 2 * above * n[2]
    r2, g2, b2, pdf2 = _unfolded(
        t.gloss, look, mx * f[0] + my * f[1] + mz * f[2], mx * f[3] + my * f[4] + mz * f[5], mx * n[3] + my * n[4] + mz * n[5]
    )
    return r + r2, g + g2, b + b2, pdf + pdf2


@kernel
def _sample_gloss(t, look, u, v, n):  # type: ignore[no-untyped-def]
    f, o, _, alpha, _, _, _, _, chance = look
    if u < chance:
        x, y, z = sample_visible_normal(o[0], o[1], o[2], alpha, u / chance, v)
    else:
        x, y, z = cosine_hemisphere((u - chance) / (1 - chance), v)
    return _above(x * f[0] + y * f[3] + z * n[3], x * f[1] + y * f[4] + z * n[4], x * f[2] + y * f[5] + z * n[5], n)


@kernel
def _value(t, glossy, look, wx, wy, wz, n):  # type: ignore[no-untyped-def]
    return _glossy_value(t, look, wx, wy, wz, n) if glossy else _lambert_value(t, glossy, look, wx, wy, wz, n)


@kernel
def _lambert_value(t, glossy, look, wx, wy, wz, n):  # type: ignore[no-untyped-def]
    value = lambert_cosine(wx, wy, wz, n) * INV_PI
    return value, value, value, value


@kernel
def _no_gloss(t):  # type: ignore[no-untyped-def]
    return (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), _BLACK, 1.0, 1.0, 1.0, _BLACK, _BLACK, _BLACK, 0.0


# The kernels below take :class:`bake_core.tracer.Tables`; where nothing is glossy they are Lambert's alone.

# Whether a point is (t, metallic, roughness).
is_glossy = either("gloss")(lambda t, metallic, roughness: metallic > 0 or roughness < 1)(lambda t, metallic, roughness: False)
# A look as :func:`_gloss` returns it (t, base, metallic, roughness, dx, dy, dz, n); and a place to put one (t).
gloss = either("gloss")(_gloss)(lambda t, base, metallic, roughness, dx, dy, dz, n: 0.0)
no_gloss = either("gloss")(_no_gloss)(lambda t: 0.0)
# A direction above a glossy surface (t, look, u, v, n), with the pdf of `scattered`.
sample_gloss = either("gloss")(_sample_gloss)(lambda t, look, u, v, n: (0.0, 0.0, 0.0))
# f·cosθ by channel, of a Lambert surface over its albedo, and the pdf with which the direction would have been drawn
# (t, glossy, look, wx, wy, wz, n): 4 float64.
scattered = either("gloss")(_value)(_lambert_value)
