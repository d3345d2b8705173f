"""What a volume's maps are turned into for tracing: the chains "nearest" and "gloss" of every probe, packed as the atlases are.

They follow from the maps to the last bit, so a bundle holds them for its readers' sake alone, and a Python reader makes them anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bake_core.atlas import Layout
from bake_core.chains import chain_places, pack_chain
from bake_core.gloss_levels import gloss_levels, gloss_sides
from bake_core.nearest import level_sides, nearest_levels

if TYPE_CHECKING:
    from bake_core.bundle import Atlas, VolumeData

F32 = NDArray[np.float32]

TRACED = ("distance", "normal", "radiance")
# Chains and their channels.
CHAINS = {"nearest": 1, "gloss": 3}


def traceable(volumes: Sequence[VolumeData]) -> bool:
    """Whether volumes have what rays are traced through."""
    return all(set(TRACED) <= v.atlases.keys() for v in volumes)


def tiles_of(atlas: Atlas, count: int) -> F32:
    """The first `count` tiles of an atlas with their borders, (count, tile, tile, channels)."""
    side = atlas.tile
    grid = atlas.texels.reshape(atlas.layers, atlas.rows, side, atlas.columns, side, -1).transpose(0, 1, 3, 2, 4, 5)
    return np.ascontiguousarray(grid.reshape(-1, side, side, grid.shape[-1])[:count])


def _sides(volume: VolumeData, chain: str) -> list[int]:
    """Of its levels' sides, borders included where they have one."""
    if chain == "nearest":
        return level_sides(volume.atlases["distance"].interior)
    return [side + 2 for side in gloss_sides(volume.atlases["radiance"].interior)]


def chain_levels(volume: VolumeData, chain: str) -> list[tuple[int, int, int]]:
    """Where each level of a chain lies in a tile: column and row of its first texel, and its side, borders included."""
    sides = _sides(volume, chain)
    return [(*place, side) for place, side in zip(chain_places(sides)[0], sides, strict=True)]


def chain_size(volume: VolumeData, chain: str) -> tuple[int, int]:
    """Width and height of a chain's tile."""
    return chain_places(_sides(volume, chain))[1]


def chain_shape(volume: VolumeData, chain: str) -> tuple[int, ...]:
    """Shape of :func:`volume_chain`, which need not be made for it."""
    atlas = volume.atlases["distance"]
    width, height = chain_size(volume, chain)
    return (atlas.layers, atlas.rows * height, atlas.columns * width, CHAINS[chain])


def volume_chain(volume: VolumeData, chain: str) -> F32:
    """Packed texels of one chain of a volume that has the maps of :data:`TRACED`.

    Parameters
    ----------
    chain : str
        One of :data:`CHAINS`.

    Returns
    -------
    (layers, rows * height, columns * width, channels) float32
    """
    distance = volume.atlases["distance"]
    count = int((volume.states == 1).sum())
    shape = Layout(distance.columns, distance.rows, distance.layers)
    if chain == "gloss":
        return pack_chain(gloss_levels(tiles_of(volume.atlases["radiance"], count)[:, 1:-1, 1:-1]), shape)
    levels = nearest_levels(tiles_of(distance, count)[..., 0], tiles_of(volume.atlases["normal"], count), distance.miss)
    return pack_chain(levels, shape)
