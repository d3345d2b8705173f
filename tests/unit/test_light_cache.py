"""The light cache: what it answers is what paths would have found, no wall is read through, and it is the same wherever it is made."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.allocation import SCRAMBLES, Allocation, uniform
from bake_core.bake import empty_state
from bake_core.cache_cells import codes
from bake_core.cache_points import Points
from bake_core.capture import Capture, capture_radiance
from bake_core.errors import Cancelled
from bake_core.examples import box_sides, closed_box, cornell, quads_part, two_rooms
from bake_core.gltf.writer import GlbWriter
from bake_core.light_cache import AXIS_CELLS, cell_key, cell_of, facing
from bake_core.octahedral import texel_directions
from bake_core.prepared import prepare
from bake_core.shards import trace_shard
from bake_core.spec import parse_spec
from bake_core.surface_light import SurfaceLight
from tests.baking import prepared, traced
from tests.scenes import add_square, load, load_example

Array = NDArray[Any]
# Of a box from -1 to 1.
_INSIDE = {"origin": [-0.75, -0.75, -0.75], "spacing": [0.5, 0.5, 0.5], "counts": [4, 4, 4]}
# Of a Cornell box.
_IN_CORNELL = {"origin": [-0.75, 0.25, -0.75], "spacing": [0.5, 0.5, 0.5], "counts": [4, 4, 4]}


# --- cells -------------------------------------------------------------------------------------------------------------------------


def test_every_way_to_face_is_one_of_54_and_an_axis_is_the_middle_of_its_side() -> None:
    normals = texel_directions(64).reshape(-1, 3)
    found = np.array([facing(*n) for n in normals])
    assert sorted(set(found.tolist())) == list(range(54))
    for axis in (*np.eye(3), *-np.eye(3)):
        near = [facing(*(n / np.linalg.norm(n))) for n in axis + 0.3 * (np.random.default_rng(0).random((100, 3)) - 0.5)]
        assert set(near) == {facing(*axis)}, "a wall that is nearly along an axis faces as the axis does"


def test_points_of_one_cell_stand_together_in_every_size() -> None:
    random = np.random.default_rng(1)
    grid = np.array([-3.0, 2.0, 10.0, 0.01, 6, 1, np.inf, 0])
    place = np.zeros((500, 10))
    place[:, :3] = grid[:3] + random.random((500, 3)) * 0.3
    way = random.integers(0, 2, 500).astype(np.uint8)
    points = Points(place, way, np.zeros(500, np.uint64), np.zeros(500, np.uint8), np.zeros((500, 3)))
    code = codes(grid, points)
    for level in range(6):
        keys = [int(cell_key(*cell_of(grid, p)[:3], int(w), level)) for p, w in zip(place, way, strict=True)]
        shared = (code >> np.uint64(3 * level)).tolist()
        assert len(set(zip(keys, shared, strict=True))) == len(set(keys)) == len(set(shared))


def test_beyond_the_grid_nothing_is_known() -> None:
    grid = np.array([0.0, 0, 0, 1, 4, 1, np.inf, 0])
    assert cell_of(grid, (0.5, AXIS_CELLS - 0.5, 3.0)) == (0, AXIS_CELLS - 1, 3, True)
    for p in ((-0.1, 0.0, 0.0), (0.0, AXIS_CELLS + 0.5, 0.0), (0.0, 0.0, 1e30), (-1e30, 0.0, 0.0)):
        assert not cell_of(grid, p)[3]


# --- light -------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bounces", [None, 2, 4, 9])
def test_a_closed_box_has_the_closed_form_s_light(bounces: int | None) -> None:
    """π Le (1 - aᵏ⁺¹) / (1 - a), the cache limited to as many bounces as paths are: with one layer, some, and more than have their own."""
    albedo, emission = 0.6, 2.0
    p = prepared(closed_box(albedo, emission, bounces), integrator="cache", volumes=[_INSIDE])
    assert p.light is not None
    expected = math.pi * emission * (1 - (albedo ** (bounces + 1) if bounces else 0)) / (1 - albedo)
    assert traced(p).mean().mean() == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("power", [-80, 80])
def test_the_brightest_and_the_faintest_light_is_learnt_alike(power: int) -> None:
    """Light times a power of two is the same bits, though its squares, by which paths are guided, are beyond float32."""
    glb, document = two_rooms()
    scene, spec = load_example(glb), parse_spec({**document, "integrator": "cache"})
    scaled = replace(scene, materials=replace(scene.materials, emission=scene.materials.emission * np.float32(2.0**power)))
    plain, other = (traced(prepare(s, spec, threads=2)).mean() for s in (scene, scaled))
    assert plain.max() > 0
    np.testing.assert_array_equal(other * 2.0**-power, plain)


def test_open_cells_answer_as_if_they_were_asked() -> None:
    """A cell that is open is read without a ray: the same bits as with one, and most of a room's cells are."""
    p = prepared(cornell(), integrator="cache", volumes=[_IN_CORNELL])
    assert p.light is not None
    known = p.light.known(16, threads=2, cancelled=np.zeros(1, np.uint8))
    cache = known.tables.cache
    assert cache is not None and (cache.middle[:, 3] > 0).mean() > 0.5
    asking = cache._replace(middle=np.where([True, True, True, False], cache.middle, 0.0))
    rays, sums = [], []
    for some in (cache, asking):
        tracer = replace(known, tables=known.tables._replace(cache=some))
        irradiance, _, count = capture_radiance(
            tracer,
            p.positions,
            np.arange(p.probe_count, dtype=np.uint64),
            uniform(p.probe_count, (0, 16)),
            Capture(16, 8, 0, keep_radiance=False),
            threads=2,
            cancelled=np.zeros(1, np.uint8),
            advance=lambda _: None,
        )
        rays.append(count)
        sums.append(irradiance)
    np.testing.assert_array_equal(sums[0], sums[1])
    assert rays[0] < 0.85 * rays[1]


def test_it_differs_from_paths_by_what_both_state() -> None:
    """Over four seeds, for all probes share what one has learnt: squared differences over stated variances, and mean irradiance."""
    ratios, means, noise = [], [], []
    for seed in range(1, 5):
        cache, path = (traced(prepared(cornell(), integrator=i, seed=seed, volumes=[_IN_CORNELL]), (16, 32, 64)) for i in ("cache", "path"))
        ours, theirs = cache.spread(), path.spread()
        assert ours is not None and theirs is not None
        scale = theirs.square + theirs.floor()
        active = np.flatnonzero(cache.active())
        squares = ((cache.mean(active) - path.mean(active)) ** 2).sum(-1)
        ratios.append((squares / scale).mean() / ((ours.variance + theirs.variance) / scale).mean())
        means.append(cache.mean(active).mean() / path.mean(active).mean() - 1)
        noise.append((ours.variance / scale).mean() / (theirs.variance / scale).mean())
        assert cache.rays < 0.6 * path.rays
    # 1.02 ± 0.05 and ± 0.02 %, of twelve seeds: a cache that hid its noise or smoothed too much would be above, one that told of too much
    # below.
    assert 0.7 < np.mean(ratios) < 1.15
    assert np.mean(noise) < 0.95
    assert abs(np.mean(means)) < 0.0015


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_a_dark_room_beside_a_bright_one_stays_exactly_dark(scale: float) -> None:
    p = prepared(two_rooms(scale=scale), integrator="cache", probes="lattice")
    assert p.light is not None
    state, path = (traced(q, (16,)) for q in (p, replace(p, light=None)))
    dark = np.flatnonzero(path.active() & (path.mean().max((1, 2)) == 0))
    assert len(dark) > 10
    assert not state.mean(dark).any()


def test_what_sticks_through_a_floor_is_not_read_from_below() -> None:
    """A post in a sealed, lit room reaches through its floor, and probes stand below: the post's cells straddle the floor."""
    w = GlbWriter()
    wall = w.material("wall", (0.6, 0.6, 0.6), double_sided=True)
    boxes = [box_sides((-1.5, 0, -1.5), (1.5, 2, 1.5)), box_sides((-0.2, -0.5, -0.2), (0.2, 0.5, 0.2))]
    w.node("room", mesh=w.mesh("room", [quads_part(box, wall) for box in boxes]))
    lamp = np.diag([1, 1, 1, 1.0])
    lamp[1, 3] = 1.9
    add_square(w, "lamp", (0.0, 0.0, 0.0), emission=(5.0, 5.0, 5.0), matrix=lamp, double_sided=True)
    below = {"origin": [-0.6, -0.45, -0.6], "spacing": [0.4, 0.3, 0.4], "counts": [4, 2, 4]}
    above = {"origin": [-0.6, 0.15, -0.6], "spacing": [0.4, 0.3, 0.4], "counts": [4, 4, 4]}
    p = prepare(load(w), parse_spec({"volumes": [below, above], "probes": "lattice", "integrator": "cache"}), threads=2)
    means = traced(p).mean()
    assert means[32:].mean() > 1 and not means[:32].any()


# --- where it is made --------------------------------------------------------------------------------------------------------------


def test_threads_shards_and_a_process_that_takes_over_change_no_bit() -> None:
    spec = {"volumes": [{"fit": "scene", "counts": [4, 4, 4]}], "integrator": "cache"}
    whole = traced(prepared(cornell(), **spec), threads=1)
    split = traced(prepared(cornell(), **spec), shards=3, threads=2)
    assert np.array_equal(whole.irradiance, split.irradiance)
    late = prepared(cornell(), **spec)
    both = empty_state(late)
    first = trace_shard(prepared(cornell(), **spec), (0, 64), (0, 16), Allocation.start(64), threads=2)
    both.add([first])
    second = trace_shard(late, (0, 64), (16, 32), both.allocation, threads=2)
    both.add([second])
    assert np.array_equal(whole.irradiance, both.irradiance)
    # What was learnt is counted, and once, whoever learnt it; each of its points takes 16 paths.
    assert whole.rays == split.rays == both.rays == first.rays + first.learning + second.rays + second.learning
    assert min(first.learning, second.learning) > 16 * 1000
    assert trace_shard(late, (1, 64), (0, 16), Allocation.start(64), threads=2).learning == 0
    # Back to an earlier stage, as a job does that is run again.
    assert np.array_equal(trace_shard(late, (0, 64), (0, 16), Allocation.start(64), threads=2).irradiance, first.irradiance)


def test_who_is_stopped_while_it_learns_begins_again() -> None:
    p = prepared(cornell(), integrator="cache", volumes=[{"fit": "scene", "counts": [4, 4, 4]}])
    assert p.light is not None
    with pytest.raises(Cancelled):
        p.light.known(16, threads=2, cancelled=np.ones(1, np.uint8))
    afresh = prepared(cornell(), integrator="cache", volumes=[{"fit": "scene", "counts": [4, 4, 4]}])
    assert np.array_equal(traced(p, (16,)).irradiance, traced(afresh, (16,)).irradiance)


def test_a_large_bake_holds_no_more_points_than_it_may() -> None:
    """Many probes of many texels: more paths from each point instead, and the same number of them in all."""
    light = prepared(cornell(), integrator="cache").light
    assert light is not None
    for probes, texels in ((512, 256), (512, 64 * 64), (20_000, 64 * 64), (1 << 20, 256)):
        large = replace(light, positions=np.zeros((probes, 3)), units=np.ones(probes), texels=texels)
        assert large.bytes(1 << 20) < 1.2e9
        for stage in range(8):
            assert large.rounds(stage) * large.paths(stage) * SCRAMBLES == 8 * texels << stage


# --- when it is used ---------------------------------------------------------------------------------------------------------------


def test_auto_takes_it_where_it_pays() -> None:
    # On the lattice, so that nothing is traced to find out where probes are better off.
    many, few = [_IN_CORNELL], [{**_IN_CORNELL, "counts": [4, 4, 3]}]
    assert isinstance(prepared(cornell(), probes="lattice", volumes=many).light, SurfaceLight)
    assert prepared(cornell(), probes="lattice", volumes=few).light is None, "nothing to share"
    assert prepared(cornell(), probes="lattice", volumes=many, max_bounces=1).light is None, "nothing to know"
    assert prepared(closed_box(0.5, 1.0, roughness=0.5), probes="lattice", volumes=[_INSIDE]).light is None, "no surface is matt"
    assert prepared(cornell(), probes="lattice", volumes=many, integrator="path").light is None
    assert prepared(cornell(), probes="lattice", volumes=few, integrator="cache").light is not None
