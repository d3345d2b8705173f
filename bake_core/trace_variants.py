"""A bundle's volumes as they would be with fewer probes, or with maps of another resolution: what tracing gains or loses by either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bake_core.atlas import Layout, layout, pack
from bake_core.bundle import Atlas, VolumeData
from bake_core.distances import capture_distance
from bake_core.tracer import Tracer
from bake_core.volume_chains import tiles_of


def thinned(volumes: Sequence[VolumeData], step: int) -> tuple[VolumeData, ...]:
    """Every `step`-th probe along each axis, the first ones among them."""
    return tuple(_thinned(volume, step) for volume in volumes)


def _thinned(volume: VolumeData, step: int) -> VolumeData:
    if step == 1:
        return volume
    nx, ny, nz = (int(n) for n in volume.counts)
    chosen = np.arange(nx * ny * nz).reshape(nz, ny, nx)[::step, ::step, ::step]
    counts = (chosen.shape[2], chosen.shape[1], chosen.shape[0])
    flat = chosen.ravel()
    tiles = volume.tiles[flat]
    tiles = tiles[tiles >= 0]
    count = int((volume.states == 1).sum())
    shape = layout(counts, max(a.tile for a in volume.atlases.values()), len(tiles))
    atlases = {name: _packed(atlas, tiles_of(atlas, count)[tiles, 1:-1, 1:-1], shape) for name, atlas in volume.atlases.items()}
    return replace(
        volume,
        spacing=volume.spacing * step,
        counts=np.array(counts),
        states=volume.states[flat],
        offsets=volume.offsets[flat],
        backface=volume.backface[flat],
        distance_limit=volume.distance_limit * step,
        atlases=atlases,
    )


def looked_again(tracer: Tracer, volumes: Sequence[VolumeData], resolution: int, cancelled: NDArray[np.uint8]) -> tuple[VolumeData, ...]:
    """Distances and normals captured anew, with so many texels along a side; normals as half floats, which bundles store them in.

    Raises
    ------
    Cancelled
    """
    out = []
    for volume in volumes:
        kept = volume.states == 1
        distance, normal, _, _ = capture_distance(tracer, volume.positions()[kept] - tracer.origin, resolution, cancelled=cancelled)
        side = (-1, resolution, resolution)
        old = volume.atlases["distance"]
        seen = np.where(np.isfinite(distance), distance, old.miss).astype(np.float32).reshape(*side, 1)
        shape = Layout(old.columns, old.rows, old.layers)
        halves = normal.astype(np.float16).astype(np.float32).reshape(*side, 3)
        new = {"distance": _packed(old, seen, shape), "normal": _packed(volume.atlases["normal"], halves, shape)}
        out.append(replace(volume, atlases=volume.atlases | new))
    return tuple(out)


def _packed(atlas: Atlas, interior: NDArray[np.float32], shape: Layout) -> Atlas:
    side = interior.shape[1]
    texels = pack(interior, shape)
    return replace(atlas, texels=texels, tile=side + 2, interior=side, columns=shape.columns, rows=shape.rows, layers=shape.layers)
