"""Probes moved towards the walls whose light they tell.

Between the probe that is nearest to a wall and the wall there is no other to interpolate with: that probe alone answers, up to a whole
cell away. The nearer to the wall it stands, the better it answers there; and the worse in the cell behind it. What is asked for lies on
surfaces: on the wall itself, all of it at the distance d, and on others that cross it, spread over all distances. Where irradiance is
linear along the axis, with slope b, a probe of lattice point 0 that has moved by m towards the wall errs by b (d - m) on it, by b (x - m)
on what crosses for 0 < x < d, and behind, over a spacing s, by b m (1 + x/s) at most, as if it were still taken to stand on the lattice.
With half as much of the wall as of one surface that crosses it, over a spacing, the sum of the squares,

    b² [ s (d - m)² / 2 + ((d - m)³ + m³ + s m²) / 3 ],

is least where (d - m)² - m² - 2/3 s m + s (d - m) = 0, which is m = 3 d (d + s) / (6 d + 5 s): 0.28 s for a wall half a cell off, and never
more than three fifths of the way. A probe between two walls that are both nearer than its neighbours answers for all between them,
best from the middle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bake_core.embree import new_rayhit
from bake_core.kernels import entry_kernel, kernel
from bake_core.placement import Volume
from bake_core.surfaces import blocked, find_surface, surface
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]

# Of a spacing: no probe moves farther along an axis.
FARTHEST = 0.45
# How far to the sides the rays beside an axis go for each step along it, and by which part of its distance a wall may be farther off there.
_BESIDE, _FLAT = 0.25, 0.25


def relocate(tracer: Tracer, volumes: Sequence[Volume], positions: F64) -> NDArray[np.float32]:
    """Offsets of all probes from their lattice points.

    Parameters
    ----------
    volumes : sequence of Volume
    positions : (n, 3) float64
        Lattice points of all volumes' probes in turn, local frame.

    Returns
    -------
    (n, 3) float32
        Metres, at most :data:`FARTHEST` of the spacing along each axis. 0 for a probe that would have to go through something.

    Notes
    -----
    A wall is what a ray along an axis meets within a spacing, from the front or from either side where it is double-sided, and does not
    let pass rays beside it: one of two across is stopped in about the same plane or before, and one of two the other way across. So an
    edge of a box is a wall. Columns and leaves are none and draw nobody, but a probe between one and a wall stands in the middle. What is
    met from behind says that the probe stands inside a solid, and draws it nowhere.
    """
    spacing = np.concatenate([np.broadcast_to(v.spacing, (v.probe_count, 3)) for v in volumes])
    met = np.empty((len(positions), 3, 2, 5))
    _meet_kernel(tracer.tables, new_rayhit(), np.ascontiguousarray(positions), np.empty(3), met)
    straight = np.where(met[..., 0] < spacing[:, :, None], met[..., 0], np.inf)
    anything = np.isfinite(straight)
    # In the first place, so that no inf is taken from another.
    ahead = np.where(anything, straight, 0)
    stopped = met[..., 1:] <= (1 + _FLAT) * ahead[..., None]
    wall = anything & stopped.reshape(*stopped.shape[:-1], 2, 2).any(-1).all(-1)
    offsets = np.zeros_like(positions)
    for side, sign in ((0, -1), (1, 1)):
        d = np.where(wall[..., side] & ~anything[..., 1 - side], ahead[..., side], 0)
        offsets += sign * 3 * d * (d + spacing) / (6 * d + 5 * spacing)
    between = anything.all(-1) & wall.any(-1)
    offsets[between] = (ahead[..., 1] - ahead[..., 0])[between] / 2
    offsets = np.clip(offsets, -FARTHEST * spacing, FARTHEST * spacing)
    moved = np.flatnonzero(offsets.any(-1))
    # Nor may anything stand a quarter as far again behind its end.
    stuck = moved[~is_free(tracer, positions[moved], 1.25 * offsets[moved])]
    offsets[stuck] = 0
    return offsets.astype(np.float32)


def is_free(tracer: Tracer, origins: F64, ways: F64) -> NDArray[np.bool_]:
    """Whether nothing lies on straight ways, (n, 3) metres, from origins, (n, 3), local frame; (n,) bool."""
    free = np.empty(len(origins), np.bool_)
    _free_kernel(tracer.tables, new_rayhit(), np.ascontiguousarray(origins), np.ascontiguousarray(ways), free)
    return free


@kernel
def _distance_to_plane(t, ray, ray_bits, p, direction, axis):  # type: ignore[no-untyped-def]
    """How far along an axis the front of a surface lies that a ray meets, (3,) direction not unit; inf where there is none, or its back."""
    length = math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    dx, dy, dz = direction[0] / length, direction[1] / length, direction[2] / length
    if find_surface(t, ray, ray_bits, p[0], p[1], p[2], dx, dy, dz):
        hit, _, _, _, material, front, _, _, _, _ = surface(t, ray_bits, ray, dx, dy, dz)
        if front or t.materials.double_sided[material]:
            return abs(hit[axis] - p[axis])
    return np.inf


@entry_kernel
def _meet_kernel(t, ray, positions, direction, met):  # type: ignore[no-untyped-def]
    """What rays along each axis, down and up, and the four beside each meet, as :func:`_distance_to_plane`, (n, 3, 2, 5)."""
    ray_bits = ray.view(np.uint32)
    for p in range(positions.shape[0]):
        for axis in range(3):
            for side in range(2):
                direction[:] = 0.0
                direction[axis] = 2.0 * side - 1.0
                met[p, axis, side, 0] = _distance_to_plane(t, ray, ray_bits, positions[p], direction, axis)
                for beside in range(4):
                    across = (axis + 1 + beside // 2) % 3
                    direction[across] = _BESIDE if beside % 2 else -_BESIDE
                    met[p, axis, side, 1 + beside] = _distance_to_plane(t, ray, ray_bits, positions[p], direction, axis)
                    direction[across] = 0.0


@entry_kernel
def _free_kernel(t, ray, origins, ways, free):  # type: ignore[no-untyped-def]
    ray_bits = ray.view(np.uint32)
    for i in range(origins.shape[0]):
        x, y, z = origins[i, 0], origins[i, 1], origins[i, 2]
        free[i] = not blocked(t, ray, ray_bits, x, y, z, ways[i, 0], ways[i, 1], ways[i, 2], np.float32(1))
