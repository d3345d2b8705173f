"""Textures as the kernels see them: pyramids of texels, how a point is looked up in them, and what is cut out.

Texels are 16-bit codes, exact for sources of 8 and of 16 bits, and one table decodes sRGB: 10.7 bytes a texel with its pyramid, half of
float32's. Levels are box-filtered in linear light (Williams 1983, "Pyramidal Parametrics"), each of them from the one above.

A ray carries the width of what it stands for (Akenine-Möller et al. 2021, "Improved Shader and Texture Level of Detail Using Ray
Cones"); a look-up takes the finest level whose texels are no smaller than half of it, so that a filter is never wider than what it
stands for. Alpha and emission are always looked up in the finest level: paths average them without bias, and a cutoff does not commute
with a filter.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import entry_kernel, kernel
from bake_core.sampling import mix64, uniform_triangle
from bake_core.scene import ALPHA_BLEND, ALPHA_MASK, ALPHA_OPAQUE, NO_TEXTURE, WRAP_CLAMP, WRAP_REPEAT, Image, Scene

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

BASE_COLOR, METALLIC_ROUGHNESS, EMISSIVE = 0, 1, 2
# Beyond this a coordinate has no fraction left in float64 that means anything; it also keeps infinities out of integers.
_MAX_COORDINATE = 1e12
# Points at which a triangle's emission is averaged; each stands for its share of the texels, by the level that it looks at.
_EMISSION_POINTS = 8


class TextureTable(NamedTuple):
    """All textures of a scene; every array is empty where no material in use has any.

    Attributes
    ----------
    slots : (m, 3) int32
        By material: texture of BASE_COLOR, METALLIC_ROUGHNESS and EMISSIVE, or NO_TEXTURE.
    uvs : (t, 3, 2 s) float32
        Texture coordinates by triangle and corner, a pair for each set.
    sampling : (k, 6) int32
        By texture: first row in `levels`, how many, wrap along u, wrap along v, nearest, uv set.
    transform : (k, 2, 3) float64
    srgb : (k,) bool
    levels : (l, 3) int64
        First texel, width, height.
    texels : (n, 4) uint16
    decode : (65536,) float32
        sRGB code to linear value.
    unlit : (m,) bool
        Whose emission the vertex colour multiplies.
    """

    slots: NDArray[np.int32]
    uvs: F32
    sampling: NDArray[np.int32]
    transform: F64
    srgb: NDArray[np.bool_]
    levels: NDArray[np.int64]
    texels: NDArray[np.uint16]
    decode: F32
    unlit: NDArray[np.bool_]


class AlphaTable(NamedTuple):
    """What is cut out; every array is empty where no material in use is.

    mode (m,) uint8; factor, cutoff (m,) float32; vertex (t, 3) float32: COLOR_0's alpha by corner, empty where no mesh has any below 1.
    """

    mode: NDArray[np.uint8]
    factor: F32
    cutoff: F32
    vertex: F32


def srgb_to_linear(encoded: F64) -> F64:
    """IEC 61966-2-1:1999, values in [0, 1]."""
    out: F64 = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return out


def linear_to_srgb(linear: F64) -> F64:
    """Inverse of :func:`srgb_to_linear`."""
    out: F64 = np.where(linear <= 0.04045 / 12.92, linear * 12.92, 1.055 * np.maximum(linear, 0.003) ** (1 / 2.4) - 0.055)
    return out


def texture_table(scene: Scene) -> TextureTable:
    """The kernels' view of a scene's textures."""
    m = scene.materials
    slots = np.stack([m.base_color_texture, m.metallic_roughness_texture, m.emissive_texture], 1).astype(np.int32)
    unlit = m.unlit if m.unlit.any() else np.zeros(0, np.bool_)
    if not scene.textures:
        none = np.zeros
        return TextureTable(
            none((0, 3), np.int32),
            none((0, 3, 2), np.float32),
            none((0, 6), np.int32),
            none((0, 2, 3)),
            none(0, np.bool_),
            none((0, 3), np.int64),
            none((0, 4), np.uint16),
            none(0, np.float32),
            unlit,
        )
    cutoffs = _cutoffs(scene)
    pyramids: dict[tuple[int, bool, float], tuple[int, int]] = {}
    levels: list[tuple[int, int, int]] = []
    texels: list[NDArray[np.uint16]] = []
    sampling = []
    size = 0
    for texture, cutoff in zip(scene.textures, cutoffs, strict=True):
        key = (texture.image, texture.srgb, cutoff)
        if key not in pyramids:
            made = pyramid(scene.images[texture.image], texture.srgb, cutoff)
            pyramids[key] = len(levels), len(made)
            for level in made:
                levels.append((size, level.shape[1], level.shape[0]))
                texels.append(level.reshape(-1, 4))
                size += len(texels[-1])
        sampling.append((*pyramids[key], *texture.wrap, int(texture.nearest), texture.uv_set))
    return TextureTable(
        slots,
        scene.uvs[scene.indices],
        np.array(sampling, np.int32),
        np.array([t.transform for t in scene.textures], np.float64),
        np.array([t.srgb for t in scene.textures], np.bool_),
        np.array(levels, np.int64),
        np.concatenate(texels),
        srgb_to_linear(np.arange(65536) / 65535).astype(np.float32),
        unlit,
    )


def alpha_table(scene: Scene) -> AlphaTable:
    """The kernels' view of what is cut out."""
    m = scene.materials
    used = np.unique(scene.triangle_material)
    if (m.alpha_mode[used] == ALPHA_OPAQUE).all():
        none = np.zeros(0, np.float32)
        return AlphaTable(np.zeros(0, np.uint8), none, none, np.zeros((0, 3), np.float32))
    vertex = np.zeros((0, 3), np.float32)
    if len(scene.colors) and (scene.colors[:, 3] < 1).any():
        vertex = np.ascontiguousarray(scene.colors[scene.indices, 3])
    return AlphaTable(m.alpha_mode, m.alpha, m.alpha_cutoff, vertex)


def _cutoffs(scene: Scene) -> list[float]:
    """By texture: what its colours are weighted by in the pyramid: 0 nothing, above 0 whether alpha reaches this, -1 alpha itself."""
    m = scene.materials
    cutoffs = [0.0] * len(scene.textures)
    for texture, mode, alpha, cutoff in zip(m.base_color_texture, m.alpha_mode, m.alpha, m.alpha_cutoff, strict=True):
        # Where materials of several modes share a texture, the last one's serves; the finest level is the same for all.
        if texture != NO_TEXTURE and mode != ALPHA_OPAQUE:
            cutoffs[texture] = -1.0 if mode == ALPHA_BLEND else float(cutoff) / max(float(alpha), 1e-9)
    return cutoffs


def pyramid(image: Image, srgb: bool, cutoff: float) -> list[NDArray[np.uint16]]:
    """All levels of an image, (h, w, 4) uint16 codes, down to one texel.

    Parameters
    ----------
    srgb : bool
        RGB is averaged in linear light and stored as sRGB codes.
    cutoff : float
        Weight of a texel's colour in coarser levels: 0: all alike; above 0: 1 where alpha ≥ cutoff; below 0: alpha. So that what is cut out
        does not colour what is left.
    """
    codes = image.pixels.astype(np.uint16)
    if image.pixels.dtype == np.uint8:
        codes *= np.uint16(257)
    levels = [codes]
    if max(codes.shape[:2]) == 1:
        return levels
    table = np.arange(65536) / 65535
    decode = (srgb_to_linear(table) if srgb else table).astype(np.float32)
    color = decode[codes[..., :3]]
    alpha = (codes[..., 3:] * np.float32(1 / 65535)).astype(np.float32)
    weight = np.ones_like(alpha) if cutoff == 0 else alpha if cutoff < 0 else (alpha >= cutoff).astype(np.float32)
    # Where everything is cut out the colour does not matter, but must be one.
    weight = np.maximum(weight, np.float32(1e-6))
    while max(color.shape[:2]) > 1:
        weighted = _halved(color * weight)
        weight, alpha = _halved(weight), _halved(alpha)
        color = weighted / weight
        rgb = linear_to_srgb(color.astype(np.float64)) if srgb else color
        levels.append(np.rint(np.clip(np.concatenate([rgb, alpha], 2), 0, 1) * 65535).astype(np.uint16))
    return levels


def _halved(values: F32) -> F32:
    """Half as many rows and columns, rounded down but one at least, by a box filter over exactly what each covers."""
    for axis in (0, 1):
        n = values.shape[axis]
        if n == 1:
            continue
        values = np.moveaxis(values, axis, 0)
        if n % 2 == 0:
            values = (values[0::2] + values[1::2]) * np.float32(0.5)
        else:
            # 2 k + 1 texels become k of 2 + 1/k each (Guthe and Heckbert 2005, "Non-Power-of-Two Mipmapping"): the i-th takes (k - i) / n,
            # k / n and (i + 1) / n of three neighbours.
            k = n // 2
            i = np.arange(k, dtype=np.float32).reshape(-1, *[1] * (values.ndim - 1))
            values = ((k - i) * values[0:-1:2][:k] + k * values[1::2] + (i + 1) * values[2::2]) * np.float32(1 / n)
        values = np.moveaxis(values, 0, axis)
    return np.ascontiguousarray(values)


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
    a, b = float(x.texels[p, channel]), float(x.texels[q, channel])
    c, d = float(x.texels[r, channel]), float(x.texels[s, channel])
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
    eu, ev = float(w[1, first]) - w[0, first], float(w[1, first + 1]) - w[0, first + 1]
    fu, fv = float(w[2, first]) - w[0, first], float(w[2, first + 1]) - w[0, first + 1]
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
def opacity(x, alpha, material, triangle, b1, b2):  # type: ignore[no-untyped-def]
    """How much of a point of a triangle is there: 0 or 1 where it is masked, in between where it is blended."""
    mode = alpha.mode[material]
    if mode == ALPHA_OPAQUE:
        return 1.0
    value = float(alpha.factor[material])
    if alpha.vertex.shape[0]:
        c = alpha.vertex[triangle]
        value *= (1.0 - b1 - b2) * c[0] + b1 * c[1] + b2 * c[2]
    if x.slots.shape[0]:
        k = x.slots[material, BASE_COLOR]
        if k != NO_TEXTURE:
            u, v = texture_point(x, k, triangle, b1, b2)
            value *= sample_alpha(x, k, u, v)
    if mode == ALPHA_MASK:
        return 1.0 if value >= float(alpha.cutoff[material]) else 0.0
    return value


@kernel
def lets_through(x, alpha, material, triangle, b1, b2, ray_bits):  # type: ignore[no-untyped-def]
    """Whether a ray goes on through its hit: where alpha cuts the surface out, else with probability 1 - alpha.

    The random number is a hash of ray and hit (Wyman and McGuire 2017, "Hashed Alpha Testing", without their anchoring): the same on every
    run, and independent between any two rays that differ in a bit.
    """
    there = opacity(x, alpha, material, triangle, b1, b2)
    if there >= 1:
        return False
    if there <= 0:
        return True
    h = np.uint64(0)
    for i in (0, 2, 4, 6, 8):
        # Words of the RTCRayHit: origin, tnear, direction, time, tfar, mask: where the ray comes from, where it goes and where it hit.
        h = mix64(h ^ (np.uint64(ray_bits[i]) << np.uint64(32)) ^ np.uint64(ray_bits[i + 1])) + np.uint64(0x9E3779B97F4A7C15)
    return float(h >> np.uint64(11)) * 2.0**-53 >= there


@kernel
def emission_at(t, material, triangle, b1, b2, share):  # type: ignore[no-untyped-def]
    """Radiance that leaves a point of a triangle, as far as it is there: 3 float64. `t` is :class:`bake_core.transport.Tables`."""
    red = float(t.materials.emission[material, 0])
    green = float(t.materials.emission[material, 1])
    blue = float(t.materials.emission[material, 2])
    if t.textures.slots.shape[0] and red + green + blue > 0:
        k = t.textures.slots[material, EMISSIVE]
        if k != NO_TEXTURE:
            r, g, b = look_up(t.textures, k, triangle, b1, b2, share)
            red, green, blue = red * r, green * g, blue * b
    if t.textures.unlit.shape[0] and t.textures.unlit[material] and t.colors.shape[0]:
        c = t.colors[triangle]
        b0 = 1.0 - b1 - b2
        red *= b0 * c[0, 0] + b1 * c[1, 0] + b2 * c[2, 0]
        green *= b0 * c[0, 1] + b1 * c[1, 1] + b2 * c[2, 1]
        blue *= b0 * c[0, 2] + b1 * c[1, 2] + b2 * c[2, 2]
    return red, green, blue


@entry_kernel
def _mean_emission(t, triangles, out):  # type: ignore[no-untyped-def]
    """Channel sum of the mean of what leaves each of some triangles, by a regular pattern of points."""
    n = _EMISSION_POINTS
    for i in range(triangles.shape[0]):
        triangle = triangles[i]
        material = t.triangle_material[triangle]
        total = 0.0
        for row in range(n):
            for column in range(n):
                b1, b2 = uniform_triangle((row + 0.5) / n, (column + 0.5) / n)
                r, g, b = emission_at(t, material, triangle, b1, b2, 1.0 / (n * n))
                there = opacity(t.textures, t.alpha, material, triangle, b1, b2) if t.alpha.mode.shape[0] else 1.0
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
    tables : bake_core.transport.Tables
    """
    out = np.zeros(len(scene.triangle_material))
    emissive = scene.materials.emission.max(axis=1, initial=0) > 0
    _mean_emission(tables, np.flatnonzero(emissive[scene.triangle_material]), out)
    return out
