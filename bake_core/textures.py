"""How kernels look points up in textures, and what they let through.

A ray carries the width of what it stands for (Akenine-Möller et al. 2021, "Improved Shader and Texture Level of Detail Using Ray
Cones"); a look-up takes the finest level whose texels are no smaller than half of it, so that a filter is never wider than what it
stands for. Alpha and emission are always looked up in the finest level: paths average them without bias, and a cutoff does not commute
with a filter.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import either, entry_kernel, kernel
from bake_core.sampling import mix64, uniform_triangle
from bake_core.scene import ALPHA_MASK, ALPHA_OPAQUE, NO_TEXTURE, WRAP_CLAMP, WRAP_REPEAT, Scene
from bake_core.texture_tables import BASE_COLOR, EMISSIVE, METALLIC_ROUGHNESS

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Beyond this a coordinate has no fraction left in float64 that means anything; it also keeps infinities out of integers.
_MAX_COORDINATE = 1e12
# Points at which a triangle's emission is averaged; each stands for its share of the texels, by the level that it looks at.
_EMISSION_POINTS = 8
# A ray drawn with density p stands for 1/(N p) of solid angle (Colbert and Křivánek 2007, "GPU-Based Importance Sampling", GPU Gems 3).
# N is what makes a ray straight up from a Lambert surface, p = 1/π, stand for as much as a texel of a 16 × 16 capture map.
_LOBE_RAYS = 64.0


@kernel
def _reduced(c, wrap):  # type: ignore[no-untyped-def]
    """A coordinate within one period of its wrap mode, or just outside [0, 1] where clamped."""
    if not abs(c) < _MAX_COORDINATE:
        return 0.0
    if wrap == WRAP_CLAMP:
        return min(max(c, -1.0), 2.0)
    if wrap == WRAP_REPEAT:
        return c - math.floor(c)
    return c - 2 * math.floor(c / 2)


@kernel
def _wrapped(i, n, wrap):  # type: ignore[no-untyped-def]
    """A texel's index, from one at most two texels outside its period."""
    if wrap == WRAP_CLAMP:
        return min(max(i, 0), n - 1)
    if wrap == WRAP_REPEAT:
        return i % n
    i = i % (2 * n)
    return i if i < n else 2 * n - 1 - i


@kernel
def _corners(x, k, u, v, level):  # type: ignore[no-untyped-def]
    """The four texels around a point, and where between them it lies; texel centres at +0.5."""
    sampling = x.sampling[k]
    at = x.levels[sampling[0] + level]
    width, height = at[1], at[2]
    a = _reduced(u, sampling[2]) * width
    b = _reduced(v, sampling[3]) * height
    if sampling[4]:
        i = _wrapped(np.int64(math.floor(a)), width, sampling[2])
        j = _wrapped(np.int64(math.floor(b)), height, sampling[3])
        texel = at[0] + j * width + i
        return texel, texel, texel, texel, 0.0, 0.0
    left, top = math.floor(a - 0.5), math.floor(b - 0.5)
    i0, i1 = _wrapped(int(left), width, sampling[2]), _wrapped(int(left) + 1, width, sampling[2])
    j0, j1 = at[0] + _wrapped(int(top), height, sampling[3]) * width, at[0] + _wrapped(int(top) + 1, height, sampling[3]) * width
    return j0 + i0, j0 + i1, j1 + i0, j1 + i1, a - 0.5 - left, b - 0.5 - top


@kernel
def sample_texture(x, k, u, v, level):  # type: ignore[no-untyped-def]
    """RGB of texture k at a point of its image in one level: 3 float64."""
    p, q, r, s, fx, fy = _corners(x, k, u, v, level)
    if x.srgb[k]:
        return _decoded(x, p, q, r, s, fx, fy, 0), _decoded(x, p, q, r, s, fx, fy, 1), _decoded(x, p, q, r, s, fx, fy, 2)
    return _linear(x, p, q, r, s, fx, fy, 0), _linear(x, p, q, r, s, fx, fy, 1), _linear(x, p, q, r, s, fx, fy, 2)


@kernel
def sample_alpha(x, k, u, v):  # type: ignore[no-untyped-def]
    """Alpha of texture k in its finest level."""
    p, q, r, s, fx, fy = _corners(x, k, u, v, 0)
    return _linear(x, p, q, r, s, fx, fy, 3)


@kernel
def _decoded(x, p, q, r, s, fx, fy, channel):  # type: ignore[no-untyped-def]
    a, b = x.decode[x.texels[p, channel]], x.decode[x.texels[q, channel]]
    c, d = x.decode[x.texels[r, channel]], x.decode[x.texels[s, channel]]
    return (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)


@kernel
def _linear(x, p, q, r, s, fx, fy, channel):  # type: ignore[no-untyped-def]
    a, b = np.float64(x.texels[p, channel]), np.float64(x.texels[q, channel])
    c, d = np.float64(x.texels[r, channel]), np.float64(x.texels[s, channel])
    return ((1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)) / 65535.0


@kernel
def texture_point(x, k, triangle, b1, b2):  # type: ignore[no-untyped-def]
    """Where in texture k's image a point of a triangle lies."""
    first = 2 * x.sampling[k, 5]
    w = x.uvs[triangle]
    b0 = 1.0 - b1 - b2
    u = b0 * w[0, first] + b1 * w[1, first] + b2 * w[2, first]
    v = b0 * w[0, first + 1] + b1 * w[1, first + 1] + b2 * w[2, first + 1]
    m = x.transform[k]
    return m[0, 0] * u + m[0, 1] * v + m[0, 2], m[1, 0] * u + m[1, 1] * v + m[1, 2]


@kernel
def texture_level(x, k, triangle, share):  # type: ignore[no-untyped-def]
    """The finest level of which at most four texels fall on this share (area over area) of a triangle."""
    first = 2 * x.sampling[k, 5]
    w = x.uvs[triangle]
    eu, ev = np.float64(w[1, first]) - w[0, first], np.float64(w[1, first + 1]) - w[0, first + 1]
    fu, fv = np.float64(w[2, first]) - w[0, first], np.float64(w[2, first + 1]) - w[0, first + 1]
    m = x.transform[k]
    level = x.levels[x.sampling[k, 0]]
    texels = 0.5 * abs((eu * fv - ev * fu) * (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0])) * level[1] * level[2] * share
    # Written so that NaN and infinity are safe.
    if not texels > 1:
        return 0
    return min(int(0.5 * math.log2(min(texels, 1e30))), x.sampling[k, 1] - 1)


@kernel
def look_up(x, k, triangle, b1, b2, share):  # type: ignore[no-untyped-def]
    """RGB of texture k at a point of a triangle, averaged over about this share of the triangle's area."""
    u, v = texture_point(x, k, triangle, b1, b2)
    return sample_texture(x, k, u, v, texture_level(x, k, triangle, share))


@kernel
def _opacity(x, material, triangle, b1, b2):  # type: ignore[no-untyped-def]
    """How much of a point of a triangle is there: 0 or 1 where it is masked, in between where it is blended."""
    mode = x.alpha_mode[material]
    if mode == ALPHA_OPAQUE:
        return 1.0
    value = np.float64(x.alpha_factor[material])
    if x.alpha_vertex.shape[0]:
        c = x.alpha_vertex[triangle]
        value *= (1.0 - b1 - b2) * c[0] + b1 * c[1] + b2 * c[2]
    if x.slots.shape[0]:
        k = x.slots[material, BASE_COLOR]
        if k != NO_TEXTURE:
            u, v = texture_point(x, k, triangle, b1, b2)
            value *= sample_alpha(x, k, u, v)
    if mode == ALPHA_MASK:
        return 1.0 if value >= np.float64(x.alpha_cutoff[material]) else 0.0
    return value


# The kernels below take :class:`bake_core.tracer.Tables`, and are nothing but the material's own columns where it has no textures.


def _has_holes(t):  # type: ignore[no-untyped-def]
    return t.textures.alpha_mode.shape[0] > 0


# Whether any material in use is cut out or blended.
has_holes = either("textures")(_has_holes)(lambda t: False)


@kernel
def _opacity_or_all(t, material, triangle, b1, b2):  # type: ignore[no-untyped-def]
    return _opacity(t.textures, material, triangle, b1, b2) if t.textures.alpha_mode.shape[0] else 1.0


# How much of a point of a triangle is there (t, material, triangle, b1, b2): 0 or 1 where it is masked, in between where it is blended.
opacity = either("textures")(_opacity_or_all)(lambda t, material, triangle, b1, b2: 1.0)


def _lets_through(t, material, triangle, b1, b2, ray_bits):  # type: ignore[no-untyped-def]
    there = _opacity_or_all(t, material, triangle, b1, b2)
    if there >= 1:
        return False
    if there <= 0:
        return True
    h = np.uint64(0)
    for i in (0, 2, 4, 6, 8):
        # Words of the RTCRayHit: origin, tnear, direction, time, tfar, mask: where the ray comes from, where it goes and where it hit.
        h = mix64(h ^ (np.uint64(ray_bits[i]) << np.uint64(32)) ^ np.uint64(ray_bits[i + 1])) + np.uint64(0x9E3779B97F4A7C15)
    return np.float64(h >> np.uint64(11)) * 2.0**-53 >= there


# Whether a ray goes on through its hit (t, material, triangle, b1, b2, ray_bits): where alpha cuts the surface out, else with probability
# 1 - alpha. The random number is a hash of ray and hit (after Wyman and McGuire 2017, "Hashed Alpha Testing"): the same on every run, and
# another one for any two rays that differ in a bit.
lets_through = either("textures")(_lets_through)(lambda t, material, triangle, b1, b2, ray_bits: False)


@kernel
def _emission(t, material, triangle, b1, b2, share):  # type: ignore[no-untyped-def]
    x = t.textures
    le = t.materials.emission[material]
    red, green, blue = np.float64(le[0]), np.float64(le[1]), np.float64(le[2])
    if x.slots.shape[0] and red + green + blue > 0:
        k = x.slots[material, EMISSIVE]
        if k != NO_TEXTURE:
            r, g, b = look_up(x, k, triangle, b1, b2, share)
            red, green, blue = red * r, green * g, blue * b
    if x.unlit.shape[0] and x.unlit[material] and t.colors.shape[0]:
        c = t.colors[triangle]
        b0 = 1.0 - b1 - b2
        red *= b0 * c[0, 0] + b1 * c[1, 0] + b2 * c[2, 0]
        green *= b0 * c[0, 1] + b1 * c[1, 1] + b2 * c[2, 1]
        blue *= b0 * c[0, 2] + b1 * c[1, 2] + b2 * c[2, 2]
    return red, green, blue


@kernel
def _even_emission(t, material, triangle, b1, b2, share):  # type: ignore[no-untyped-def]
    le = t.materials.emission[material]
    return np.float64(le[0]), np.float64(le[1]), np.float64(le[2])


# Radiance that leaves a point of a triangle as far as it is there (t, material, triangle, b1, b2, share): 3 float64.
emission_at = either("textures")(_emission)(_even_emission)


def _emission_through_holes(t, material, triangle, b1, b2):  # type: ignore[no-untyped-def]
    r, g, b = _emission(t, material, triangle, b1, b2, 0.0)
    there = _opacity_or_all(t, material, triangle, b1, b2)
    return there * r, there * g, there * b


def _emission_of_all(t, material, triangle, b1, b2):  # type: ignore[no-untyped-def]
    return _even_emission(t, material, triangle, b1, b2, 0.0)


# The same times how much of the point is there: what a sample of the emitter itself gets, whom no ray has let pass its holes.
emission_left = either("textures")(_emission_through_holes)(_emission_of_all)


def _reflectance(t, s, width, cosine):  # type: ignore[no-untyped-def]
    x = t.textures
    color, material, triangle = s[3], s[4], s[6]
    red = np.float64(t.materials.albedo[material, 0]) * color[0]
    green = np.float64(t.materials.albedo[material, 1]) * color[1]
    blue = np.float64(t.materials.albedo[material, 2]) * color[2]
    metallic, roughness = np.float64(t.materials.metallic[material]), np.float64(t.materials.roughness[material])
    if x.slots.shape[0]:
        slots = x.slots[material]
        share = 2 * width * width / (max(cosine, 1e-3) * s[9]) if s[9] > 0 else 0.0
        if slots[BASE_COLOR] != NO_TEXTURE:
            r, g, b = look_up(x, slots[BASE_COLOR], triangle, s[7], s[8], share)
            red, green, blue = red * r, green * g, blue * b
        if slots[METALLIC_ROUGHNESS] != NO_TEXTURE:
            _, g, b = look_up(x, slots[METALLIC_ROUGHNESS], triangle, s[7], s[8], share)
            metallic, roughness = metallic * b, roughness * g
    return red, green, blue, metallic, roughness


def _even_reflectance(t, s, width, cosine):  # type: ignore[no-untyped-def]
    albedo, color = t.materials.albedo[s[4]], s[3]
    metallic, roughness = np.float64(t.materials.metallic[s[4]]), np.float64(t.materials.roughness[s[4]])
    return np.float64(albedo[0]) * color[0], np.float64(albedo[1]) * color[1], np.float64(albedo[2]) * color[2], metallic, roughness


# Base colour (vertex colour included), metallic and roughness of a hit (t, surface, width, cosine), averaged over the footprint of a ray
# `width` metres wide that meets it under `cosine`: 5 float64.
reflectance = either("textures")(_reflectance)(_even_reflectance)


def _widened(t, width, spread, distance):  # type: ignore[no-untyped-def]
    return width + spread * distance


# The width of a ray after a distance (t, width, spread, distance), metres; 0 where nobody asks.
widened = either("textures")(_widened)(lambda t, width, spread, distance: 0.0)


def _spread(t, spread, pdf):  # type: ignore[no-untyped-def]
    return max(spread, math.sqrt(1 / (_LOBE_RAYS * max(pdf, 1e-3))))


# The spread of a ray scattered with this density (t, spread before, pdf), radians: never less than before.
scattered_spread = either("textures")(_spread)(lambda t, spread, pdf: spread)


@entry_kernel
def _mean_emission(t, triangles, out):  # type: ignore[no-untyped-def]
    """Channel sum of the mean of what leaves each of some triangles, by a regular pattern of points."""
    n = _EMISSION_POINTS
    for i in range(triangles.shape[0]):
        triangle = triangles[i]
        material = t.corner_bits[triangle, 9]
        total = 0.0
        for row in range(n):
            for column in range(n):
                b1, b2 = uniform_triangle((row + 0.5) / n, (column + 0.5) / n)
                r, g, b = _emission(t, material, triangle, b1, b2, 1.0 / (n * n))
                there = _opacity_or_all(t, material, triangle, b1, b2)
                total += there * (r + g + b)
        out[triangle] = total / (n * n)


def emits_unevenly(scene: Scene) -> bool:
    """Whether a triangle in use may emit other than its material's emission everywhere."""
    m = scene.materials
    uneven = (m.emission.max(axis=1, initial=0) > 0) & (m.unlit | (m.emissive_texture != NO_TEXTURE) | (m.alpha_mode != ALPHA_OPAQUE))
    return bool(uneven[np.unique(scene.triangle_material)].any())


def mean_emission(tables: Any, scene: Scene) -> F64:
    """Channel sum of every triangle's mean radiance, (t,) float64: what emitters are chosen by.

    It only has to be about right, and the same on every run: the density is what it says, whatever it says.

    Parameters
    ----------
    tables : bake_core.tracer.Tables
    """
    out = np.zeros(len(scene.triangle_material))
    emissive = scene.materials.emission.max(axis=1, initial=0) > 0
    _mean_emission(tables, np.flatnonzero(emissive[scene.triangle_material]), out)
    return out
