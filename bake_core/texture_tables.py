"""Textures as the kernels see them: pyramids of texels, and what is cut out. :mod:`bake_core.textures` looks points up in them.

Texels are 16-bit codes, exact for sources of 8 and of 16 bits, and one table decodes sRGB: 10.7 bytes a texel with its pyramid, half of
float32's. Levels are box-filtered in linear light (Williams 1983, "Pyramidal Parametrics"), each of them from the one above.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.scene import ALPHA_BLEND, ALPHA_OPAQUE, NO_TEXTURE, Image, Scene

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

BASE_COLOR, METALLIC_ROUGHNESS, EMISSIVE = 0, 1, 2


class TextureTable(NamedTuple):
    """All that makes a material uneven: textures, holes, unlit vertex colours. Arrays are empty where nothing in the scene needs them.

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
    alpha_mode : (m,) uint8
    alpha_factor, alpha_cutoff : (m,) float32
    alpha_vertex : (t, 3) float32
        COLOR_0's alpha by corner; empty where it is 1 everywhere.
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
    alpha_mode: NDArray[np.uint8]
    alpha_factor: F32
    alpha_cutoff: F32
    alpha_vertex: F32


def srgb_to_linear(encoded: F64) -> F64:
    """IEC 61966-2-1:1999, values in [0, 1]."""
    out: F64 = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return out


def linear_to_srgb(linear: F64) -> F64:
    """Inverse of :func:`srgb_to_linear`."""
    out: F64 = np.where(linear <= 0.04045 / 12.92, linear * 12.92, 1.055 * np.maximum(linear, 0.003) ** (1 / 2.4) - 0.055)
    return out


def texture_table(scene: Scene, *, always: bool = False) -> TextureTable | None:
    """The kernels' view of a scene's textures and holes; None where it has none, unless it is `always` wanted."""
    m = scene.materials
    unlit = m.unlit if m.unlit.any() else np.zeros(0, np.bool_)
    has_alpha = bool((m.alpha_mode[np.unique(scene.triangle_material)] != ALPHA_OPAQUE).any())
    if not (always or scene.textures or has_alpha or unlit.size):
        return None
    vertex = np.zeros((0, 3), np.float32)
    if has_alpha and len(scene.colors) and (scene.colors[:, 3] < 1).any():
        vertex = np.ascontiguousarray(scene.colors[scene.indices, 3])
    pyramids: dict[tuple[int, bool, float], tuple[int, int]] = {}
    levels: list[tuple[int, int, int]] = []
    texels: list[NDArray[np.uint16]] = [np.zeros((0, 4), np.uint16)]
    sampling = []
    size = 0
    for texture, cutoff in zip(scene.textures, _cutoffs(scene), strict=True):
        key = (texture.image, texture.srgb, cutoff)
        if key not in pyramids:
            made = pyramid(scene.images[texture.image], texture.srgb, cutoff)
            pyramids[key] = len(levels), len(made)
            for level in made:
                levels.append((size, level.shape[1], level.shape[0]))
                texels.append(level.reshape(-1, 4))
                size += len(texels[-1])
        sampling.append((*pyramids[key], *texture.wrap, int(texture.nearest), texture.uv_set))
    slots = np.stack([m.base_color_texture, m.metallic_roughness_texture, m.emissive_texture], 1).astype(np.int32)
    return TextureTable(
        slots=slots if scene.textures else np.zeros((0, 3), np.int32),
        uvs=scene.uvs[scene.indices] if scene.textures else np.zeros((0, 3, 2), np.float32),
        sampling=np.array(sampling, np.int32).reshape(-1, 6),
        transform=np.array([t.transform for t in scene.textures], np.float64).reshape(-1, 2, 3),
        srgb=np.array([t.srgb for t in scene.textures], np.bool_),
        levels=np.array(levels, np.int64).reshape(-1, 3),
        texels=np.concatenate(texels),
        decode=srgb_to_linear(np.arange(65536) / 65535).astype(np.float32),
        unlit=unlit,
        alpha_mode=m.alpha_mode if has_alpha else np.zeros(0, np.uint8),
        alpha_factor=m.alpha,
        alpha_cutoff=m.alpha_cutoff,
        alpha_vertex=vertex,
    )


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
