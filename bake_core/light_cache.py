"""A cache of indirect light on surfaces, as paths read it: one that knows the rest of a path ends it.

The light that reaches a matt surface, but for what next-event estimation draws there, is averaged in the cells of a grid, apart for each
way that the surface faces: path space filtering in a hash grid (Binder, Fricke and Keller 2018, "Fast Path Space Filtering by Jittered
Spatial Hashing"), of what varies slowly over a surface (Ward, Rubinstein and Clear 1988, "A Ray Tracing Solution for Diffuse
Interreflection"). A cell is read only from where its middle can be seen, so that no wall is read through.

Cells are of several sizes, each twice the one before; the smallest that knows an answer gives it. :mod:`bake_core.cache_cells` fills them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint64
from numpy.typing import NDArray

from bake_core.kernels import either, kernel
from bake_core.sampling import mix64
from bake_core.surfaces import blocked

F64 = NDArray[np.float64]

# Ways to face: each side of a cube in 3 × 3 parts, so that axis-aligned walls lie in the middle of one.
_PARTS = 3
# Bits of a cell's number along one axis.
AXIS_BITS = 17
AXIS_CELLS = 1 << AXIS_BITS
# As far above or below a plane, of the height of a cell's middle, a point may be and count as in it.
_FLAT = 1 / 64
# An empty place in the table.
NONE = np.uint64(0xFFFFFFFFFFFFFFFF)


class LightCache(NamedTuple):
    """What kernels read; few arrays, for every one more is handed on with every call inside a path (twelve made paths three times as slow).

    Attributes
    ----------
    grid : (8,) float64
        The grid's lower corner, local frame; the size of the smallest cells, metres; how many sizes there are; the first and the last
        vertex of a path that it answers at: where bounces are limited that is only one, for what is known of light that bounces so often
        is not what is asked for after another bounce; and how many times its size a cell must be away from where a ray comes from.
    table : (2^k, 2) uint64
        A hash table with linear probing (Knuth 1998, "The Art of Computer Programming" 3, section 6.4): :func:`cell_key`, or NONE where
        it is empty, and the row of the cell.
    middle : (n, 4) float64
        A point above each cell's surface, local frame: whoever does not see it is not answered. And how high it is above the plane that
        sees it from all over the cell: whoever is in that plane need not ask. 0 where there is none.
    light : (n, SCRAMBLES, 3) float32
        By scramble, ∫ L cosθ dω / π over what next-event estimation leaves of it, its share by the balance heuristic.
    """

    grid: F64
    table: NDArray[np.uint64]
    middle: F64
    light: NDArray[np.float32]


def empty_cache(scrambles: int) -> LightCache:
    """A cache that knows nothing."""
    return LightCache(np.zeros(8), np.full((1, 2), NONE), np.zeros((0, 4)), np.zeros((0, scrambles, 3), np.float32))


@kernel
def facing(nx, ny, nz):  # type: ignore[no-untyped-def]
    """Which of 54 ways a unit normal faces."""
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    if ax >= ay and ax >= az:
        side, u, v = 0 if nx > 0 else 1, ny / ax, nz / ax
    elif ay >= az:
        side, u, v = 2 if ny > 0 else 3, nx / ay, nz / ay
    else:
        side, u, v = 4 if nz > 0 else 5, nx / az, ny / az
    row = min(int((u + 1) * (0.5 * _PARTS)), _PARTS - 1)
    column = min(int((v + 1) * (0.5 * _PARTS)), _PARTS - 1)
    return (side * _PARTS + row) * _PARTS + column


@kernel
def cell_of(grid, p):  # type: ignore[no-untyped-def]
    """The three numbers of the smallest cell about a point, and whether the grid reaches so far."""
    x, y, z = (p[0] - grid[0]) / grid[3], (p[1] - grid[1]) / grid[3], (p[2] - grid[2]) / grid[3]
    within = min(x, y, z) >= 0 and max(x, y, z) < AXIS_CELLS
    return (int(x), int(y), int(z), True) if within else (0, 0, 0, False)


@kernel
def cell_key(i, j, k, way, level):  # type: ignore[no-untyped-def]
    """Of a cell, by the numbers of one of the smallest in it; a level is twice the size of the one before."""
    packed = uint64(way)
    packed = (packed << uint64(4)) | uint64(level)
    packed = (packed << uint64(AXIS_BITS)) | uint64(i >> level)
    packed = (packed << uint64(AXIS_BITS)) | uint64(j >> level)
    return (packed << uint64(AXIS_BITS)) | uint64(k >> level)


@kernel
def find(table, key):  # type: ignore[no-untyped-def]
    """Where a key stands in the table, or where there is room for it: its place, and whether it stands there."""
    mask = uint64(table.shape[0] - 1)
    place = mix64(key) & mask
    while table[place, 0] != NONE:
        if table[place, 0] == key:
            return place, True
        place = (place + uint64(1)) & mask
    return place, False


@kernel
def sees_middle(t, ray, ray_bits, p, n, epsilon, middle):  # type: ignore[no-untyped-def]
    """Whether nothing stands between a point on a surface and what is above the middle of its cell."""
    x, y, z = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    return not blocked(t, ray, ray_bits, x, y, z, middle[0] - x, middle[1] - y, middle[2] - z, np.float32(1))


@kernel
def in_open_plane(p, n, middle):  # type: ignore[no-untyped-def]
    """Whether a point lies in the plane that sees the middle of its cell."""
    above = (middle[0] - p[0]) * n[0] + (middle[1] - p[1]) * n[1] + (middle[2] - p[2]) * n[2]
    return abs(above - middle[3]) < _FLAT * middle[3]


def _cached(t, ray, ray_bits, scramble, depth, p, n, epsilon, d2):  # type: ignore[no-untyped-def]
    c = t.cache
    if c.grid[5] <= depth <= c.grid[6]:
        i, j, k, within = cell_of(c.grid, p)
        way = facing(n[3], n[4], n[5])
        for level in range(int(c.grid[4]) if within else 0):
            place, found = find(c.table, cell_key(i, j, k, way, level))
            near = c.grid[7] * c.grid[3] * (1 << level)
            if found and d2 >= near * near:
                cell = c.table[place, 1]
                middle = c.middle[cell]
                if in_open_plane(p, n, middle) or sees_middle(t, ray, ray_bits, p, n, epsilon, middle):
                    light = c.light[cell, scramble]
                    return True, np.float64(light[0]), np.float64(light[1]), np.float64(light[2])
    return False, 0.0, 0.0, 0.0


# What a scramble's cache knows of the light at a vertex (t, ray, ray_bits, scramble, depth, point, normals, epsilon, squared length of the
# ray that met it): whether it does, and red, green, blue.
cached_light = either("cache")(_cached)(lambda t, ray, ray_bits, scramble, depth, p, n, epsilon, d2: (False, 0.0, 0.0, 0.0))
