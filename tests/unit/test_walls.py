"""Walls: a bilinear look-up gives a flat wall back, at any distance and any scale; and no probe tells light through one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.atlas import layout, pack
from bake_core.bundle import Atlas
from bake_core.irradiance import bilinear
from bake_core.octahedral import dir_to_oct, texel_directions
from bake_core.walls import NEAREST, coarser, moments_and_walls, walls

F64 = NDArray[np.float64]
RAYS = 64


def to_plane(directions: F64, normal: F64, height: float) -> F64:
    """Distance to the plane normal · p = height; inf away from it."""
    towards = directions @ normal
    return np.asarray(np.where(towards > 0, height / np.where(towards > 0, towards, 1), np.inf))


def looked_up(texels: NDArray[np.float32], directions: F64) -> F64:
    """Of one probe's map, as half floats and a texture unit have it."""
    n = texels.shape[1]
    shape = layout((1, 1, 1), n + 2)
    atlas = Atlas("walls", pack(texels.astype(np.float16).astype(np.float32), shape), n + 2, n, 1, 1, 1, "half")
    return bilinear(atlas, np.zeros(len(directions), np.int64), dir_to_oct(directions))[:, 0]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_a_flat_wall_is_where_it_is(scale: float) -> None:
    """Inside a face of the octahedron, to the fit's ripple; and at folds the fit leaves less than values at texel centres would."""
    normal = np.array([0.48, 0.6, 0.64])
    rays, centres = texel_directions(RAYS).reshape(-1, 3), texel_directions(16)
    distance = to_plane(rays, normal, 0.5 * scale)[None]
    found = walls(distance, np.array([1e3 * scale]), np.array([scale]), 16)
    assert found.shape == (1, 16, 16, 1) and found.dtype == np.float32
    by_centres = np.maximum(2 * (centres @ normal) / np.abs(centres).sum(-1), 0)[None, ..., None].astype(np.float32)
    facing = rays @ normal > 0.5
    truth = np.abs(rays).sum(-1) * np.where(facing, distance[0], 0) / scale
    error, unfitted = (np.abs(looked_up(texels, rays) * truth - 1) for texels in (found, by_centres))
    # A fold is a kink of up to 1/16, half a texel; half of it is left on each side, and a ripple that falls by 2 - sqrt(3) a texel.
    inner = facing & (rays > 0.25).all(-1)
    assert inner.sum() > 100 and error[inner].max() < 1 / 64
    assert unfitted[inner].max() < 1e-3
    assert error[facing].max() < 0.75 * unfitted[facing].max() < 0.75 / 8


def test_coarser_maps_are_nearly_those_of_a_coarser_bake() -> None:
    """Of a corner of three planes: walls to a fiftieth of a spacing's inverse, moments to 2 % in the mean and 7 % where planes meet."""
    rays = texel_directions(RAYS).reshape(-1, 3)
    planes = ([1.0, 0, 0], 0.4), ([0, 0.6, 0.8], 0.7), ([0, -1.0, 0], 0.9)
    distance = np.min([to_plane(rays, np.array(n), h) for n, h in planes], 0)[None].repeat(300, 0)
    limits, units = np.full(300, 3.0), np.ones(300)
    fine, expected = (moments_and_walls(distance, limits, units, side) for side in (32, 8))
    found = coarser(fine, 8)
    assert found.shape == expected.shape and found.dtype == np.float32
    np.testing.assert_array_equal(found, found[:1].repeat(300, 0))
    np.testing.assert_allclose(found[0, ..., 2], expected[0, ..., 2], atol=0.02)
    off = np.abs(found / expected - 1)[0, ..., :2]
    assert off.mean() < 0.02 and off.max() < 0.07


def test_it_is_the_same_map_at_any_scale() -> None:
    rays = texel_directions(RAYS).reshape(-1, 3)
    distance = np.minimum(to_plane(rays, np.array([0.0, 1.0, 0.0]), 0.3), to_plane(rays, np.array([-0.6, 0.0, 0.8]), 0.7))[None]
    one = walls(distance, np.array([3.0]), np.array([1.0]), 16)
    for scale in (2.0**-20, 2.0**20):
        np.testing.assert_array_equal(walls(distance * scale, np.array([3.0 * scale]), np.array([scale]), 16), one)


def test_nothing_in_sight_and_a_touch() -> None:
    """A miss is at the limit; what touches the probe is as near as is told."""
    nothing = np.full((1, RAYS**2), np.inf)
    found = walls(nothing, np.array([4.0]), np.array([1.0]), 8)
    norm = np.abs(texel_directions(RAYS)).sum(-1).reshape(-1)
    # A sphere has kinks at folds as a wall has, of half a texel, which is 1/8; at the poles two folds cross.
    assert (np.abs(looked_up(found, texel_directions(RAYS).reshape(-1, 3)) * 4 * norm - 1) < 1 / 4).all()
    np.testing.assert_allclose(walls(np.zeros((1, RAYS**2)), np.array([4.0]), np.array([1.0]), 8), 1 / NEAREST)


def test_more_texels_than_rays_are_filled_all_the_same() -> None:
    found = walls(np.full((2, 4**2), 0.5), np.array([4.0, 4.0]), np.array([1.0, 2.0]), 16)
    assert np.isfinite(found).all() and (found > 0).all()
    np.testing.assert_allclose(found[1], 2 * found[0], rtol=1e-6)
