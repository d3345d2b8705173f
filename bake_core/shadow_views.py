"""Where shadow maps look from: one parallel view for the sun, one or six perspective ones for a lamp.

Depth is reversed (1 near, 0 far): float32 then keeps its relative accuracy over any range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.scene import LIGHT_DIRECTIONAL, LIGHT_SPOT, Lights

F64 = NDArray[np.float64]

# A spot as wide as this or wider gets a cube: one view would spend its texels on the rim.
WIDE_SPOT = math.radians(60)
# Nearest depth of a perspective view over the scene's diagonal. Reversed float32 depth loses nothing by its being small.
NEAR = 1e-5
# Texels beyond a view's edge, for the filter's neighbours.
MARGIN = 2
_FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)


# What shadow maps may take, and how large one is at most and at least; past that, lights are drawn in batches.
BUDGET = 256 << 20
LARGEST, SMALLEST = 4096, 1024


@dataclass(frozen=True)
class Batch:
    """Lights whose shadow maps exist at the same time: [first, last).

    Attributes
    ----------
    first, last : int
    views : int
        Shadow maps of the batch.
    first_view, view_count : tuple of int
        For each light of the batch: its first map, and how many it has (1, or 6 in the shader's order of cube faces).
    """

    first: int
    last: int
    views: int
    first_view: tuple[int, ...] = ()
    view_count: tuple[int, ...] = ()


def batches(lights: Lights) -> tuple[list[Batch], int]:
    """Batches of lights, and the texels along the side of their shadow maps."""
    counts = [_view_count(lights, i) for i in range(len(lights.kind))]
    size = LARGEST
    while size > SMALLEST and sum(counts) * size * size * 4 > BUDGET:
        size //= 2
    most = BUDGET // (size * size * 4)
    out: list[Batch] = []
    first = 0
    while first < len(counts):
        last, used, starts = first, 0, []
        while last < len(counts) and used + counts[last] <= most:
            starts.append(used)
            used += counts[last]
            last += 1
        out.append(Batch(first, last, used, tuple(starts), tuple(counts[first:last])))
        first = last
    return out, size if counts else 1


def view_matrices(lights: Lights, batch: Batch, casters: F64, receivers: F64, size: int) -> F64:
    """The views of a batch's lights.

    Parameters
    ----------
    lights : Lights
        In the local frame.
    casters : (2, 3) float64
        Bounds of everything that may cast a shadow.
    receivers : (n, 3) float64
        Points that stand for everything that is to be shaded: a parallel view covers these and no more, so that its texels are about as
        fine as the picture's pixels.
    size : int
        Texels along a map's side.

    Returns
    -------
    (batch.views, 4, 4) float64
        Local frame to reversed clip space.
    """
    near = NEAR * (float(np.linalg.norm(casters[1] - casters[0])) or 1.0)
    out = []
    for i in range(batch.first, batch.last):
        position, direction = lights.position[i].astype(np.float64), lights.direction[i].astype(np.float64)
        if lights.kind[i] == LIGHT_DIRECTIONAL:
            out.append(_parallel(direction, casters, receivers, size))
        elif _view_count(lights, i) == 1:
            out.append(_perspective(position, direction, math.tan(math.acos(float(lights.cos_outer[i]))), near, size))
        else:
            out += [_perspective(position, face, 1.0, near, size) for face in _FACES]
    return np.stack(out)


def _view_count(lights: Lights, i: int) -> int:
    narrow = lights.kind[i] == LIGHT_SPOT and lights.cos_outer[i] > math.cos(WIDE_SPOT)
    return 1 if narrow or lights.kind[i] == LIGHT_DIRECTIONAL else 6


def corners(bounds: F64) -> F64:
    """The eight corners of a box, (8, 3)."""
    return np.array([[bounds[i >> axis & 1, axis] for axis in range(3)] for i in range(8)])


def _axes(forward: F64) -> F64:
    """Right, up and forward as rows: any two across the direction will do."""
    aside = np.eye(3)[np.abs(forward).argmin()]
    right = np.cross(forward, aside)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def _parallel(direction: F64, casters: F64, receivers: F64, size: int) -> F64:
    axes = _axes(direction)
    seen = receivers @ axes.T
    low, high = seen.min(0)[:2], seen.max(0)[:2]
    # Pixels of the picture fall between the points given; two per cent and the filter's margin cover them.
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-30) * 1.02 * (size / (size - 2 * MARGIN))
    depth = corners(casters) @ direction
    # Half a per cent more than the casters' depth, so that rounding puts none beyond the planes.
    span = max(float(np.ptp(depth)), float(half.max()) * 1e-3) * 1.01
    near = (depth.min() + depth.max()) / 2 - span / 2
    matrix = np.zeros((4, 4))
    matrix[:2, :3] = axes[:2] / half[:, None]
    matrix[:2, 3] = -middle / half
    matrix[2, :3] = -direction / span
    matrix[2, 3] = 1 + near / span
    matrix[3, 3] = 1
    return matrix


def _perspective(position: F64, forward: F64, tangent: float, near: float, size: int) -> F64:
    axes = _axes(forward)
    tangent *= size / (size - 2 * MARGIN)
    matrix = np.zeros((4, 4))
    matrix[:2, :3] = axes[:2] / tangent
    matrix[:2, 3] = -axes[:2] @ position / tangent
    matrix[2, 3] = near
    matrix[3, :3] = forward
    matrix[3, 3] = -forward @ position
    return matrix
