"""Atlases: a tile for each probe that is kept, packed into layers, stored as EXR in half or full floats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bake_core.octahedral import with_border

F32 = NDArray[np.float32]

Encoding = Literal["half", "float"]

# Widest and highest layer, and most layers, that every GPU with WebGL2-class limits or better takes as a 2D array.
MAX_SIDE = 8192
MAX_LAYERS = 256
HALF_MAX = 65504.0
# Half floats carry 11 bits: an RMS error of 1.4e-4 on ordinary values. A constant atlas may sit where rounding is worst (4.9e-4), and one
# with dark texels runs into half's smallest numbers; past this bound an atlas is stored in full.
HALF_TOLERANCE = 2.5e-4


@dataclass(frozen=True)
class Layout:
    """Tile t lies in layer t // (columns * rows), row t % (columns * rows) // columns, column t % columns."""

    columns: int
    rows: int
    layers: int


def layout(counts: tuple[int, int, int], tile: int, kept: int | None = None) -> Layout:
    """How a volume's tiles are packed: columns along x, rows along y and a layer per z where that fits, else as square as it goes.

    Where some probes are left out, layers have as many rows as waste the fewest places. The probe table, which holds all of them, has
    the same columns and rows, and more layers.

    Parameters
    ----------
    counts : (int, int, int)
        Probes along each axis.
    tile : int
        Texels along the side of the largest of the volume's tiles, border included: all of its atlases share one layout.
    kept : int, optional
        Tiles; all probes have one where it is left out. At least one place is made.
    """
    nx, ny, nz = counts
    most = MAX_SIDE // tile
    probes = nx * ny * nz
    if nx <= most and ny <= most and nz <= MAX_LAYERS:
        columns, rows = nx, ny
    else:
        columns = min(probes, most)
        rows = min(-(-probes // columns), most)
    tiles = probes if kept is None else max(kept, 1)
    if tiles < probes:
        few = -(-probes // (columns * MAX_LAYERS))
        rows = min(range(rows, min(few, rows) - 1, -1), key=lambda r: layers_of(tiles, columns, r) * r)
    return Layout(columns, rows, layers_of(tiles, columns, rows))


def layers_of(tiles: int, columns: int, rows: int) -> int:
    """How many layers of columns × rows places hold some tiles."""
    return -(-tiles // (columns * rows))


def pack(interior: F32, shape: Layout) -> F32:
    """Tiles with borders, packed.

    Inverse of :func:`unpack`.

    Parameters
    ----------
    interior : (n, t, t, channels) float32
        The map of every probe that is kept, in flat order; n may be less than the layout holds.

    Returns
    -------
    (layers, rows * (t + 2), columns * (t + 2), channels) float32
        Places without a tile are 0.
    """
    tiles = with_border(interior)
    n, side, _, channels = tiles.shape
    places = shape.layers * shape.rows * shape.columns
    full = np.zeros((places, side, side, channels), np.float32)
    full[:n] = tiles
    grid = full.reshape(shape.layers, shape.rows, shape.columns, side, side, channels)
    return np.ascontiguousarray(grid.transpose(0, 1, 3, 2, 4, 5)).reshape(shape.layers, shape.rows * side, shape.columns * side, channels)


def unpack(texels: F32, shape: Layout, n: int) -> F32:
    """Every tile's map without its border, (n, t, t, channels). Inverse of :func:`pack`."""
    layers, height, _, channels = texels.shape
    side = height // shape.rows
    grid = texels.reshape(layers, shape.rows, side, shape.columns, side, channels).transpose(0, 1, 3, 2, 4, 5)
    return np.ascontiguousarray(grid.reshape(-1, side, side, channels)[:n, 1:-1, 1:-1])


def encoding_error(interior: F32, stored: F32) -> float:
    """What storing costs, as DESIGN's error figure: √mean(|Δ|² / (E² + (0.05 Ē)²)) over texels."""
    difference = ((stored.astype(np.float64) - interior) ** 2).sum(-1)
    square = (interior.astype(np.float64) ** 2).sum(-1)
    floor = (0.05 * float(np.sqrt(square).mean())) ** 2 if square.size else 0.0
    return float(np.sqrt((difference / (square + floor)).mean())) if floor > 0 else 0.0


def choose_encoding(interior: F32) -> tuple[Encoding, float]:
    """Half floats where they hold every value and keep the error figure below HALF_TOLERANCE; else full.

    Returns
    -------
    encoding : ``half`` or ``float``
    error : float
        What the encoding costs.
    """
    if interior.size and float(np.abs(interior).max()) > HALF_MAX:
        return "float", 0.0
    error = encoding_error(interior, interior.astype(np.float16).astype(np.float32))
    return ("half", error) if error <= HALF_TOLERANCE else ("float", 0.0)
