"""Prefiltering of what probes see: visibility moments."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import entry_kernel
from bake_core.octahedral import texel_directions, texel_solid_angles

F64 = NDArray[np.float64]

# Width of the visibility lobe, cos^k: half its height at 9.5°, as wide as a texel of a 16×16 map. McGuire et al. 2017, "Real-Time Global
# Illumination using Precomputed Light Field Probes", and Majercik et al. 2019 use 50.
VISIBILITY_SHARPNESS = 50
# Where the lobe has fallen below this it is cut off: the mean distance changes by less than 1e-5 of the limit.
_LOBE_CUT = 1e-5


@cache
def _lobes(resolution: int, distance_resolution: int) -> tuple[NDArray[np.int64], NDArray[np.int32], F64]:
    """For each visibility texel, the distance texels in its lobe and their weights, in one run each (CSR)."""
    centre = texel_directions(resolution).reshape(-1, 3)
    weight = np.maximum(centre @ texel_directions(distance_resolution).reshape(-1, 3).T, 0) ** VISIBILITY_SHARPNESS
    weight[weight < _LOBE_CUT] = 0
    weight *= texel_solid_angles(distance_resolution).reshape(-1)
    if (weight.sum(1) == 0).any():
        # A distance map coarser than the lobe: its nearest texel.
        raise ValueError("the distance map is too coarse for the visibility lobe")
    weight /= weight.sum(1, keepdims=True)
    row, column = np.nonzero(weight)
    start = np.searchsorted(row, np.arange(len(centre) + 1))
    return start.astype(np.int64), column.astype(np.int32), weight[row, column]


@entry_kernel
def _moments_kernel(start, column, weight, distance, limit, out):  # type: ignore[no-untyped-def]
    for p in range(distance.shape[0]):
        for i in range(out.shape[1]):
            mean = square = 0.0
            for e in range(start[i], start[i + 1]):
                d = min(distance[p, column[e]], limit[p])
                mean += weight[e] * d
                square += weight[e] * d * d
            out[p, i, 0] = mean
            # Rounding must not make a variance negative.
            out[p, i, 1] = max(square, mean * mean)


def visibility_moments(distance: F64, limit: F64, resolution: int) -> NDArray[np.float32]:
    """Mean and mean squared distance over a cos^50 lobe about each visibility texel's direction.

    Parameters
    ----------
    distance : (p, d²) float64
        Metres, through the centres of a d×d map; inf for a miss.
    limit : (p,) float64
        Metres; distances are clamped to it, misses too.
    resolution : int
        Texels along the visibility map's side.

    Returns
    -------
    (p, resolution, resolution, 2) float32
        Metres and m²; not halved.
    """
    start, column, weight = _lobes(resolution, round(distance.shape[1] ** 0.5))
    out = np.empty((len(distance), resolution**2, 2), np.float32)
    _moments_kernel(start, column, weight, distance, limit, out)
    return out.reshape(-1, resolution, resolution, 2)
