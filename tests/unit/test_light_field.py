"""Rays through light fields whose every surface is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from bake_core.atlas import Layout
from bake_core.bundle import VolumeData
from bake_core.chains import chain_places, pack_chain
from bake_core.gloss_levels import gloss_alphas, gloss_levels, gloss_sides
from bake_core.light_field import HIT, MISS, UNKNOWN, Traces, arriving, light_field, trace
from bake_core.nearest import level_sides, nearest_levels
from bake_core.octahedral import oct_to_dir, texel_directions, with_border, wrap_oct
from bake_core.trace_check import Rays, compare_traces
from bake_core.volume_chains import tiles_of
from tests.conformance import rooms
from tests.conformance.rooms import Room

GRID = ((-1.5, 0.5, -1.5), (1.0, 1.0, 1.0), (4, 3, 4))
BOXES = (((-1.2, 0.0, -1.0), (-0.3, 1.7, -0.2)), ((0.4, 0.0, 0.3), (1.1, 0.8, 1.3)))


def traced(room: Room, volumes: tuple[VolumeData, ...], count: int = 4000) -> tuple[Traces, np.ndarray, np.ndarray, np.ndarray]:
    o, d = rooms.rays(room, count)
    return trace(light_field(volumes), o, d), o, d, room.hit(o, d)[0]


@pytest.mark.parametrize("n", [8, 18, 64])
@pytest.mark.parametrize("moved", [0.0, 0.45])
def test_every_ray_in_an_empty_room_is_right(n: int, moved: float) -> None:
    """Its walls are flat and meet in hollow edges, which cells of four planes have exactly: whatever the resolution, wherever probes stand.

    But for its corners: four texels know of two walls and not of a third, and a ray goes on to where the two would meet.
    """
    room = Room()
    found, _, _, truth = traced(room, (rooms.volume(room, *GRID, n=n, moved=moved),))
    np.testing.assert_array_equal(found.verdict, HIT)
    assert (np.abs(found.distance - truth) < 2e-6).mean() >= (1 if n == 64 else 0.995)


def test_normals_are_those_of_what_is_hit() -> None:
    room = Room(solids=BOXES)
    o, d = rooms.rays(room, 4000)
    found = trace(light_field((rooms.volume(room, *GRID),)), o, d)
    distance, normal = room.hit(o, d)
    same = (found.verdict == HIT) & np.isclose(found.distance, distance, rtol=0, atol=1e-5)
    assert same.mean() > 0.97
    np.testing.assert_allclose(found.normal[same], normal[same], atol=1e-6)


def test_rays_leave_through_an_open_roof() -> None:
    room = Room(open_top=True)
    found, _, _, truth = traced(room, (rooms.volume(room, *GRID),))
    sky = ~np.isfinite(truth)
    # Who goes out low over a wall is behind it for all probes: nobody knows what it meets there.
    assert (found.verdict[sky] == MISS).mean() > 0.9
    assert (found.verdict[sky] == HIT).mean() < 0.005
    assert (found.verdict[~sky] == MISS).mean() < 0.005
    both = (found.verdict == HIT) & ~sky
    assert (np.abs(found.distance[both] - truth[both]) < 1e-5).mean() > 0.998


@pytest.mark.parametrize(("n", "normals", "least", "most"), [(64, None, 0.99, 0.005), (32, None, 0.97, 0.01), (64, 32, 0.98, 0.01)])
def test_boxes_in_a_room(n: int, normals: int | None, least: float, most: float) -> None:
    room = Room(solids=BOXES)
    volumes = (rooms.volume(room, *GRID, n=n, normals=normals, moved=0.2),)
    found, o, d, truth = traced(room, volumes)
    figures = compare_traces(volumes, Rays(o, d, truth), found)
    assert figures.agree > least
    assert figures.false_hits < most


def test_several_volumes_a_flat_one_and_one_within_another() -> None:
    room = Room(solids=BOXES)
    fine = rooms.volume(room, (-0.2, 0.3, -1.4), (0.5, 0.5, 0.5), (3, 5, 6), name="fine")
    flat = rooms.volume(room, (-1.5, 1.9, -1.5), (1.0, 1.0, 1.0), (4, 1, 4), name="flat")
    found, o, d, truth = traced(room, (fine, flat))
    figures = compare_traces((fine, flat), Rays(o, d, truth), found)
    # Together they do not reach behind everything.
    assert figures.agree > 0.95
    assert figures.false_hits + figures.false_misses + figures.late_hits < 0.01
    assert set(found.volume) >= {0, 1}


def test_rays_through_probes_and_along_axes() -> None:
    room = Room()
    volume = rooms.volume(room, *GRID)
    stands = volume.positions()
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    o, d = np.repeat(stands, 6, 0), np.tile(axes, (len(stands), 1))
    # From the wall through the middle of every probe, and away from one.
    through = o - d * room.hit(o, -d)[0][:, None]
    for start in (o, through):
        found = trace(light_field((volume,)), start, d)
        np.testing.assert_array_equal(found.verdict, HIT)
        np.testing.assert_allclose(found.distance, room.hit(o, d)[0] + np.linalg.norm(o - start, axis=1), atol=1e-5)


def test_who_begins_behind_what_probes_see_is_unknown() -> None:
    room = Room(solids=BOXES)
    volumes = (rooms.volume(room, *GRID),)
    inside = np.array([[-0.8, 0.8, -0.6], [0.8, 0.4, 0.8]])
    d = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    found = trace(light_field(volumes), inside, d)
    np.testing.assert_array_equal(found.verdict, UNKNOWN)
    # Everything around has irradiance π: radiance 1.
    np.testing.assert_allclose(arriving(volumes, found, inside, d, 0.0), 1, rtol=1e-6)


def test_radiance_is_that_of_the_point_that_is_hit() -> None:
    room = Room()
    volumes = (rooms.volume(room, *GRID, light=64),)
    found, o, d, truth = traced(room, volumes)
    expected = rooms.radiance(o + truth[:, None] * d)
    mirrored = arriving(volumes, found, o, d, 0.0)
    # Bilinear between texels that are 0.055 rad apart, of radiance whose gradient is at most 0.6 a metre.
    assert np.sqrt(((mirrored - expected) ** 2).mean()) < 0.005
    assert np.abs(mirrored - expected).max() < 0.1
    rough = arriving(volumes, found, o, d, 1.0)
    assert rough.std() < expected.std()


def test_the_hierarchy_is_a_bound() -> None:
    room = Room(solids=BOXES, open_top=True)
    volume = rooms.volume(room, *GRID, n=16)
    count = int(volume.states.sum())
    distance, normal = tiles_of(volume.atlases["distance"], count)[..., 0], tiles_of(volume.atlases["normal"], count)
    levels = nearest_levels(distance, normal, rooms.MISS)
    assert [level.shape[1] for level in levels] == level_sides(16) == [9, 5]
    rng = np.random.default_rng(1)
    n = 16
    at = rng.uniform(-1, 1, (4000, 2))
    w = oct_to_dir(at)
    cell = np.floor((at * 0.5 + 0.5) * n + 0.5).astype(int)
    centre = oct_to_dir(wrap_oct((2.0 * np.stack(np.meshgrid(np.arange(n + 2), np.arange(n + 2)), -1) - n - 1) / n))
    for t in range(count):
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            i, j = cell[:, 0] + x, cell[:, 1] + y
            d, m = distance[t, j, i].astype(float), normal[t, j, i].astype(float)
            height, along = -(m * centre[j, i]).sum(-1) * d, -(m * w).sum(-1)
            plane = np.where(d >= rooms.MISS, rooms.MISS, np.where(along > 0, height / np.maximum(along, 1e-12), np.inf))
            for k, level in enumerate(levels, 1):
                assert (level[t, cell[:, 1] >> k, cell[:, 0] >> k, 0] <= plane * (1 + 1e-6)).all()


def test_points_over_the_edge_are_those_that_borders_hold() -> None:
    n = 6
    inner = (2 * np.arange(n) + 1) / n - 1
    texels = np.stack(np.meshgrid(inner, inner), -1)
    outer = (2.0 * np.arange(n + 2) - n - 1) / n
    np.testing.assert_allclose(wrap_oct(np.stack(np.meshgrid(outer, outer), -1)), with_border(texels), atol=1e-12)


def test_blurred_radiance() -> None:
    for n, alphas in ((64, 5), (16, 3), (4, 1)):
        assert len(gloss_alphas(n)) == len(gloss_sides(n)) == alphas
        assert gloss_alphas(n)[-1] == 1
        assert np.all(np.diff(gloss_alphas(n)) > 0)
    levels = gloss_levels(np.full((3, 16, 16, 3), 2.5, np.float32))
    for level in levels:
        np.testing.assert_allclose(level, 2.5, rtol=1e-6)
    # Of L = 1 + w·z a lobe's mean is 1 + c w·z, c its mean cosine. At alpha 1 GGX is even, and weights are cosines: c = ∫cos² / ∫cos = 2/3.
    light = np.repeat((1 + texel_directions(32)[..., 2:])[None], 3, -1).astype(np.float32)
    widest = gloss_levels(light)[-1][0, 1:-1, 1:-1, 0]
    np.testing.assert_allclose(widest, 1 + 2 / 3 * texel_directions(8)[..., 2], atol=0.01)


def test_a_chain_is_packed_as_its_places_say() -> None:
    assert chain_places([4, 2, 1]) == ([(0, 0), (4, 0), (4, 2)], (6, 4))
    assert chain_places([5]) == ([(0, 0)], (5, 5))
    levels = [np.arange(3 * s * s, dtype=np.float32).reshape(3, s, s, 1) + 100 * s for s in (4, 2, 1)]
    packed = pack_chain(levels, Layout(2, 1, 2))
    assert packed.shape == (2, 4, 12, 1)
    np.testing.assert_array_equal(packed[1, :4, :4], levels[0][2])
    np.testing.assert_array_equal(packed[0, :2, 10:12], levels[1][1])
    assert packed[0, 2, 10, 0] == levels[2][1, 0, 0, 0]
