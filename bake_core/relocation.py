"""Probes moved towards the walls whose light they tell.

Between the probe that is nearest to a wall and the wall there is no other to interpolate with: that probe alone answers, up to a whole
cell away. The nearer to the wall it stands, the better it answers there; and the worse in the cell behind it, to which its light is still
taken to be that of the lattice point. Where irradiance is linear along the axis, with slope b, a probe of lattice point 0 that has moved by
m towards a wall at d errs by b (x - m) for 0 < x < d, and behind it, over a spacing s, by b m (1 + x/s). The integral of both squares,

    b² [ (d - m)³ + m³ + s m² ] / 3,

is least where 3 (m² - (d - m)²) + 2 s m = 0, which is m = 3 d² / (6 d + 2 s): 0.15 s for a wall half a cell off, 3/8 s at most. A probe
between two walls that are both nearer than its neighbours answers for all between them, best from the middle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bake_core.embree import new_rayhit
from bake_core.kernels import entry_kernel
from bake_core.placement import Volume
from bake_core.surfaces import blocked, find_surface, surface
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]

# Of a spacing: no probe moves farther along an axis.
FARTHEST = 0.45


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
    A wall is what a ray along an axis meets within a spacing, from the front, or from either side where it is double-sided. What it meets
    from behind says that the probe stands inside a solid, and draws it nowhere.
    """
    spacing = np.concatenate([np.broadcast_to(v.spacing, (v.probe_count, 3)) for v in volumes])
    walls = np.full((len(positions), 3, 2), np.inf)
    _walls_kernel(tracer.tables, new_rayhit(), np.ascontiguousarray(positions), walls)
    walls[walls >= spacing[:, :, None]] = np.inf
    low, high = walls[..., 0], walls[..., 1]
    offsets = np.zeros_like(positions)
    for near, far, sign in ((high, low, 1), (low, high, -1)):
        alone = np.isfinite(near) & ~np.isfinite(far)
        d = np.where(alone, near, 0)
        offsets += np.where(alone, sign * 3 * d * d / (6 * d + 2 * spacing), 0)
    between = np.isfinite(low) & np.isfinite(high)
    offsets[between] = (high[between] - low[between]) / 2
    offsets = np.clip(offsets, -FARTHEST * spacing, FARTHEST * spacing)
    free = np.ones(len(positions), np.bool_)
    _free_kernel(tracer.tables, new_rayhit(), np.ascontiguousarray(positions), np.ascontiguousarray(offsets), free)
    return np.where(free[:, None], offsets, 0).astype(np.float32)


@entry_kernel
def _walls_kernel(t, ray, positions, walls):  # type: ignore[no-untyped-def]
    """Distance to the nearest surface along each axis, down and up, (n, 3, 2); inf where there is none, or its back."""
    ray_bits = ray.view(np.uint32)
    for p in range(positions.shape[0]):
        for axis in range(3):
            for side in range(2):
                sign = 2.0 * side - 1.0
                dx, dy, dz = sign * (axis == 0), sign * (axis == 1), sign * (axis == 2)
                if find_surface(t, ray, ray_bits, positions[p, 0], positions[p, 1], positions[p, 2], dx, dy, dz):
                    hit, _, _, _, material, front, _, _, _, _ = surface(t, ray_bits, ray, dx, dy, dz)
                    if front or t.materials.double_sided[material]:
                        walls[p, axis, side] = abs(hit[axis] - positions[p, axis])


@entry_kernel
def _free_kernel(t, ray, positions, offsets, free):  # type: ignore[no-untyped-def]
    """Whether nothing is on the way, nor as far again behind its end."""
    ray_bits = ray.view(np.uint32)
    for p in range(positions.shape[0]):
        dx, dy, dz = 2 * offsets[p, 0], 2 * offsets[p, 1], 2 * offsets[p, 2]
        if dx != 0 or dy != 0 or dz != 0:
            free[p] = not blocked(t, ray, ray_bits, positions[p, 0], positions[p, 1], positions[p, 2], dx, dy, dz, np.float32(1))
