"""How near anything is that a probe sees: a hierarchy of lower bounds, by which a ray passes over what is empty.

A *cell* of a map of n × n texels is the square between four neighbouring texel centres; there are (n + 1)² of them, those that reach over
the map's edge into the border included. Level k of the hierarchy has a value for each block of 2^k × 2^k cells.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from bake_core.octahedral import oct_to_dir, wrap_oct

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# The coarsest level is one that has this many blocks along its side or fewer: passing over a quarter of the sphere at a time gains nothing.
_COARSEST = 5


def level_sides(n: int) -> list[int]:
    """Blocks along the side of each level, from level 1 on, of an n × n map."""
    sides = [(n + 2) // 2]
    while sides[-1] > _COARSEST:
        sides.append((sides[-1] + 1) // 2)
    return sides


@cache
def _corners(n: int) -> tuple[F64, F64]:
    """Directions through all texel centres of a tile, border included, (n + 2, n + 2, 3); and how far a cell reaches from each corner.

    With n even, the octahedron's folds meet a cell's outline at its corners and in the middle of its sides only, and within each part that
    they cut off the map takes straight lines to great circles: the farthest point from a corner is one of these nine.

    Returns
    -------
    directions : (n + 2, n + 2, 3) float64
    reach : (n + 1, n + 1, 2, 2) float64
        Radians; of the cell [row, column] from its corner [row + a, column + b].
    """
    fine = (np.arange(2 * n + 3) - 1) / n - 1
    lattice = np.asarray(oct_to_dir(wrap_oct(np.stack(np.meshgrid(fine, fine), -1))), np.float64)
    at = np.stack([lattice[a : 2 * n + 1 + a : 2, b : 2 * n + 1 + b : 2] for a in range(3) for b in range(3)], 2)
    reach = np.empty((n + 1, n + 1, 2, 2))
    for a in range(2):
        for b in range(2):
            corner = lattice[2 * a : 2 * a + 2 * n + 1 : 2, 2 * b : 2 * b + 2 * n + 1 : 2, None]
            apart = np.arctan2(np.linalg.norm(np.cross(corner, at), axis=-1), (corner * at).sum(-1))
            reach[..., a, b] = apart.max(-1)
    return np.ascontiguousarray(lattice[::2, ::2]), np.asarray(reach)


def nearest_levels(distance: F32, normal: F32, miss: float) -> list[F32]:
    """The hierarchy of some tiles.

    Parameters
    ----------
    distance : (t, n + 2, n + 2) float32
        Tiles of a distance map, border included.
    normal : (t, m + 2, m + 2, 3) float32
        Tiles of a normal map.
    miss : float
        What stands for no surface.

    Returns
    -------
    list of (t, s, s, 1) float32
        From level 1 on. Within a block, no plane through a surface that a texel at a corner of one of its cells saw is nearer than the
        block's value: the distance of such a plane of normal N along w is h / (-N·w), least where w is nearest to -N.
    """
    n = distance.shape[1] - 2
    directions, reach = _corners(n)
    at = normal_texels(n, normal.shape[1] - 2)
    out = [np.empty((len(distance), side, side, 1), np.float32) for side in level_sides(n)]
    # Few tiles at a time: a row of a map takes as much again in each of some ten steps.
    for i, (d, normals) in enumerate(zip(distance.astype(np.float64), normal, strict=True)):
        cosine = np.clip(-(normals[at[:, None], at[None, :]] * directions).sum(-1), 0, 1)
        angle = np.arccos(cosine)
        least = np.full((n + 1, n + 1), np.inf)
        for a in range(2):
            for b in range(2):
                part = np.s_[a : a + n + 1, b : b + n + 1]
                bound = d[part] * cosine[part] / np.cos(np.maximum(angle[part] - reach[..., a, b], 0))
                least = np.minimum(least, np.where(d[part] >= miss, miss, bound))
        for level in out:
            side = level.shape[1]
            padded = np.pad(least, ((0, 2 * side - len(least)),) * 2, constant_values=np.inf)
            least = padded.reshape(side, 2, side, 2).min((1, 3))
            level[i, ..., 0] = least
    return out


def normal_texels(n: int, m: int) -> NDArray[np.int64]:
    """Which texel of an m × m tile of normals each texel of an n × n tile of distances looks at, (n + 2,), borders counted.

    The one that its centre lies in; its own where there are as many.
    """
    inner = (2 * np.arange(n) + 1) * m // (2 * n) + 1
    return np.concatenate([[0], inner, [m + 1]])
