"""What stands where around a probe: one ray through the centre of each texel of a map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bake_core.embree import new_rayhit, rays_traced
from bake_core.errors import Cancelled
from bake_core.kernels import CANCELLED, DONE, entry_kernel
from bake_core.octahedral import texel_directions
from bake_core.surfaces import find_surface, surface
from bake_core.tracer import Tracer

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@entry_kernel
def _distance_kernel(t, ray, positions, directions, cancelled, distance, normal, back):  # type: ignore[no-untyped-def]
    """One ray through each direction: distance (inf for a miss), geometric normal towards the probe, whether it met a back face."""
    ray_bits = ray.view(np.uint32)
    for p in range(positions.shape[0]):
        if cancelled[0]:
            return CANCELLED
        for i in range(directions.shape[0]):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            distance[p, i] = np.inf
            normal[p, i, 0] = normal[p, i, 1] = normal[p, i, 2] = 0
            back[p, i] = False
            x, y, z = positions[p, 0], positions[p, 1], positions[p, 2]
            if find_surface(t, ray, ray_bits, x, y, z, dx, dy, dz):
                point, n, _, _, material, front, _, _, _, _ = surface(t, ray_bits, ray, dx, dy, dz)
                x, y, z = point[0] - x, point[1] - y, point[2] - z
                distance[p, i] = math.sqrt(x * x + y * y + z * z)
                normal[p, i, 0], normal[p, i, 1], normal[p, i, 2] = n[0], n[1], n[2]
                back[p, i] = not front and not t.materials.double_sided[material]
    return DONE


def capture_distance(
    tracer: Tracer, positions: F64, resolution: int, *, cancelled: NDArray[np.uint8]
) -> tuple[F64, F32, NDArray[np.bool_], int]:
    """Distances, normals and back faces through texel centres; releases the GIL.

    Parameters
    ----------
    positions : (p, 3) float64
        Metres, local frame.
    resolution : int
        Texels along the map's side.
    cancelled : (1,) uint8

    Returns
    -------
    distance : (p, resolution²) float64
        Metres; inf where nothing is hit.
    normal : (p, resolution², 3) float32
        Geometric, unit, towards the probe; zeros for a miss.
    back : (p, resolution²) bool
        Back face of a single-sided surface.
    rays : int
        Traced for them.

    Raises
    ------
    Cancelled
    """
    directions = texel_directions(resolution).reshape(-1, 3)
    n = len(directions)
    distance, normal = np.empty((len(positions), n)), np.empty((len(positions), n, 3), np.float32)
    back = np.empty((len(positions), n), np.bool_)
    ray = new_rayhit()
    if _distance_kernel(tracer.tables, ray, positions, directions, cancelled, distance, normal, back) == CANCELLED:
        raise Cancelled
    return distance, normal, back, rays_traced(ray)
