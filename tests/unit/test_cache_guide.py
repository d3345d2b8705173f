"""Where paths are sent to learn from: every direction still gets its due, and light through a small opening takes fewer of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bake_core.cache_guide import FEWEST_POINTS, PARTS, Guide, guided, sums
from bake_core.kernels import entry_kernel


@entry_kernel
def _draw(table, square, out):  # type: ignore[no-untyped-def]
    for i in range(len(square)):
        out[i, 0], out[i, 1], out[i, 2] = guided(table, square[i, 0], square[i, 1])


def drawn(guide: Guide, square: NDArray[np.float32]) -> NDArray[np.float64]:
    """Points of the square and one over their densities, (n, 3), by the first group."""
    out = np.empty((len(square), 3))
    _draw(guide.table()[0], square, out)
    return out


def grid(n: int) -> NDArray[np.float32]:
    """The middles of n × n parts of the square."""
    middles = (np.arange(n, dtype=np.float32) + np.float32(0.5)) / np.float32(n)
    return np.stack(np.meshgrid(middles, middles, indexing="ij"), -1).reshape(-1, 2)


def of_one(square: NDArray[np.float64], paths: float = 100) -> Guide:
    """A guide of one group, all of whose parts have had so many paths, with these mean squares."""
    guide = Guide.of(np.zeros(FEWEST_POINTS, np.uint64))
    part = np.arange(PARTS * PARTS, dtype=np.uint8)[None]
    brought = np.stack([paths * square.ravel(), np.full(PARTS * PARTS, paths)], 1)[None]
    guide.hear(sums(guide.rows(np.zeros(1, np.uint64)), part, brought))
    return guide


def test_who_knows_nothing_or_the_same_everywhere_changes_nothing() -> None:
    points = np.random.default_rng(1).random((1000, 2)).astype(np.float32)
    for guide in (Guide.of(np.zeros(FEWEST_POINTS, np.uint64)), of_one(np.full((PARTS, PARTS), 7.0))):
        out = drawn(guide, points)
        np.testing.assert_allclose(out[:, :2], points, atol=2e-6)
        np.testing.assert_allclose(out[:, 2], 1, rtol=2e-6)


def test_any_function_has_the_same_integral_and_a_patch_of_light_less_noise() -> None:
    random = np.random.default_rng(2)
    bright = np.full((PARTS, PARTS), 0.01)
    bright[5, 2] = 100.0
    out = drawn(of_one(bright), grid(512))
    assert (out[:, :2] >= 0).all() and (out[:, :2] < 1).all()
    # Half of the paths are drawn evenly: none weighs more than twice.
    assert out[:, 2].max() < 2.001
    parts = (out[:, :2] * PARTS).astype(int)
    np.testing.assert_allclose(out[:, 2].mean(), 1, rtol=1e-3)
    for row, column in random.integers(PARTS, size=(8, 2)):
        share = np.where((parts == (row, column)).all(1), out[:, 2], 0).mean()
        np.testing.assert_allclose(share, 1 / PARTS**2, rtol=2e-2)
    light = np.where((parts == (5, 2)).all(1), 10.0, 0.1)
    evenly = np.where((grid(512) * PARTS).astype(int) == (5, 2), 1, 0).all(1)
    plain = np.where(evenly, 10.0, 0.1)
    np.testing.assert_allclose((out[:, 2] * light).mean(), plain.mean(), rtol=1e-2)
    assert (out[:, 2] * light).var() < 0.2 * plain.var()


def test_strata_stay_strata() -> None:
    """A part of the square is one rectangle of the numbers it is drawn by: neighbours stay neighbours."""
    out = drawn(of_one(np.random.default_rng(3).random((PARTS, PARTS))), grid(256))
    x, y = out[:, 0].reshape(256, 256), out[:, 1].reshape(256, 256)
    assert (np.diff(x, axis=0) > 0).all() and np.ptp(x, axis=1).max() == 0
    assert (np.diff(y, axis=1) > 0).all()


def test_groups_hear_only_of_their_own_points_and_strangers_have_none() -> None:
    codes = np.array([9, 4, 9, 7] * FEWEST_POINTS + [5] * (FEWEST_POINTS - 1), np.uint64)
    guide = Guide.of(codes)
    rows = guide.rows(np.array([4, 9, 5, 7, 11], np.uint64))
    np.testing.assert_array_equal(rows, [0, 2, -1, 1, -1])
    part = np.full((5, 2), 3, np.uint8)
    brought = np.arange(20.0).reshape(5, 2, 2)
    guide.hear(sums(rows, part, brought))
    np.testing.assert_array_equal(guide.square[:, 3], [0 + 2, 12 + 14, 4 + 6])
    np.testing.assert_array_equal(guide.paths[:, 3], [1 + 3, 13 + 15, 5 + 7])
    assert guide.square.sum() == guide.square[:, 3].sum()
    assert (Guide.of(np.zeros(0, np.uint64)).rows(codes) == -1).all()
