"""Where the light cache learns: points that probes see, and the light that reaches them.

Points are found where the cache will be read most, by rays from the probes in all directions. At each, paths leave by the cosine, one
after another of one sequence; a path that meets what an earlier cache knows ends there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.allocation import SCRAMBLES
from bake_core.cache_guide import PARTS, Guide, guided, sums
from bake_core.embree import new_rayhit, rays_traced
from bake_core.errors import Cancelled
from bake_core.kernels import CANCELLED, DONE, entry_kernel
from bake_core.light_cache import facing
from bake_core.materials import is_glossy
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.surfaces import find_surface, surface
from bake_core.textures import reflectance
from bake_core.tracer import Tracer
from bake_core.transport import trace_by_cosine

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flag = NDArray[np.uint8]

# Rays a thread takes at once: tens of milliseconds' work.
_CHUNK = 8192
_CHUNK_PATHS = 1 << 15
# Where a ray that found no point has ended: nowhere, or at a surface that is of no use.
_MISSED, _UNSUITED = 255, 254


@dataclass(frozen=True)
class Points:
    """Points on matt surfaces, in the order in which they were looked for.

    Attributes
    ----------
    place : (n, 10) float64
        Local frame: point, geometric and shading normal, and how far to leave the surface.
    way : (n,) uint8
        Which way the surface faces (:func:`bake_core.light_cache.facing`).
    key : (n,) uint64
        What makes a point's random numbers its own.
    scramble : (n,) uint8
        Whose it is.
    light : (n, 3) float64
        Sums over the paths from it, of ∫ L cosθ dω / π as :class:`bake_core.light_cache.LightCache` means it.
    """

    place: F64
    way: NDArray[np.uint8]
    key: NDArray[np.uint64]
    scramble: NDArray[np.uint8]
    light: F64

    def __len__(self) -> int:
        return len(self.way)

    def __add__(self, more: Points) -> Points:
        return Points(*(np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self)))

    def __getitem__(self, which: NDArray[Any] | slice) -> Points:
        """Some of them, in another order where an order is given."""
        return Points(*(getattr(self, f.name)[which] for f in fields(self)))

    @classmethod
    def none(cls) -> Self:
        small = np.zeros(0, np.uint8)
        return cls(np.zeros((0, 10)), small, np.zeros(0, np.uint64), small, np.zeros((0, 3)))


@entry_kernel
def _points_kernel(t, ray, positions, first, first_round, rounds, seed, cancelled, place, way, key):  # type: ignore[no-untyped-def]
    """One ray each, from probe after probe, scramble after scramble, round after round; `first` is the number of the first of them."""
    ray_bits = ray.view(np.uint32)
    for i in range(way.shape[0]):
        if cancelled[0]:
            return CANCELLED
        number = first + i
        probe = number // (SCRAMBLES * rounds)
        scramble = number // rounds % SCRAMBLES
        index = first_round + number % rounds
        look = mix64(mix64(seed ^ mix64(uint64(probe))) + uint64(scramble))
        u, v = sobol_pair(reverse_bits(uint32(index)), look)
        dz = 1 - 2 * np.float64(v)
        across = math.sqrt(max(1 - dz * dz, 0.0))
        dx, dy = across * math.cos(2 * math.pi * u), across * math.sin(2 * math.pi * u)
        way[i] = _MISSED
        if not find_surface(t, ray, ray_bits, positions[probe, 0], positions[probe, 1], positions[probe, 2], dx, dy, dz):
            continue
        s = surface(t, ray_bits, ray, dx, dy, dz)
        p, n, epsilon, _, material, front, _, _, _, _ = s
        way[i] = _UNSUITED
        red, green, blue, metallic, roughness = reflectance(t, s, 0.0, 1.0)
        seen = front or t.materials.double_sided[material]
        if not seen or is_glossy(t, metallic, roughness) or max(red, green, blue) <= 0:
            continue
        way[i] = facing(n[3], n[4], n[5])
        key[i] = mix64(look + uint64(index + 1) * uint64(0xD1B54A32D192ED03))
        for axis in range(3):
            place[i, axis] = p[axis]
        for axis in range(6):
            place[i, 3 + axis] = n[axis]
        place[i, 9] = epsilon
    return DONE


@entry_kernel
def _gather_kernel(t, ray, place, key, scramble, guide, row, first_path, paths, cancelled, light, part, brought):  # type: ignore[no-untyped-def]
    """Some more paths from each point, of which it has had `first_path`.

    Parameters
    ----------
    guide : (g, PARTS, PARTS + 1) float32
        :meth:`bake_core.cache_guide.Guide.table`.
    row : (n,) int64
        Each point's in the guide; below 0 where it has none.
    light : (n, 3) float64, added to
    part, brought : (n, paths) uint8 and (n, paths, 2) float64, or (n, 0) and (n, 0, 2)
        As :func:`bake_core.cache_guide.sums` takes them.
    """
    ray_bits = ray.view(np.uint32)
    for i in range(place.shape[0]):
        if cancelled[0]:
            return CANCELLED
        s = place[i]
        p, n = (s[0], s[1], s[2]), (s[3], s[4], s[5], s[6], s[7], s[8])
        red = green = blue = 0.0
        for path in range(first_path, first_path + paths):
            index = uint32(path)
            reversed_index = reverse_bits(index)
            u, v = sobol_pair(reversed_index, key[i])
            weight = 1.0
            if row[i] >= 0:
                u, v, weight = guided(guide[row[i]], u, v)
            r, g, b = trace_by_cosine(t, ray, ray_bits, p, n, s[9], u, v, reversed_index, index, key[i], True, scramble[i])
            red += weight * r
            green += weight * g
            blue += weight * b
            if part.shape[1]:
                part[i, path - first_path] = int(u * PARTS) * PARTS + int(v * PARTS)
                brought[i, path - first_path, 0] = weight * (r + g + b) ** 2
                brought[i, path - first_path, 1] = weight
        light[i, 0] += red
        light[i, 1] += green
        light[i, 2] += blue
    return DONE


class Found(NamedTuple):
    """What rays from probes have met: points, in the dark as yet; how many rays met any surface at all; and how many there were."""

    points: Points
    met: int
    rays: int


def find_points(tracer: Tracer, positions: F64, rounds: tuple[int, int], seed: int, *, threads: int, cancelled: Flag) -> Found:
    """Rays from every probe in all directions, for every scramble; the same bits for any number of threads.

    Parameters
    ----------
    positions : (p, 3) float64
        Probes, local frame.
    rounds : (int, int)
        Half-open range of rays of each probe and scramble.

    Returns
    -------
    Found
        Its points are where the rays met a matt surface that reflects anything.

    Raises
    ------
    Cancelled
    """
    each = rounds[1] - rounds[0]
    n = len(positions) * SCRAMBLES * each
    place, way, key = np.zeros((n, 10)), np.empty(n, np.uint8), np.zeros(n, np.uint64)

    def some(ray: F32, first: int) -> int:
        part = slice(first, first + _CHUNK)
        wanted = (positions, first, rounds[0], each, np.uint64(seed))
        return int(_points_kernel(tracer.tables, ray, *wanted, cancelled, place[part], way[part], key[part]))

    rays = sum(traced for _, traced in _on_threads(some, range(0, max(n, 1), _CHUNK), threads))
    suited = way < _UNSUITED
    scramble = (np.arange(n) // each % SCRAMBLES).astype(np.uint8)
    points = Points(place[suited], way[suited], key[suited], scramble[suited], np.zeros((int(suited.sum()), 3)))
    return Found(points, int((way != _MISSED).sum()), rays)


def gather_light(
    tracer: Tracer, points: Points, guide: Guide, rows: I64, paths: tuple[int, int], *, teach: bool, threads: int, cancelled: Flag
) -> int:
    """Add what paths bring to every point's light; the same bits for any number of threads.

    Parameters
    ----------
    tracer : Tracer
        With the cache that paths may end in.
    guide : Guide
        Where paths go.
    rows : (n,) int64
        Each point's in it.
    paths : (int, int)
        Half-open range of paths from each point.
    teach : bool
        Whether the guide hears of them, once all are traced that were sent by it.

    Returns
    -------
    int
        Rays that it took.

    Raises
    ------
    Cancelled
    """
    count = paths[1] - paths[0]
    step = max(_CHUNK_PATHS // max(count, 1), 1)
    table, heard = guide.table(), {}

    def some(ray: F32, first: int) -> int:
        at = slice(first, first + step)
        kept = (len(rows[at]), count if teach else 0)
        part, brought = np.zeros(kept, np.uint8), np.zeros((*kept, 2))
        asked = (points.place[at], points.key[at], points.scramble[at], table, rows[at], paths[0], count)
        status = int(_gather_kernel(tracer.tables, ray, *asked, cancelled, points.light[at], part, brought))
        heard[first] = sums(rows[at], part, brought)
        return status

    rays = 0
    for first, traced in _on_threads(some, range(0, max(len(points), 1), step), threads):
        rays += traced
        guide.hear(heard.pop(first))
    return rays


def _on_threads(some: Callable[[F32, int], int], firsts: range, threads: int) -> Iterator[tuple[int, int]]:
    """Run a kernel for each of some beginnings: these in their order, and how many rays each took."""

    def run(first: int) -> int:
        ray = new_rayhit()
        if some(ray, first) == CANCELLED:
            raise Cancelled
        return rays_traced(ray)

    with ThreadPoolExecutor(threads) as pool:
        yield from zip(firsts, pool.map(run, firsts), strict=True)
