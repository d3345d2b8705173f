"""Receivers: points drawn on the scene's surfaces inside the volumes, where a bundle's answers are held against the truth.

They are uniform over the area of all surfaces that a user can get to see: both sides of double-sided ones, and those that emit or reflect
nothing too, for a query does not know what it is asked for, and a figure should not change with a texture. Two kinds of surface are left
out, for whatever a bundle answers there never shows:

- behind other surfaces: a floor under a box, or a wall below the ground, looks at back faces;
- seen by no probe, not even around one corner: the inside of a closed slab whose faces are double-sided, where there is no back face to
  tell. A sealed room is another thing: it holds probes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import uint32, uint64
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.embree import new_rayhit
from bake_core.errors import Cancelled
from bake_core.kernels import entry_kernel, kernel
from bake_core.materials import sample_lambert
from bake_core.placement import cover
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.scene import Scene
from bake_core.surface_sampling import Places, SurfaceSampler
from bake_core.surfaces import INVALID, blocked, find_surface, surface
from bake_core.tally import BACKFACE_LIMIT
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# Rays by which a point finds out where it is: 16 of them make up the limit for back faces, and a nook that fewer than one in 64 leave
# is no place where a bundle's light matters.
_RAYS = 64
# Places drawn for each receiver asked for, before fewer are handed back: surfaces nearly all of which nobody sees.
_MOST_DRAWS = 16
# A wall half a spacing from the outermost probes belongs to the volume, whichever way its coordinates are rounded: this much of a cell.
_SLACK = 1e-5
_KEPT, _BEHIND, _UNSEEN, _CANCELLED = 0, 1, 2, 3


@dataclass(frozen=True)
class Receivers:
    """Points on surfaces, and how many others were drawn and left out on the way.

    Attributes
    ----------
    positions : (n, 3) float64
        World, metres; in the triangle's plane.
    normals, geometric_normals : (n, 3) float64
        Interpolated and the triangle's own; unit, on the side that is looked at.
    materials : (n,) int64
        Into the scene's.
    places : Places
        Which triangle, and where on it.
    behind, unseen : int
        Left out, because they look at back faces or because no probe sees them.
    """

    positions: F64
    normals: F64
    geometric_normals: F64
    materials: I64
    places: Places
    behind: int
    unseen: int

    def __len__(self) -> int:
        return len(self.positions)


class _Probes(NamedTuple):
    """Where probes stand, local frame.

    Attributes
    ----------
    grids : (v, 2, 3) float64
        Origin and spacing of each volume.
    counts : (v, 3) int64
    first : (v + 1,) int64
        Each volume's first probe.
    positions : (p, 3) float64
        Of every probe of every volume, in flat order, with its offset.
    active : (p,) bool
    """

    grids: F64
    counts: I64
    first: I64
    positions: F64
    active: NDArray[np.bool_]


def volume_boxes(volumes: Sequence[VolumeData]) -> F64:
    """Where a bundle's light can be held against the truth, (v, 2, 3), world: as :func:`bake_core.irradiance.covered` has it."""
    boxes = []
    for v in volumes:
        reach = cover(v.spacing) + _SLACK * v.spacing
        boxes.append([v.origin - reach, v.origin + (v.counts - 1) * v.spacing + reach])
    return np.array(boxes).reshape(-1, 2, 3)


def draw_receivers(
    scene: Scene,
    tracer: Tracer,
    volumes: Sequence[VolumeData],
    count: int,
    seed: int,
    *,
    boxes: ArrayLike | None = None,
    cancelled: NDArray[np.uint8] | None = None,
) -> Receivers:
    """Points uniform over the area of the surfaces inside some boxes that can be seen.

    Parameters
    ----------
    volumes : sequence of VolumeData
        Whose probes must see them.
    count : int
        How many; fewer come back where there is no such surface, or hardly any.
    seed : int
        The same points every time.
    boxes : (b, 2, 3) float, optional
        Lowest and highest corners, world, metres; default: :func:`volume_boxes`.
    cancelled : (1,) uint8, optional

    Raises
    ------
    Cancelled
    """
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    sampler = SurfaceSampler(scene, tracer, volume_boxes(volumes) if boxes is None else boxes, seed, flag)
    probes = _probe_table(volumes, scene.origin)
    # An empty first part, so that there is always something to join.
    parts = [_inspected(tracer, sampler.draw(0, 0), probes, seed, flag)]
    kept = round_ = 0
    while sampler.area > 0 and kept < count and round_ < _MOST_DRAWS:
        places, found, materials, verdicts = _inspected(tracer, sampler.draw(round_ * count, count), probes, seed + round_, flag)
        good = np.flatnonzero(verdicts == _KEPT)
        # Up to the last one that is needed, and no further: what was left out is counted over the same places.
        end = good[count - kept - 1] + 1 if kept + len(good) >= count else len(verdicts)
        parts.append((places.some(slice(end)), found[:end], materials[:end], verdicts[:end]))
        kept += min(len(good), count - kept)
        round_ += 1
    places = Places(*(np.concatenate(column) for column in zip(*(part[0] for part in parts), strict=True)))
    found, materials, verdicts = (np.concatenate(column) for column in zip(*(part[1:] for part in parts), strict=True))
    good = verdicts == _KEPT
    position, geometric, shading = found[good, :3] + scene.origin, found[good, 3:6], found[good, 6:]
    behind, unseen = int((verdicts == _BEHIND).sum()), int((verdicts == _UNSEEN).sum())
    return Receivers(position, shading, geometric, materials[good], places.some(good), behind, unseen)


def _inspected(tracer: Tracer, places: Places, probes: _Probes, seed: int, flag: NDArray[np.uint8]) -> tuple[Places, F64, I64, I64]:
    """Places with position and normals (n, 9), local frame, material, and whether they count."""
    n = len(places.items)
    found, materials, verdicts = np.empty((n, 9)), np.empty(n, np.int64), np.empty(n, np.int64)
    if _inspect(tracer.tables, new_rayhit(), places, probes, np.uint64(seed), flag, found, materials, verdicts) == _CANCELLED:
        raise Cancelled
    return places, found, materials, verdicts


def _probe_table(volumes: Sequence[VolumeData], origin: F64) -> _Probes:
    grids = np.array([[v.origin - origin, v.spacing] for v in volumes], np.float64).reshape(-1, 2, 3)
    counts = np.array([v.counts for v in volumes], np.int64).reshape(-1, 3)
    first = np.cumsum([0] + [len(v.states) for v in volumes])
    positions, active = np.empty((first[-1], 3)), np.empty(first[-1], np.bool_)
    for v, start, end in zip(volumes, first[:-1], first[1:], strict=True):
        positions[start:end] = v.positions() - origin
        active[start:end] = v.states == 1
    return _Probes(grids, counts, first, positions, active)


@kernel
def stand_on(t, ray, ray_bits, places, i):  # type: ignore[no-untyped-def]
    """What :func:`bake_core.surfaces.surface` says of a place, as if a ray had just met it on that side.

    Returns
    -------
    3, 6, 1 float64, int
        Point, geometric and shading normal, how far to leave the surface, material.
    """
    ray[15], ray[16] = places.barycentrics[i, 0], places.barycentrics[i, 1]
    ray_bits[17], ray_bits[18], ray_bits[19] = places.triangles[i], places.items[i], INVALID
    p, n, epsilon, _, material, _, _, _, _, _ = surface(t, ray_bits, ray, 0.0, 0.0, 0.0)
    # Without a direction every hit is taken for one from behind, and the normals are turned round.
    if not places.back[i]:
        n = (-n[0], -n[1], -n[2], -n[3], -n[4], -n[5])
    return p, n, epsilon, material


@entry_kernel
def _stand(t, ray, places, stands):  # type: ignore[no-untyped-def]
    """Fill in what :func:`stand_on` says of places, (n, 10): point, geometric and shading normal, how far to leave the surface."""
    ray_bits = ray.view(np.uint32)
    for i in range(stands.shape[0]):
        p, n, epsilon, _ = stand_on(t, ray, ray_bits, places, i)
        for axis in range(3):
            stands[i, axis], stands[i, 3 + axis], stands[i, 6 + axis] = p[axis], n[axis], n[3 + axis]
        stands[i, 9] = epsilon
    return 0


def stands_of(tracer: Tracer, places: Places) -> F64:
    """(n, 10) float64, local frame: point, geometric and shading normal, and how far to leave the surface."""
    out = np.empty((len(places.items), 10))
    _stand(tracer.tables, new_rayhit(), places, out)
    return out


@kernel
def _sees_a_probe(t, ray, ray_bits, p, n, epsilon, probes):  # type: ignore[no-untyped-def]
    """Whether any active probe of the cell around a point, the nearest cell where it is outside, has a free view of it from the front."""
    x, y, z = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    for v in range(probes.counts.shape[0]):
        counts = probes.counts[v]
        for corner in range(8):
            probe, stride = probes.first[v], 1
            for axis in range(3):
                g = (p[axis] - probes.grids[v, 0, axis]) / probes.grids[v, 1, axis]
                base = np.int64(np.floor(min(max(g, 0.0), max(counts[axis] - 2.0, 0.0))))
                probe += stride * min(base + (corner >> axis & 1), counts[axis] - 1)
                stride *= counts[axis]
            if not probes.active[probe]:
                continue
            q = probes.positions[probe]
            dx, dy, dz = q[0] - x, q[1] - y, q[2] - z
            if dx * n[0] + dy * n[1] + dz * n[2] > 0 and not blocked(t, ray, ray_bits, x, y, z, dx, dy, dz, np.float32(1)):
                return True
    return False


@entry_kernel
def _inspect(t, ray, places, probes, seed, cancelled, found, materials, verdicts):  # type: ignore[no-untyped-def]
    """Where places are and whether they count: found (n, 9) holds position, geometric and shading normal, local frame."""
    ray_bits = ray.view(np.uint32)
    for i in range(found.shape[0]):
        if cancelled[0]:
            return _CANCELLED
        p, n, epsilon, material = stand_on(t, ray, ray_bits, places, i)
        for axis in range(3):
            found[i, axis], found[i, 3 + axis], found[i, 6 + axis] = p[axis], n[axis], n[3 + axis]
        materials[i] = material
        seen = _sees_a_probe(t, ray, ray_bits, p, n, epsilon, probes)
        behind = 0
        key = mix64(mix64(seed) + uint64(i))
        for k in range(_RAYS):
            u, v = sobol_pair(reverse_bits(uint32(k)), key)
            dx, dy, dz = sample_lambert(u, v, n)
            x, y, z = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
            if not find_surface(t, ray, ray_bits, x, y, z, dx, dy, dz):
                continue
            q, m, offset, _, hit, front, _, _, _, _ = surface(t, ray_bits, ray, dx, dy, dz)
            if not front and not t.materials.double_sided[hit]:
                behind += 1
            elif not seen:
                seen = _sees_a_probe(t, ray, ray_bits, q, m, offset, probes)
        verdicts[i] = _BEHIND if behind >= BACKFACE_LIMIT * _RAYS else _KEPT if seen else _UNSEEN
    return 0
