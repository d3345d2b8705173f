"""Sample points are the nets that they claim to be, independent of one another; warps have the densities that they claim."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import pytest
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core import sampling
from bake_core.sampling import (
    basis,
    cosine_hemisphere,
    cosine_hemisphere_inverse,
    cosine_hemisphere_pdf,
    mix64,
    random_pair,
    reverse_bits,
    sobol_pair,
    uniform_triangle,
    uniform_triangle_inverse,
    unit_float,
)
from tests.unit.test_octahedral import sphere

Array = NDArray[Any]

KEYS = (0, 1, 12345, 0x9E3779B97F4A7C15, 0xFFFFFFFFFFFFFFFF)


@numba.njit
def _sobol(first, count, key):  # type: ignore[no-untyped-def]
    out = np.empty((count, 2), np.float32)
    for i in range(count):
        out[i, 0], out[i, 1] = sobol_pair(reverse_bits(uint32(first + i)), uint64(key))
    return out


@numba.njit
def _random(first, count, key):  # type: ignore[no-untyped-def]
    out = np.empty((count, 2), np.float32)
    for i in range(count):
        out[i, 0], out[i, 1] = random_pair(uint32(first + i), uint64(key))
    return out


def points(first: int, count: int, key: int, *, plain: bool = False) -> Array:
    """(count, 2) float32."""
    draw = _random if plain else _sobol
    out: Array = draw(first, count, np.uint64(key & 0xFFFFFFFFFFFFFFFF))
    return out


def uniform(count: int, seed: int = 0) -> Array:
    """(count, 2) float32 in [0, 1), from a generator that is not ours."""
    return np.random.default_rng(seed).random((count, 2), np.float32)


def chi_squared(counts: Array, expected: Array | float) -> float:
    return float(((counts - expected) ** 2 / expected).sum())


def most(freedom: int) -> float:
    """Five σ above the mean of a χ² distribution: no fixed seed is that unlucky, and a wrong density is far beyond."""
    return freedom + 5 * math.sqrt(2 * freedom)


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("m", [2, 4, 7, 10])
@pytest.mark.parametrize("block", [0, 1, 5, 1000])
def test_every_aligned_run_is_a_net(key: int, m: int, block: int) -> None:
    """A (0, m, 2)-net: 2^m points from a multiple of 2^m on have one point in every box of 2^-a by 2^-(m-a)."""
    xy = points(block << m, 1 << m, key).astype(np.float64)
    for a in range(m + 1):
        boxes = np.floor(xy[:, 0] * 2**a) * 2 ** (m - a) + np.floor(xy[:, 1] * 2 ** (m - a))
        assert len(np.unique(boxes)) == 1 << m, f"2^{a} columns"


def test_different_keys_give_different_points_in_different_order() -> None:
    assert not np.allclose(points(0, 64, 1), points(0, 64, 2))
    # The shuffle: the first 16 points of two keys are not the same 16 of the sequence.
    order = np.argsort(points(0, 256, 1)[:, 0]), np.argsort(points(0, 256, 2)[:, 0])
    assert (order[0] != order[1]).mean() > 0.9


@pytest.mark.parametrize("apart", [1, 2, 0xD1B54A32D192ED03])
@pytest.mark.parametrize("axes", [(0, 0), (0, 1), (1, 1)])
def test_pairs_of_two_keys_are_independent(apart: int, axes: tuple[int, int]) -> None:
    """In each run of 16 points both coordinates visit all of 16 columns once, so the run is a permutation of columns to rows.

    Where keys are independent, so are the permutations, and each of their entries has a chance of 1/16: over k runs a cell's variance
    is k · 1/16 · 15/16, and χ² has the mean 16 · 15.
    """
    boxes, runs = 16, 256
    found = []
    for key in range(128):
        a, b = points(0, boxes * runs, key * 977)[:, axes[0]], points(0, boxes * runs, key * 977 + apart)[:, axes[1]]
        counts, _, _ = np.histogram2d(a, b, bins=boxes, range=[[0, 1], [0, 1]])
        assert (counts.sum(0) == runs).all() and (counts.sum(1) == runs).all()
        found.append(chi_squared(counts, runs / boxes))
    assert abs(np.mean(found) - boxes * (boxes - 1)) < 4 * np.std(found) / math.sqrt(len(found))


def test_random_pairs_are_uniform_and_do_not_repeat() -> None:
    n, boxes = 1 << 16, 32
    for key in KEYS:
        xy = points(0, n, key, plain=True)
        counts, _, _ = np.histogram2d(xy[:, 0], xy[:, 1], bins=boxes, range=[[0, 1], [0, 1]])
        assert chi_squared(counts, n / boxes**2) < most(boxes**2 - 1)
        assert len(np.unique(xy, axis=0)) > n - 10


def test_a_number_is_never_one() -> None:
    assert unit_float(0xFFFFFFFF) == np.float32(1 - 2.0**-24)
    assert unit_float(0) == 0


def test_mix64_is_a_bijection_where_tried_and_reversal_is_its_own_inverse() -> None:
    assert len({int(mix64(np.uint64(i))) for i in range(10_000)}) == 10_000
    for word in (0, 1, 0x80000000, 0x12345678, 0xFFFFFFFF):
        assert reverse_bits(np.uint32(word)) == int(f"{word:032b}"[::-1], 2)
        assert sampling.reverse_bits(reverse_bits(np.uint32(word))) == word


def smooth(xy: Array) -> Array:
    return np.asarray(np.exp(-(xy[:, 0].astype(np.float64) ** 2)) * np.cos(xy[:, 1]))


# ∫ exp(-x²) dx ∫ cos y dy over the unit square.
SMOOTH = math.sqrt(math.pi) / 2 * math.erf(1) * math.sin(1)


def test_scrambled_points_are_unbiased_and_converge_faster_than_random_ones() -> None:
    """Owen 1997: σ falls as n^-1.5 for smooth integrands, against n^-0.5."""

    def errors(n: int, plain: bool) -> Array:
        return np.array([smooth(points(0, n, key, plain=plain)).mean() - SMOOTH for key in range(200)])

    few, many = errors(16, False), errors(1024, False)
    for e in (few, many):
        assert abs(e.mean()) < 4 * e.std() / math.sqrt(len(e))
    assert few.std() / many.std() > 64**1.3
    plain = errors(16, True).std() / errors(1024, True).std()
    assert 6 < plain < 11  # √64 = 8
    assert few.std() < errors(16, True).std() / 3


def test_cosine_hemisphere_has_its_density() -> None:
    """z² and φ are independent and uniform: pdf cosθ/π."""
    u = uniform(1 << 18)
    d = np.array([cosine_hemisphere(a, b) for a, b in u], np.float64)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-6)
    assert (d[:, 2] >= 0).all()
    boxes = 16
    counts, _, _ = np.histogram2d(d[:, 2] ** 2, np.arctan2(d[:, 1], d[:, 0]), bins=boxes, range=[[0, 1], [-math.pi, math.pi]])
    assert chi_squared(counts, len(u) / boxes**2) < most(boxes**2 - 1)


def test_cosine_hemisphere_pdf_integrates_to_one() -> None:
    z = (np.arange(1000) + 0.5) / 1000  # dω = 2π dz
    assert 2 * math.pi * np.mean([cosine_hemisphere_pdf(np.float32(v)) for v in z]) == pytest.approx(1, rel=1e-6)
    assert cosine_hemisphere_pdf(np.float32(-0.5)) == 0


def test_cosine_hemisphere_keeps_neighbours_together_and_comes_back() -> None:
    c = (np.arange(40, dtype=np.float32) + np.float32(0.5)) / np.float32(40)
    for u in c:
        for v in c:
            x, y, _ = cosine_hemisphere(u, v)
            assert cosine_hemisphere_inverse(x, y) == pytest.approx((u, v), abs=2e-6)
    assert cosine_hemisphere(np.float32(0.5), np.float32(0.5)) == (0, 0, 1)
    assert cosine_hemisphere_inverse(0.0, 0.0) == (0.5, 0.5)
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x, y, z = cosine_hemisphere(np.float32(corner[0]), np.float32(corner[1]))
        assert math.hypot(x, y) == pytest.approx(1, abs=1e-6) and z == pytest.approx(0, abs=1e-3)


def test_uniform_triangle_is_uniform() -> None:
    """Counts in the 64 equal triangles that a division of the sides by eight makes."""
    u = uniform(1 << 17, seed=1)
    b = np.array([uniform_triangle(x, y) for x, y in u], np.float64)
    assert (b >= 0).all() and (b.sum(1) <= 1).all()
    cell = np.minimum(np.floor(b * 8), 7).astype(int)
    upper = (b * 8 - cell).sum(1) > 1
    _, counts = np.unique(cell[:, 0] * 16 + cell[:, 1] * 2 + upper, return_counts=True)
    assert len(counts) == 64
    assert chi_squared(counts, len(u) / 64) < most(63)


def test_uniform_triangle_comes_back() -> None:
    for u, v in uniform(2000, seed=2):
        assert uniform_triangle_inverse(*uniform_triangle(u, v)) == pytest.approx((u, v), abs=2e-7)


def test_basis_is_orthonormal_and_right_handed() -> None:
    special = [*np.eye(3), *-np.eye(3), [0, 0, -0.0], [1e-4, 0, -1], [-1e-7, 1e-7, -1], [0.6, 0.8, 0.0], [0.6, 0.8, -0.0]]
    normals = np.concatenate([sphere(2000), special[:6], special[7:]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for n in normals.astype(np.float32):
        t = np.array(basis(*n), np.float64)
        frame = np.stack([t[:3], t[3:], n])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=3e-7)
        assert np.linalg.det(frame) == pytest.approx(1, abs=1e-6)
