"""The bundle: what a bake hands over. docs/bundle.md describes it for a stranger who writes a reader."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Atlas:
    """One output of one volume: a tile a probe, packed in layers.

    Probe p is the tile at layer ``p // (columns * rows)``, row ``p % (columns * rows) // columns``, column ``p % columns``.

    Attributes
    ----------
    output : str
        ``irradiance``, ``visibility``, ``radiance``, ``distance`` or ``normal``.
    texels : (layers, rows * tile, columns * tile, channels) float32
    tile, interior : int
        Texels along a tile's side with its border (interior + 2) and without.
    columns, rows, layers : int
    encoding : str
        ``half`` or ``float``: how the file stores it.
    """

    output: str
    texels: F32
    tile: int
    interior: int
    columns: int
    rows: int
    layers: int
    encoding: str


@dataclass(frozen=True)
class VolumeData:
    """One volume's probes and atlases.

    Attributes
    ----------
    name : str
    origin, spacing : (3,) float64
        Metres, world.
    counts : (3,) int64
    states : (n,) uint8
        1 active; 0 inside geometry, weight 0 in every query.
    offsets : (n, 3) float32
        Metres from the lattice point to where the probe stands.
    backface : (n,) float32
        Fraction of a probe's sphere that sees back faces.
    parameters : dict of str to float
        What the query shader reads: biases, floor.
    distance_limit : float
        Metres; distances are clamped to it (1.5 × cell diagonal).
    atlases : dict of str to Atlas
    """

    name: str
    origin: F64
    spacing: F64
    counts: NDArray[np.int64]
    states: NDArray[np.uint8]
    offsets: F32
    backface: F32
    parameters: dict[str, float]
    distance_limit: float
    atlases: dict[str, Atlas]


@dataclass(frozen=True)
class Bundle:
    """A bundle in memory. `path` is where it was read from."""

    manifest: dict[str, Any]
    volumes: tuple[VolumeData, ...]
    path: Path
