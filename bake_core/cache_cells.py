"""The light cache's cells: points that stand together and see one another, averaged."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import uint64
from numpy.typing import NDArray

from bake_core.allocation import HALVES, SCRAMBLES, SCRAMBLES_PER_HALF
from bake_core.cache_points import Points
from bake_core.embree import new_rayhit, rays_traced
from bake_core.kernels import entry_kernel, kernel
from bake_core.light_cache import AXIS_BITS, NONE, LightCache, cell_key, cell_of, find, in_open_plane, sees_middle
from bake_core.tracer import Tables, Tracer

F64 = NDArray[np.float64]
U64 = NDArray[np.uint64]

# Points of either half that make an average worth having. Fewer make more noise, but none that a scramble does not tell of.
FEWEST = 2
# How far above the surface a cell's middle is, in cell sizes; where that is not free, a quarter of it, and a quarter of that.
_HEIGHT = 0.25
_TRIES = 3
# Who stands in one plane with all of a cell's points need not ask whether its middle is seen, if so many times so many places all over that
# plane see it, at the cell's sides and corners too: what crosses the cell hides it from one of them.
_LOOKS = 4
# Cells a thread averages at once.
_CHUNK = 1024


@kernel
def _spread_bits(x):  # type: ignore[no-untyped-def]
    """A cell's number with two zeros after each bit (Morton 1966)."""
    out = uint64(0)
    for bit in range(AXIS_BITS):
        out |= (uint64(x) >> uint64(bit) & uint64(1)) << uint64(3 * bit)
    return out


@entry_kernel
def _codes_kernel(grid, place, way, code):  # type: ignore[no-untyped-def]
    """Numbers by which the points of one cell stand together, whatever its size; NONE beyond the grid."""
    for i in range(code.shape[0]):
        x, y, z, within = cell_of(grid, (place[i, 0], place[i, 1], place[i, 2]))
        morton = _spread_bits(x) | _spread_bits(y) << uint64(1) | _spread_bits(z) << uint64(2)
        code[i] = uint64(way[i]) << uint64(3 * AXIS_BITS) | morton if within else NONE


@kernel
def _place_middle(t, ray, ray_bits, height, s, middle):  # type: ignore[no-untyped-def]
    """A point above another one, with as much room again above it; whether there is one."""
    p, n, epsilon = (s[0], s[1], s[2]), (s[3], s[4], s[5]), s[9]
    for _ in range(_TRIES):
        for axis in range(3):
            middle[axis] = p[axis] + 2 * height * n[axis]
        if sees_middle(t, ray, ray_bits, p, n, epsilon, middle):
            for axis in range(3):
                middle[axis] = p[axis] + height * n[axis]
            middle[3] = height
            return True
        height /= 4
    return False


@kernel
def _is_open(t, ray, ray_bits, grid, level, s, middle):  # type: ignore[no-untyped-def]
    """Whether a cell's middle is seen from all over the plane of one of its points, to the cell's sides and corners."""
    size = grid[3] * 2.0**level
    a = 0
    for axis in range(1, 3):
        if abs(s[3 + axis]) > abs(s[3 + a]):
            a = axis
    b, c = (a + 1) % 3, (a + 2) % 3
    i, j, k, _ = cell_of(grid, (s[0], s[1], s[2]))
    cell = (i >> level, j >> level, k >> level)
    for row in range(_LOOKS):
        for column in range(_LOOKS):
            over_b = grid[b] + (cell[b] + row / (_LOOKS - 1)) * size - s[b]
            over_c = grid[c] + (cell[c] + column / (_LOOKS - 1)) * size - s[c]
            over = (-(s[3 + b] * over_b + s[3 + c] * over_c) / s[3 + a], over_b, over_c)
            # Axis a's is the first of `over`, the next one's the second.
            p = (s[0] + over[(0 - a) % 3], s[1] + over[(1 - a) % 3], s[2] + over[(2 - a) % 3])
            if not sees_middle(t, ray, ray_bits, p, (s[3], s[4], s[5]), s[9], middle):
                return False
    return True


@entry_kernel
def _cells_kernel(t, ray, grid, level, begin, end, place, way, scramble, light, answered, sums, key, known, middle, out):  # type: ignore[no-untyped-def]
    """Average the points of each cell that see its middle, which is above the first of them.

    Parameters
    ----------
    begin, end : (c,) int64
        Where each cell's points begin and end.
    answered : (n,) bool, False
        Becomes true for points in the averages.
    sums : (SCRAMBLES, 4) float64
        To work in.
    """
    ray_bits = ray.view(np.uint32)
    height = _HEIGHT * grid[3] * 2.0**level
    for c in range(known.shape[0]):
        s = place[begin[c]]
        x, y, z, _ = cell_of(grid, (s[0], s[1], s[2]))
        key[c] = cell_key(x, y, z, way[begin[c]], level)
        known[c] = _place_middle(t, ray, ray_bits, height, s, middle[c])
        if not known[c]:
            continue
        sums[:] = 0.0
        fewest = math.inf
        open_plane = True
        for i in range(begin[c], end[c]):
            s = place[i]
            p, n = (s[0], s[1], s[2]), (s[3], s[4], s[5])
            open_plane = open_plane and in_open_plane(p, n, middle[c])
            if sees_middle(t, ray, ray_bits, p, n, s[9], middle[c]):
                for channel in range(3):
                    sums[scramble[i], channel] += light[i, channel]
                sums[scramble[i], 3] += 1
                answered[i] = True
            else:
                open_plane = False
        for half in range(HALVES):
            own = half * SCRAMBLES_PER_HALF
            red = green = blue = count = 0.0
            for g in range(own, own + SCRAMBLES_PER_HALF):
                red += sums[g, 0]
                green += sums[g, 1]
                blue += sums[g, 2]
                count += sums[g, 3]
            fewest = min(fewest, count)
            if count >= FEWEST:
                red, green, blue = red / count, green / count, blue / count
                # A scramble's own mean would need points of its own in every cell. It differs from its half's mean as the sums do, to first
                # order (the linearised variance of a ratio; Cochran 1977, "Sampling Techniques", section 6.4), and is then as far from it,
                # in the mean, as n independent points' mean is from the truth.
                scale = SCRAMBLES_PER_HALF / count * math.sqrt(count / (count - 1))
                for g in range(own, own + SCRAMBLES_PER_HALF):
                    out[c, g, 0] = red + scale * (sums[g, 0] - sums[g, 3] * red)
                    out[c, g, 1] = green + scale * (sums[g, 1] - sums[g, 3] * green)
                    out[c, g, 2] = blue + scale * (sums[g, 2] - sums[g, 3] * blue)
        known[c] = fewest >= FEWEST
        if not known[c]:
            answered[begin[c] : end[c]] = False
        elif not (open_plane and _is_open(t, ray, ray_bits, grid, level, place[begin[c]], middle[c])):
            middle[c, 3] = 0.0


@entry_kernel
def _table_kernel(keys, table):  # type: ignore[no-untyped-def]
    for c in range(keys.shape[0]):
        place, _ = find(table, keys[c])
        table[place, 0], table[place, 1] = keys[c], uint64(c)


def codes(grid: F64, points: Points) -> U64:
    """(n,) uint64 by which points of one cell stand together: of cells of level k, where they agree but for their last 3 k bits."""
    code = np.empty(len(points), np.uint64)
    _codes_kernel(grid, points.place, points.way, code)
    return code


def average(tracer: Tracer, points: Points, paths: int, grid: F64, *, threads: int) -> tuple[LightCache, int]:
    """A cache of what points know, and the rays that it took to ask who sees whom; the same bits for any number of threads.

    Parameters
    ----------
    paths : int
        That each point's light is a sum over.
    grid : (8,) float64
        As :class:`bake_core.light_cache.LightCache` has it.
    """
    tables = tracer.tables._replace(cache=None)
    code = codes(grid, points)
    # Stable: points of a cell stay in the order in which they were found.
    order = np.argsort(code, kind="stable")[: int((code != NONE).sum())]
    code = code[order]
    points, levels, rays = points[order], [], 0
    for level in range(int(grid[4])):
        cells, answered, traced = _level(tables, code, points, paths, grid, level, threads)
        rays += traced
        levels.append(cells)
        # Who asks a larger cell has not been answered by a smaller one, as who stands in a crevice may not; so no more are its points.
        code, points = code[~answered], points[~answered]
    keys, middle, light = (np.concatenate(parts) for parts in zip(*levels, strict=True))
    table = np.full((1 << max(2 * len(keys), 16).bit_length(), 2), NONE)
    _table_kernel(keys, table)
    return LightCache(grid, table, middle, light), rays


def _level(
    tables: Tables, code: U64, points: Points, paths: int, grid: F64, level: int, threads: int
) -> tuple[tuple[U64, F64, NDArray[np.float32]], NDArray[np.bool_], int]:
    """Keys, middles and light of the cells of one size that know any; whose points they answer; and rays."""
    edges = np.flatnonzero(np.diff(code >> np.uint64(3 * level), prepend=NONE, append=NONE))
    enough = np.flatnonzero(np.diff(edges) >= HALVES * FEWEST)
    begin, end, n = edges[enough], edges[enough + 1], len(enough)
    key, known, middle = np.empty(n, np.uint64), np.empty(n, np.bool_), np.empty((n, 4))
    light, answered = np.empty((n, SCRAMBLES, 3), np.float32), np.zeros(len(points), np.bool_)
    radiance = (points.light / paths).astype(np.float32)

    def some(first: int) -> int:
        ray = new_rayhit()
        part, sums = slice(first, first + _CHUNK), np.zeros((SCRAMBLES, 4))
        asked = (begin[part], end[part], points.place, points.way, points.scramble, radiance, answered, sums)
        _cells_kernel(tables, ray, grid, level, *asked, key[part], known[part], middle[part], light[part])
        return rays_traced(ray)

    with ThreadPoolExecutor(threads) as pool:
        rays = sum(pool.map(some, range(0, max(n, 1), _CHUNK)))
    return (key[known], middle[known], light[known]), answered, rays
