"""Chains: maps of several resolutions in one tile, and tiles packed into layers.

What a probe has at several resolutions (how near things are, how its radiance looks when blurred) lies in one texture, so that a host binds
one. The first, largest level stands at the left of a tile; the others stand one below another at its right. docs/bundle.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bake_core.atlas import Layout

F32 = NDArray[np.float32]


def chain_places(sides: Sequence[int]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Where levels of these sides (borders included) lie in a tile.

    Returns
    -------
    places : list of (x, y)
        Of each level's first texel: column and row.
    size : (width, height)
        Of the tile.
    """
    if not sides:
        raise ValueError("a chain has at least one level")
    places, y = [(0, 0)], 0
    for side in sides[1:]:
        places.append((sides[0], y))
        y += side
    return places, (sides[0] + max(sides[1:], default=0), max(sides[0], y))


def pack_chain(levels: Sequence[F32], shape: Layout) -> F32:
    """Levels of many tiles, packed.

    Parameters
    ----------
    levels : sequence of (n, s, s, channels) float32
        Each level of every tile, in the order of tiles; its own side s, border included where it has one.
    shape : Layout

    Returns
    -------
    (layers, rows * height, columns * width, channels) float32
        Texels that belong to no level, and places without a tile, are 0.
    """
    places, (width, height) = chain_places([level.shape[1] for level in levels])
    n, channels = levels[0].shape[0], levels[0].shape[-1]
    tiles = np.zeros((shape.layers * shape.rows * shape.columns, height, width, channels), np.float32)
    for (x, y), level in zip(places, levels, strict=True):
        side = level.shape[1]
        tiles[:n, y : y + side, x : x + side] = level
    grid = tiles.reshape(shape.layers, shape.rows, shape.columns, height, width, channels).transpose(0, 1, 3, 2, 4, 5)
    return np.ascontiguousarray(grid).reshape(shape.layers, shape.rows * height, shape.columns * width, channels)
