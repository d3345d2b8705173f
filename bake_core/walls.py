"""Walls: where the nearest surfaces are, so that a bilinear look-up gives a flat one back. By this the query tells light from leaks.

A point of a surface at distance d in the unit direction ω is s = d·|ω|₁ times a point v of the octahedron |x| + |y| + |z| = 1, and v is
linear in the square's coordinates on each of the eight faces. On a plane n·p = h, s·(n·v) = h: so 1/s is linear in the square, whatever the
plane, and a bilinear look-up of 1/s between four texels has no error at all where one of distances (or of their moments: Donnelly and
Lauritzen 2006, "Variance Shadow Maps") is off by more the more slanting the view. Lengths are in units of the volume's smallest spacing,
so that half floats hold them at any scale.

Texels are those whose look-ups fit all rays best in the mean square: across a fold of the octahedron, where v has a kink, they share out
what the value at each texel's centre would leave to one side.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from bake_core.filtering import visibility_moments
from bake_core.kernels import entry_kernel
from bake_core.octahedral import dir_to_oct, texel_directions, with_border

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# A surface nearer than this part of the smallest spacing counts as that near. Half floats would hold one 64 times nearer.
NEAREST = 1 / 1024
# Of conjugate gradients. Of products of tents the fit's matrix has condition 9 at most, so each halves the error: to 2⁻¹⁶, which is less
# than what half floats lose.
_STEPS = 16
# Along the side of a map of directions, to fit a coarser map by.
_RAYS = 64
# Probes at once: bounds memory to some 100 MB.
_AT_ONCE = 256


@cache
def _look_ups(resolution: int, distance_resolution: int) -> tuple[I64, F64, I64]:
    """For each ray of the distance map, the four texels of its look-up and their weights; and for each texel the ray nearest its centre.

    Returns
    -------
    texels : (d², 4) int64
    weights : (d², 4) float64
    nearest : (resolution²,) int64
    """
    numbers = with_border(np.arange(resolution**2, dtype=np.float64).reshape(resolution, resolution, 1))[..., 0].astype(np.int64)
    at = 0.5 + (dir_to_oct(texel_directions(distance_resolution).reshape(-1, 3)) * 0.5 + 0.5) * resolution
    low = np.clip(np.floor(at), 0, resolution).astype(np.int64)
    fx, fy = (at - low).T
    x, y = low.T
    texels = np.stack([numbers[y, x], numbers[y, x + 1], numbers[y + 1, x], numbers[y + 1, x + 1]], -1)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    column = np.minimum((np.arange(resolution) * 2 + 1) * distance_resolution // (2 * resolution), distance_resolution - 1)
    nearest = (column[:, None] * distance_resolution + column).ravel()
    return texels, weights, nearest


@entry_kernel
def _fit_kernel(texels, weights, start, values, steps, gradient, way, image, out):  # type: ignore[no-untyped-def]
    """Least squares by conjugate gradients on the normal equations (Hestenes and Stiefel 1952), each probe by itself.

    texels, weights (m, 4); start (p, n) and values (p, m) float64; gradient, way (n,) and image (m,) float64, to work in; out (p, n)
    float64. A texel that no ray looks up keeps its start.
    """
    rays, n = texels.shape[0], out.shape[1]
    for p in range(out.shape[0]):
        x = out[p]
        for i in range(n):
            x[i] = start[p, i]
            gradient[i] = 0.0
        for r in range(rays):
            left = values[p, r]
            for k in range(4):
                left -= weights[r, k] * x[texels[r, k]]
            for k in range(4):
                gradient[texels[r, k]] += weights[r, k] * left
        size = 0.0
        for i in range(n):
            way[i] = gradient[i]
            size += gradient[i] * gradient[i]
        # Residuals of the normal equations, not of the fit, which is never perfect: these do go to nothing.
        enough = size * 1e-24
        for _ in range(steps):
            if size <= enough:
                break
            length = 0.0
            for r in range(rays):
                a = 0.0
                for k in range(4):
                    a += weights[r, k] * way[texels[r, k]]
                image[r] = a
                length += a * a
            if length == 0.0:
                break
            step = size / length
            for i in range(n):
                x[i] += step * way[i]
            for r in range(rays):
                for k in range(4):
                    gradient[texels[r, k]] -= step * weights[r, k] * image[r]
            before, size = size, 0.0
            for i in range(n):
                size += gradient[i] * gradient[i]
            for i in range(n):
                way[i] = gradient[i] + size / before * way[i]


def moments_and_walls(distance: F64, limits: F64, units: F64, resolution: int) -> NDArray[np.float32]:
    """How far a probe sees, (p, resolution, resolution, 3): :func:`bake_core.filtering.visibility_moments`, then :func:`walls`."""
    return np.concatenate([visibility_moments(distance, limits, resolution), walls(distance, limits, units, resolution)], -1)


def walls(distance: F64, limit: F64, unit: F64, resolution: int) -> NDArray[np.float32]:
    """Inverse distances, by the 1-norm, to what probes see, fitted for bilinear look-ups.

    Parameters
    ----------
    distance : (p, d²) float64
        Metres, through the centres of a d×d map; inf for a miss.
    limit : (p,) float64
        Metres; distances are clamped to it, misses too.
    unit : (p,) float64
        The smallest spacing of each probe's volume, metres.
    resolution : int
        Texels along the map's side.

    Returns
    -------
    (p, resolution, resolution, 1) float32
        unit / (d·|ω|₁), from 0 to 1 / :data:`NEAREST`.
    """
    norm = np.abs(texel_directions(round(distance.shape[1] ** 0.5))).sum(-1).reshape(-1)
    reach = np.minimum(distance, limit[:, None]) / unit[:, None] * norm
    return _fitted(1 / np.maximum(reach, NEAREST), resolution)


def coarser(maps: NDArray[np.float32], resolution: int) -> NDArray[np.float32]:
    """What :func:`moments_and_walls` would have made of the same probes at a lower resolution, from maps of a higher one.

    Moments are looked up at the new texels' centres; walls are fitted to look-ups in as many directions as a distance map has by default.

    Parameters
    ----------
    maps : (p, side, side, 3) float32
    resolution : int
        Less than `side`.

    Returns
    -------
    (p, resolution, resolution, 3) float32
    """
    side = maps.shape[1]
    out = np.empty((len(maps), resolution, resolution, 3), np.float32)
    for first in range(0, len(maps), _AT_ONCE):
        flat = maps[first : first + _AT_ONCE].reshape(-1, side**2, 3).astype(np.float64)
        some = out[first : first + _AT_ONCE]
        some[..., :2] = _looked_up(flat[..., :2], side, resolution).reshape(-1, resolution, resolution, 2)
        some[..., 2:] = _fitted(_looked_up(flat[..., 2:], side, _RAYS)[..., 0], resolution)
    return out


def _looked_up(values: F64, side: int, rays: int) -> F64:
    """Bilinear look-ups in maps (p, side², c) through the centres of a map of rays², (p, rays², c)."""
    texels, weights, _ = _look_ups(side, rays)
    out = weights[:, 0, None] * values[:, texels[:, 0]]
    for k in range(1, 4):
        out += weights[:, k, None] * values[:, texels[:, k]]
    return out


def _fitted(values: F64, resolution: int) -> NDArray[np.float32]:
    """Maps (p, resolution, resolution, 1) whose look-ups come nearest to values (p, d²) in the directions of a d×d map."""
    rays = values.shape[1]
    texels, weights, nearest = _look_ups(resolution, round(rays**0.5))
    out = np.empty((len(values), resolution**2))
    room = np.empty(resolution**2), np.empty(resolution**2), np.empty(rays)
    _fit_kernel(texels, weights, np.ascontiguousarray(values[:, nearest]), np.ascontiguousarray(values), _STEPS, *room, out)
    return np.clip(out, 0, 1 / NEAREST).astype(np.float32).reshape(-1, resolution, resolution, 1)
