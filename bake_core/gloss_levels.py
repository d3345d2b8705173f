"""Radiance blurred beforehand, for what reflects a lobe rather than a direction.

Karis 2013, "Real Shading in Unreal Engine 4": the light of a lobe of GGX is looked up in a map that has been averaged with the lobe's own
weights, as if it were seen straight on. Lagarde and de Rousiers 2014, "Moving Frostbite to Physically Based Rendering", for the levels.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import entry_kernel
from bake_core.octahedral import texel_directions, texel_solid_angles, with_border

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Fewest texels along a level's side: a lobe of alpha 1 is about as wide as two of them.
_SMALLEST = 8
# Probes filtered at once: their colours are what a row of weights is multiplied with, lane by lane.
_CHUNK = 16
# A level's source need be no finer than this many times the level, whose lobe is a texel wide or more.
_SOURCE = 4


def gloss_alphas(n: int) -> list[float]:
    """Alpha of GGX at levels 1, 2, ... of a radiance map of n × n texels; the last is 1, each about twice the one before.

    At level 1 the lobe's radiance has fallen to half where its direction is a texel of that level (two of the map's) off the middle: the
    half vector is half as far off, and GGX at tan θ = alpha √(√2 - 1) is half of what it is at 0.
    """
    width = min(2 * math.sqrt(4 * math.pi) / n, math.pi / 2)
    first = min(math.tan(width / 2) / math.sqrt(math.sqrt(2) - 1), 1.0)
    if first == 1.0:
        return [1.0]
    steps = math.ceil(math.log2(1 / first))
    return [first ** (1 - k / steps) for k in range(steps)] + [1.0]


def gloss_sides(n: int) -> list[int]:
    """Interior texels along the side of each of these levels. Mirrors ``obGlossTexels``."""
    return [min(n, max(_SMALLEST, n >> k)) for k in range(1, len(gloss_alphas(n)) + 1)]


@cache
def _weights(side: int, source: int, alpha: float) -> F64:
    """What each texel of a map of `source`² texels counts in each texel of a level, (side², source²); rows sum to 1."""
    cosine = texel_directions(side).reshape(-1, 3) @ texel_directions(source).reshape(-1, 3).T
    # Of the half vector, which halves the angle.
    half = (1 + cosine) / 2
    density = 1 / (half * (alpha * alpha - 1) + 1) ** 2
    weight = density * np.maximum(cosine, 0) * texel_solid_angles(source).reshape(-1)
    out: F64 = np.ascontiguousarray(weight / weight.sum(1, keepdims=True))
    return out


@entry_kernel
def _filter_kernel(weight, light, out):  # type: ignore[no-untyped-def]
    """Rows of weights times light (sources, lanes): in one order, whatever the machine."""
    for i in range(weight.shape[0]):
        for j in range(weight.shape[1]):
            w = weight[i, j]
            for lane in range(light.shape[1]):
                out[i, lane] += w * light[j, lane]
    return 0


def gloss_levels(radiance: F32) -> list[F32]:
    """Every level of some probes' radiance, with borders.

    Parameters
    ----------
    radiance : (p, n, n, 3) float32
        Interior texels of the radiance maps.

    Returns
    -------
    list of (p, s, s, 3) float32
        s is the level's side and 2.
    """
    p, n = radiance.shape[:2]
    levels = []
    for side, alpha in zip(gloss_sides(n), gloss_alphas(n), strict=True):
        source = n
        light: F64 = radiance.astype(np.float64)
        while source > _SOURCE * side and source % 4 == 0:
            light, source = _halved(light), source // 2
        weight = _weights(side, source, alpha)
        out = np.empty((p, side, side, 3), np.float32)
        for first in range(0, p, _CHUNK):
            chunk = np.moveaxis(light[first : first + _CHUNK].reshape(-1, source * source, 3), 0, 1)
            lanes = np.ascontiguousarray(chunk).reshape(source * source, -1)
            sums = np.zeros((side * side, lanes.shape[1]))
            _filter_kernel(weight, lanes, sums)
            out[first : first + _CHUNK] = np.moveaxis(sums.reshape(side, side, -1, 3), 2, 0)
        levels.append(np.asarray(with_border(out), np.float32))
    return levels


def _halved(light: F64) -> F64:
    """Maps of half as many texels along a side, weighted by solid angle."""
    p, n = light.shape[:2]
    solid = texel_solid_angles(n)[..., None]
    sums = (light * solid).reshape(p, n // 2, 2, n // 2, 2, 3).sum((2, 4))
    out: F64 = sums / solid.reshape(n // 2, 2, n // 2, 2, 1).sum((1, 3))
    return out
