"""Visibility moments against integrals of the lobe, over surfaces whose distance is known in every direction."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.filtering import VISIBILITY_SHARPNESS, visibility_moments
from bake_core.octahedral import oct_to_dir, texel_directions

Array = NDArray[Any]
RESOLUTION, DISTANCE_RESOLUTION = 16, 64


def wall(directions: Array, height: float = 1.0) -> Array:
    """Distance to the plane y = -height from zero; inf where a ray goes up."""
    down = -directions[..., 1]
    return np.asarray(np.where(down > 0, height / np.where(down > 0, down, 1), np.inf))


def by_quadrature(distance: Any, limit: float, axes: Array) -> Array:
    """The two moments about each axis over a fine grid of directions, dω = dA / |v|³ on the octahedron; (n, 2)."""
    c = (np.arange(768) + 0.5) / 384 - 1
    x, y = np.meshgrid(c, c)
    d = oct_to_dir(np.stack([x, y], -1)).reshape(-1, 3)
    omega = np.abs(d).sum(-1) ** 3
    r = np.minimum(distance(d), limit)
    out = []
    for axis in axes:
        weight = np.maximum(d @ axis, 0) ** VISIBILITY_SHARPNESS * omega
        out.append(((weight * r).sum() / weight.sum(), (weight * r * r).sum() / weight.sum()))
    return np.array(out)


def moments(distance: Any, limit: float) -> Array:
    """(RESOLUTION², 2), through the function that bakes use."""
    seen = distance(texel_directions(DISTANCE_RESOLUTION).reshape(1, -1, 3))
    found = visibility_moments(seen, np.array([limit]), RESOLUTION)
    assert found.shape == (1, RESOLUTION, RESOLUTION, 2) and found.dtype == np.float32
    return found.reshape(-1, 2)


@pytest.mark.parametrize("limit", [1.5, 4.0, 1e6])
def test_a_flat_wall(limit: float) -> None:
    """Moments by 64² rays against 768² of quadrature; misses and far hits count as the limit."""
    axes = texel_directions(RESOLUTION).reshape(-1, 3)
    # Where the lobe straddles the horizon of an unlimited wall the integral is one of 1e6 steps: no number of rays knows it.
    chosen = np.arange(0, len(axes), 5)
    if limit == 1e6:
        chosen = chosen[axes[chosen, 1] < -0.75]
    found, truth = moments(wall, limit)[chosen].astype(np.float64), by_quadrature(wall, limit, axes[chosen])
    np.testing.assert_allclose(found[:, 0], truth[:, 0], rtol=0.01)
    np.testing.assert_allclose(found[:, 1], truth[:, 1], rtol=0.02)
    # What Chebyshev's bound lives on: the spread, where the wall fills the lobe.
    facing = axes[chosen, 1] < -0.9
    spread = [np.sqrt(np.maximum(m[facing, 1] - m[facing, 0] ** 2, 0)) for m in (found, truth)]
    assert facing.any()
    np.testing.assert_allclose(spread[0], spread[1], rtol=0.05)


def test_a_sphere_around_has_no_spread() -> None:
    found = moments(lambda d: np.full(d.shape[:-1], 0.75), 10.0)
    np.testing.assert_allclose(found, np.broadcast_to([0.75, 0.5625], found.shape), rtol=1e-6)


def test_nothing_in_sight_is_the_limit() -> None:
    found = moments(lambda d: np.full(d.shape[:-1], np.inf), 3.0)
    np.testing.assert_allclose(found, np.broadcast_to([3.0, 9.0], found.shape), rtol=1e-6)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e6, 1e12])
def test_a_variance_is_never_negative(scale: float) -> None:
    """At any unit of length, random distances, in the float32 numbers that are stored."""
    random = np.random.default_rng(0)
    distance = scale * np.concatenate([random.random((4, DISTANCE_RESOLUTION**2)), np.full((2, DISTANCE_RESOLUTION**2), 1 / 3)])
    distance[0, ::3] = np.inf
    found = visibility_moments(distance, np.full(6, 0.9 * scale), RESOLUTION).astype(np.float64)
    assert np.isfinite(found).all()
    # Rounding of each moment to float32 by half an ulp is all that is allowed.
    assert (found[..., 1] - found[..., 0] ** 2 >= -(2.0**-23) * found[..., 1]).all()


def test_each_probe_has_its_own_limit() -> None:
    found = visibility_moments(np.full((3, DISTANCE_RESOLUTION**2), np.inf), np.array([1.0, 2.0, 4.0]), 4)
    np.testing.assert_allclose(found[:, 0, 0, 0], [1, 2, 4], rtol=1e-6)


def test_the_lobe_is_as_wide_as_documented() -> None:
    """cos^50 has half its height at 9.5°."""
    assert math.degrees(math.acos(0.5 ** (1 / VISIBILITY_SHARPNESS))) == pytest.approx(9.5, abs=0.05)
