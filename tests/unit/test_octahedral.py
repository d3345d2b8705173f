"""The octahedral map against its definition, its texels against quadrature, its borders against continuity."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.octahedral import (
    dir_to_oct,
    oct_to_dir,
    texel_cosines,
    texel_directions,
    texel_solid_angles,
    texel_triangles,
    with_border,
)

Array = NDArray[Any]


def sphere(count: int) -> Array:
    """A Fibonacci spiral: directions spread evenly, none of them on an axis."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = i * math.pi * (3 - math.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)


def quadrature(n: int, fine: int) -> tuple[Array, Array]:
    """Directions and solid angles of fine × fine points in each texel of an n×n map: (n, n, fine², 3) and (n, n, fine²).

    By dω = dA / |v|³, v being the point of the octahedron |x| + |y| + |z| = 1 above the square's point; midpoint rule.
    """
    c = (np.arange(n * fine) + 0.5) * 2 / (n * fine) - 1
    x, y = np.meshgrid(c, c)
    d: Array = oct_to_dir(np.stack([x, y], -1))
    omega = (2 / (n * fine)) ** 2 * np.abs(d).sum(-1) ** 3
    split = (n, fine, n, fine)
    d = d.reshape(*split, 3).transpose(0, 2, 1, 3, 4).reshape(n, n, fine * fine, 3)
    return d, omega.reshape(split).transpose(0, 2, 1, 3).reshape(n, n, fine * fine)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 3e-7), (np.float64, 5e-16)])
def test_65536_directions_come_back(dtype: type, tolerance: float) -> None:
    directions: Array = sphere(1 << 16).astype(dtype)
    square = dir_to_oct(directions)
    assert square.dtype == dtype and np.abs(square).max() <= 1
    back = oct_to_dir(square)
    assert back.dtype == dtype
    np.testing.assert_allclose(back, directions, atol=tolerance)


def test_points_of_the_square_come_back() -> None:
    c = np.linspace(-1, 1, 257)[1:-1]  # on the square's rim two points are one direction
    square = np.stack(np.meshgrid(c, c), -1)
    np.testing.assert_allclose(dir_to_oct(oct_to_dir(square)), square, atol=5e-16)


def test_length_does_not_matter() -> None:
    directions = sphere(1000)
    np.testing.assert_allclose(dir_to_oct(directions * 1e-30), dir_to_oct(directions), rtol=1e-14)
    np.testing.assert_allclose(dir_to_oct(directions * 1e30), dir_to_oct(directions), rtol=1e-14)


@pytest.mark.parametrize(
    ("direction", "point"),
    [
        ((1, 0, 0), (1, 0)),
        ((-1, 0, 0), (-1, 0)),
        ((0, 1, 0), (0, 1)),
        ((0, -1, 0), (0, -1)),
        ((0, 0, 1), (0, 0)),
        # A zero counts as positive, whatever its sign: -Z is the corner (1, 1), and lower half-planes fold to the positive side.
        ((0, 0, -1), (1, 1)),
        ((-0.0, -0.0, -1), (1, 1)),
        ((-0.0, 0, -1), (1, 1)),
        ((0.0, 0.6, -0.8), (1 - 0.6 / 1.4, 1)),
        ((-0.0, 0.6, -0.8), (1 - 0.6 / 1.4, 1)),
        ((0.6, -0.0, -0.8), (1, 1 - 0.6 / 1.4)),
        ((-0.6, -0.0, -0.8), (-1, 1 - 0.6 / 1.4)),
        ((0.6, 0.8, -0.0), (0.6 / 1.4, 0.8 / 1.4)),
    ],
)
def test_axes_folds_and_negative_zeros(direction: tuple[float, ...], point: tuple[float, float]) -> None:
    np.testing.assert_allclose(dir_to_oct(np.array(direction)), point, atol=1e-15)
    np.testing.assert_allclose(oct_to_dir(np.array(point, np.float64)), np.array(direction) / np.linalg.norm(direction), atol=1e-15)


def test_all_four_corners_are_minus_z() -> None:
    corners = np.array([[x, y] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    np.testing.assert_array_equal(oct_to_dir(corners), np.broadcast_to([0, 0, -1], (4, 3)))


def test_rows_grow_with_the_second_coordinate() -> None:
    d = texel_directions(8)
    assert (d[-1, :, 1] > 0).all() and (d[:, -1, 0] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1, rtol=1e-15)


@pytest.mark.parametrize("n", [2, 4, 8, 16, 64])
def test_solid_angles(n: int) -> None:
    """Exact ones against the Jacobian's quadrature, which errs with the square of its step."""
    omega = texel_solid_angles(n)
    assert omega.sum() == pytest.approx(4 * math.pi, rel=1e-12)
    _, fine = quadrature(n, max(16, 512 // n))
    np.testing.assert_allclose(omega, fine.sum(-1), rtol=2e-4)
    # The map's own symmetries.
    np.testing.assert_allclose(omega, omega[::-1], rtol=1e-12)
    np.testing.assert_allclose(omega, omega.T, rtol=1e-12)


def test_triangles_cover_each_texel_and_its_centre() -> None:
    n = 6
    corners = texel_triangles(n)
    assert corners.shape == (n, n, 2, 3, 3)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=-1), 1, rtol=1e-14)
    centre = corners.reshape(n, n, 6, 3).mean(2)
    towards = (centre * texel_directions(n)).sum(-1) / np.linalg.norm(centre, axis=-1)
    assert (towards > 0.99).all()


def test_cosines_sum_to_pi_and_agree_with_quadrature() -> None:
    n = 8
    special = [np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0], [-0.6, 0.0, -0.8]], texel_directions(8).reshape(-1, 3)[:5]]
    normals = np.concatenate([sphere(23), *special])
    exact = texel_cosines(n, normals)
    np.testing.assert_allclose(exact.sum(1), math.pi, rtol=1e-12)
    assert (exact >= 0).all()
    directions, omega = quadrature(n, 48)  # the clamped cosine and the fold both have kinks
    for normal, row in zip(normals, exact, strict=True):
        sums = (np.maximum(directions @ normal, 0) * omega).sum(-1).reshape(-1)
        np.testing.assert_allclose(row, sums, atol=2e-5)
    # Texels that the horizon does not cut are plain vectors: ∫ω dω · n.
    below = (texel_triangles(n).reshape(n * n, 6, 3) @ normals[0] < 0).all(1)
    assert below.any() and not exact[0][below].any()


def bilinear(tile: Array, square: Array) -> Array:
    """What a texture unit makes of a tile with its border; points in [-1, 1]²."""
    n = len(tile) - 2
    x, y = (0.5 + (square[:, axis] * 0.5 + 0.5) * n for axis in (0, 1))
    x0, y0 = (np.minimum(np.floor(a), n).astype(int) for a in (x, y))
    fx, fy = x - x0, y - y0
    return np.asarray(
        (tile[y0, x0] * (1 - fx) + tile[y0, x0 + 1] * fx) * (1 - fy) + (tile[y0 + 1, x0] * (1 - fx) + tile[y0 + 1, x0 + 1] * fx) * fy
    )


def rim(count: int) -> tuple[Array, Array]:
    """Pairs of points of the square's rim that are one direction: (2 count, 2) each."""
    s = np.linspace(-1, 1, count)
    one = np.ones(count)
    here = np.concatenate([np.stack([one, s], -1), np.stack([s, -one], -1)])
    there = np.concatenate([np.stack([one, -s], -1), np.stack([-s, -one], -1)])
    np.testing.assert_allclose(oct_to_dir(here), oct_to_dir(there), atol=1e-15)
    return here, there


def test_border_texels_are_the_texels_across_the_edge() -> None:
    """Each border texel, unfolded: a step over the edge comes back through the same edge, mirrored; a corner is the opposite corner."""
    n = 4
    interior = np.arange(n * n, dtype=np.float64).reshape(n, n, 1)
    tile = with_border(interior)[..., 0]
    np.testing.assert_array_equal(tile[1:-1, 1:-1], interior[..., 0])
    for i in range(n):
        mirrored = n - 1 - i
        assert tile[0, 1 + i] == interior[0, mirrored, 0] and tile[-1, 1 + i] == interior[-1, mirrored, 0]
        assert tile[1 + i, 0] == interior[mirrored, 0, 0] and tile[1 + i, -1] == interior[mirrored, -1, 0]
    assert [tile[0, 0], tile[0, -1], tile[-1, 0], tile[-1, -1]] == [15, 12, 3, 0]
    # More maps at once, and the dtype stays.
    many = with_border(np.stack([interior, 2 * interior]).astype(np.float32))
    assert many.dtype == np.float32
    np.testing.assert_array_equal(many[1, ..., 0], 2 * tile)


def test_bilinear_look_ups_agree_on_both_sides_of_the_rim() -> None:
    random = np.random.default_rng(0)
    tile = with_border(random.random((8, 8, 1)))[..., 0]
    here, there = rim(501)
    np.testing.assert_allclose(bilinear(tile, here), bilinear(tile, there), atol=1e-14)


@pytest.mark.parametrize("function", [lambda d: 1 + d[..., 0] / 2, lambda d: 1 + (d @ np.array([0.3, -0.2, 0.9])) ** 2])
def test_bilinear_across_the_rim_is_the_continuous_function(function: Callable[[Array], Array]) -> None:
    """Along the rim the error falls like everywhere else; a clamped border would leave it at the width of a texel."""
    here, _ = rim(333)
    errors = []
    for n in (16, 32, 64):
        tile = with_border(function(texel_directions(n))[..., None])[..., 0]
        errors.append(np.abs(bilinear(tile, here) - function(oct_to_dir(here))).max())
    assert errors[0] < 0.12 and errors[2] < 0.03
    assert errors[0] > 1.7 * errors[1] > 2.89 * errors[2]
