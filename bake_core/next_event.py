"""Next-event estimation: light drawn from emitters, from the sky and from punctual lights, seen from a point.

Multiple importance sampling after Veach 1997, "Robust Monte Carlo Methods for Light Transport Simulation" (balance heuristic). Kernels
take :class:`bake_core.tracer.Tables`.
"""

from __future__ import annotations

import math

import numpy as np

from bake_core.environment import sample_sky
from bake_core.kernels import either, kernel
from bake_core.light_tree import pick_emitter
from bake_core.lights import choose, toward_light
from bake_core.materials import scattered
from bake_core.sampling import uniform_triangle
from bake_core.surfaces import EPSILON, INFINITE, blocked
from bake_core.textures import emission_left


@kernel
def pdf_emitter(share, strength, two_sided, d2, facing):  # type: ignore[no-untyped-def]
    """Per solid angle, of :func:`sample_emitter`, seen from a distance of √d2 under a cosine of `facing` at the emitter.

    `share` is the emitter's chance over its power, `strength` its power over the area of all its sides.
    """
    sides = 2.0 if two_sided else 1.0
    return strength * sides * share * d2 / max(facing, 1e-30)


@kernel
def emitter_strength(t, material, triangle):  # type: ignore[no-untyped-def]
    """What a triangle's part in the emitters' power is weighted by: its mean radiance, summed over channels."""
    if t.emitters.strength.shape[0]:
        return t.emitters.strength[triangle]
    le = t.materials.emission[material]
    return np.float64(le[0]) + np.float64(le[1]) + np.float64(le[2])


@kernel
def sample_emitter(t, px, py, pz, i, share, u, v):  # type: ignore[no-untyped-def]
    """A point on emissive triangle i, drawn by area, as seen from a point.

    `share` is what :func:`bake_core.light_tree.pick_emitter` tells of it. Pdf: :func:`pdf_emitter`.

    Returns
    -------
    (3 float64, 3 float64, float64, 3 float64)
        The radiance there, the unit direction to the point, its pdf per solid angle (0: no light comes from there), and the point lifted
        off its surface towards the viewer, so that the emitter does not block itself.
    """
    e = t.emitters
    radiance = (0.0, 0.0, 0.0)
    b1, b2 = uniform_triangle(u, v)
    b0 = 1.0 - b1 - b2
    x = b0 * e.vertices[i, 0, 0] + b1 * e.vertices[i, 1, 0] + b2 * e.vertices[i, 2, 0]
    y = b0 * e.vertices[i, 0, 1] + b1 * e.vertices[i, 1, 1] + b2 * e.vertices[i, 2, 1]
    z = b0 * e.vertices[i, 0, 2] + b1 * e.vertices[i, 1, 2] + b2 * e.vertices[i, 2, 2]
    dx, dy, dz = x - px, y - py, z - pz
    d2 = dx * dx + dy * dy + dz * dz
    d = math.sqrt(d2)
    pdf = 0.0
    side = 1.0
    if d > 0:
        dx, dy, dz = dx / d, dy / d, dz / d
        facing = -(dx * e.normal[i, 0] + dy * e.normal[i, 1] + dz * e.normal[i, 2])
        side = 1.0 if facing > 0 else -1.0
        if facing > 0 or (facing < 0 and e.double_sided[i]):
            material, triangle = e.material[i], e.triangle[i]
            radiance = emission_left(t, material, triangle, np.float64(b1), np.float64(b2))
            if radiance[0] + radiance[1] + radiance[2] > 0:
                pdf = pdf_emitter(share, emitter_strength(t, material, triangle), e.double_sided[i], d2, facing * side)
    # A shadow ray's end errs by an ulp of its own length too: a lamp about zero would else block itself.
    lift = side * EPSILON * (abs(x) + abs(y) + abs(z) + d)
    lifted = (x + lift * e.normal[i, 0], y + lift * e.normal[i, 1], z + lift * e.normal[i, 2])
    return radiance, (dx, dy, dz), pdf, lifted


@kernel
def from_emitters(t, ray, ray_bits, p, n, epsilon, glossy, look, u, v, w):  # type: ignore[no-untyped-def]
    """Light from one point of one emissive triangle: radiance times :func:`scattered` over the sum of both techniques' pdfs.

    The balance heuristic's weight p_l / (p_l + p_b) is already in it.
    """
    i, share, _ = pick_emitter(t, (p[0], p[1], p[2]), np.float64(w))
    radiance, d, pdf, end = sample_emitter(t, p[0], p[1], p[2], i, share, u, v)
    if pdf <= 0:
        return 0.0, 0.0, 0.0
    fr, fg, fb, bsdf_pdf = scattered(t, glossy, look, d[0], d[1], d[2], n)
    if fr + fg + fb <= 0:
        return 0.0, 0.0, 0.0
    # Both ends have left their surfaces, so that neither of them blocks.
    ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    if blocked(t, ray, ray_bits, ox, oy, oz, end[0] - ox, end[1] - oy, end[2] - oz, np.float32(1.0)):
        return 0.0, 0.0, 0.0
    both = pdf + bsdf_pdf
    return fr / both * radiance[0], fg / both * radiance[1], fb / both * radiance[2]


@kernel
def _from_sky(t, ray, ray_bits, p, n, epsilon, glossy, look, u, v):  # type: ignore[no-untyped-def]
    radiance, d, pdf = sample_sky(t.sky, np.float64(u), np.float64(v))
    fr, fg, fb, bsdf_pdf = scattered(t, glossy, look, d[0], d[1], d[2], n)
    if fr + fg + fb <= 0:
        return 0.0, 0.0, 0.0
    ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    if blocked(t, ray, ray_bits, ox, oy, oz, d[0], d[1], d[2], INFINITE):
        return 0.0, 0.0, 0.0
    both = pdf + bsdf_pdf
    return fr / both * radiance[0], fg / both * radiance[1], fb / both * radiance[2]


# The same, from one direction of the sky.
from_sky = either("sky")(_from_sky)(lambda t, ray, ray_bits, p, n, epsilon, glossy, look, u, v: (0.0, 0.0, 0.0))


@kernel
def from_lights(t, ray, ray_bits, p, n, epsilon, glossy, look, u):  # type: ignore[no-untyped-def]
    """Light from one punctual or directional light, chosen by weight: Σ E times :func:`scattered`, unbiased."""
    i, chance = choose(t.lights.cdf, np.float64(u))
    wx, wy, wz, distance, gain = toward_light(t.lights, i, p[0], p[1], p[2])
    if gain <= 0:
        return 0.0, 0.0, 0.0
    fr, fg, fb, _ = scattered(t, glossy, look, wx, wy, wz, n)
    if fr + fg + fb <= 0:
        return 0.0, 0.0, 0.0
    ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    if blocked(t, ray, ray_bits, ox, oy, oz, wx, wy, wz, np.float32(distance)):
        return 0.0, 0.0, 0.0
    return (
        gain * (fr / chance) * t.lights.value[i, 0],
        gain * (fg / chance) * t.lights.value[i, 1],
        gain * (fb / chance) * t.lights.value[i, 2],
    )
