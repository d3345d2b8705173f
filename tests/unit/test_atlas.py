"""Tiles in layers and back, and which numbers are stored in half."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.atlas import (
    HALF_MAX,
    HALF_TOLERANCE,
    MAX_LAYERS,
    MAX_SIDE,
    Layout,
    choose_encoding,
    encoding_error,
    layers_of,
    layout,
    pack,
    unpack,
)
from bake_core.octahedral import with_border

Array = NDArray[Any]


@pytest.mark.parametrize("counts", [(1, 1, 1), (6, 5, 4), (1, 7, 1), (455, 455, 256)])
def test_columns_rows_and_layers_are_the_grid_where_that_fits(counts: tuple[int, int, int]) -> None:
    assert layout(counts, 18) == Layout(*counts)


@pytest.mark.parametrize(
    "counts", [(456, 1, 1), (1, 456, 2), (2, 2, 257), (1, 1, 100_000), (256, 256, 256), (1 << 24, 1, 1), (1, 1, 1 << 24)]
)
@pytest.mark.parametrize("tile", [10, 18, 66, 1026])
def test_larger_grids_fit_a_texture_all_the_same(counts: tuple[int, int, int], tile: int) -> None:
    """Every probe has a place, a layer is no larger than any GPU takes, and not a whole layer is wasted."""
    shape, probes = layout(counts, tile), math.prod(counts)
    assert shape.columns * shape.rows * shape.layers >= probes
    assert shape.columns * tile <= MAX_SIDE and shape.rows * tile <= MAX_SIDE
    assert shape.columns * shape.rows * (shape.layers - 1) < probes
    if probes <= (MAX_SIDE // tile) ** 2 * MAX_LAYERS:
        assert shape.layers <= MAX_LAYERS


@pytest.mark.parametrize("counts", [(4, 3, 5), (16, 16, 2), (1, 1, 1), (7, 1, 1), (1, 300, 256), (300, 2, 300)])
def test_what_is_left_out_wastes_less_than_a_row_in_each_layer_where_layers_may_be_many(counts: tuple[int, int, int]) -> None:
    probes = math.prod(counts)
    for kept in sorted({0, 1, probes // 3, probes - 1, probes} - {-1}):
        shape = layout(counts, 10, kept)
        places = shape.columns * shape.rows * shape.layers
        assert max(kept, 1) <= places <= math.prod(vars(layout(counts, 10)).values())
        assert max(shape.layers, layers_of(probes, shape.columns, shape.rows)) <= MAX_LAYERS
        if probes <= shape.columns * MAX_LAYERS:
            assert places - max(kept, 1) < shape.columns
    assert layout(counts, 10, probes) == layout(counts, 10)


@pytest.mark.parametrize(("shape", "n"), [(Layout(3, 2, 4), 24), (Layout(5, 2, 1), 7), (Layout(1, 1, 3), 3), (Layout(4, 3, 2), 13)])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_pack_and_unpack(shape: Layout, n: int, channels: int) -> None:
    random = np.random.default_rng(0)
    interior = random.random((n, 4, 4, channels)).astype(np.float32)
    texels = pack(interior, shape)
    assert texels.shape == (shape.layers, shape.rows * 6, shape.columns * 6, channels) and texels.dtype == np.float32
    np.testing.assert_array_equal(unpack(texels, shape, n), interior)
    for p in range(shape.columns * shape.rows * shape.layers):
        layer, place = divmod(p, shape.columns * shape.rows)
        row, column = divmod(place, shape.columns)
        tile = texels[layer, row * 6 : row * 6 + 6, column * 6 : column * 6 + 6]
        np.testing.assert_array_equal(tile, with_border(interior[p]) if p < n else 0)


def test_layers_are_contiguous() -> None:
    """So that a file's rows are a 2D array's layers as they stand."""
    texels = pack(np.ones((8, 2, 2, 3), np.float32), Layout(2, 2, 2))
    assert texels.flags.c_contiguous


def test_ordinary_values_are_stored_in_half() -> None:
    values = np.random.default_rng(0).uniform(0.1, 100, (50, 8, 8, 3)).astype(np.float32)
    encoding, error = choose_encoding(values)
    assert encoding == "half" and 0 < error < HALF_TOLERANCE
    assert error == pytest.approx(encoding_error(values, values.astype(np.float16).astype(np.float32)))


@pytest.mark.parametrize("peak", [65505.0, 65520.0, 1e6, 3e38])
def test_what_half_cannot_hold_is_stored_in_full(peak: float) -> None:
    """One texel is enough; 65505 would still round to a finite number, and is refused all the same."""
    values = np.ones((2, 4, 4, 3), np.float32)
    values[1, 2, 3, 0] = peak
    assert choose_encoding(values) == ("float", 0.0)


def test_the_largest_half_is_no_infinity() -> None:
    values = np.full((1, 2, 2, 3), HALF_MAX, np.float32)
    assert choose_encoding(values)[0] == "half"
    assert np.isfinite(values.astype(np.float16)).all()


def test_values_too_dark_for_half_are_stored_in_full() -> None:
    """Under 6e-5 half floats lose bits, under 6e-8 they are zero."""
    random = np.random.default_rng(1)
    for scale in (1e-5, 1e-7, 1e-30):
        assert choose_encoding((random.uniform(0.5, 1, (4, 4, 4, 3)) * scale).astype(np.float32))[0] == "float"
    # Dark texels in a bright atlas are another matter: nobody sees them lose bits.
    values = random.uniform(0.5, 1, (4, 4, 4, 3)).astype(np.float32)
    values[0] *= 1e-7
    assert choose_encoding(values)[0] == "half"


def test_black_and_empty_maps() -> None:
    assert choose_encoding(np.zeros((2, 4, 4, 3), np.float32)) == ("half", 0.0)
    assert choose_encoding(np.zeros((0, 4, 4, 3), np.float32)) == ("half", 0.0)


def test_the_error_of_storing_is_the_figure_of_design() -> None:
    """√mean(|Δ|² / (E² + (0.05 Ē)²)): relative for bright texels, not for black ones."""
    values = np.ones((1, 2, 2, 3), np.float32)
    assert encoding_error(values, values * np.float32(1.01)) == pytest.approx(0.01 / math.sqrt(1 + 0.05**2), rel=1e-4)
    assert encoding_error(values, values) == 0
