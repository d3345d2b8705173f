"""The light cache: what it answers is what paths would have found, no wall is read through, and it is the same wherever it is made."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.allocation import SCRAMBLES, Allocation
from bake_core.bake import empty_state
from bake_core.cache_cells import codes
from bake_core.cache_points import Points
from bake_core.errors import Cancelled
from bake_core.examples import Example, closed_box, cornell, two_rooms
from bake_core.gltf.writer import GlbWriter
from bake_core.light_cache import AXIS_CELLS, cell_key, cell_of, facing
from bake_core.octahedral import texel_directions
from bake_core.prepared import Prepared, prepare
from bake_core.shards import shard_ranges, trace_shard
from bake_core.spec import parse_spec
from bake_core.surface_light import SurfaceLight
from bake_core.tally import State
from tests.scenes import add_square, load
from tests.unit.gltf_build import load_glb

Array = NDArray[Any]
# Of a box from -1 to 1.
_INSIDE = {"origin": [-0.75, -0.75, -0.75], "spacing": [0.5, 0.5, 0.5], "counts": [4, 4, 4]}


def prepared(example: Example, **spec: Any) -> Prepared:
    glb, own = example
    with tempfile.TemporaryDirectory() as folder:
        return prepare(load_glb(glb, Path(folder)), parse_spec({**own, **spec}), threads=2)


def traced(p: Prepared, ends: tuple[int, ...] = (16, 32), shards: int = 1, threads: int = 2) -> State:
    """Whole passes, up to each of these samples."""
    state = empty_state(p)
    for samples in pairwise((0, *ends)):
        given = state.allocation
        state.add([trace_shard(p, r, samples, given, threads=threads) for r in shard_ranges(p.probe_count, shards)])
    return state


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
    grid = np.array([-3.0, 2.0, 10.0, 0.01, 6, 1, np.inf])
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
    grid = np.array([0.0, 0, 0, 1, 4, 1, np.inf])
    assert cell_of(grid, (0.5, AXIS_CELLS - 0.5, 3.0)) == (0, AXIS_CELLS - 1, 3, True)
    for p in ((-0.1, 0.0, 0.0), (0.0, AXIS_CELLS + 0.5, 0.0), (0.0, 0.0, 1e30), (-1e30, 0.0, 0.0)):
        assert not cell_of(grid, p)[3]


# --- light -------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bounces", [None, 4])
def test_a_closed_box_has_the_closed_form_s_light(bounces: int | None) -> None:
    """π Le (1 - aᵏ⁺¹) / (1 - a), the cache limited to as many bounces as paths are."""
    albedo, emission = 0.6, 2.0
    p = prepared(closed_box(albedo, emission, bounces), integrator="cache", volumes=[_INSIDE])
    assert p.light is not None
    expected = math.pi * emission * (1 - (albedo ** (bounces + 1) if bounces else 0)) / (1 - albedo)
    assert traced(p).mean().mean() == pytest.approx(expected, rel=2e-3)


def test_it_agrees_with_paths_within_what_both_say_of_themselves() -> None:
    spec = {"volumes": [{"fit": "scene", "counts": [5, 5, 5]}]}
    cache, path = (traced(prepared(cornell(), integrator=i, **spec), (16, 32, 64)) for i in ("cache", "path"))
    active = np.flatnonzero(cache.active())
    assert np.array_equal(cache.active(), path.active())
    squares = ((cache.mean(active) - path.mean(active)) ** 2).sum(-1)
    ours, theirs = cache.spread(), path.spread()
    assert ours is not None and theirs is not None
    scale = theirs.square + theirs.floor()
    found, stated = (squares / scale).mean(), ((ours.variance + theirs.variance) / scale).mean()
    # What cells smooth away is less than what both do not know, and it knows more than paths do. All probes share its luck.
    assert 0.3 * stated < found < 1.5 * stated
    assert (ours.variance / scale).mean() < 0.6 * (theirs.variance / scale).mean()
    assert cache.mean(active).mean() == pytest.approx(path.mean(active).mean(), rel=0.01)
    assert cache.rays < 0.7 * path.rays


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_a_dark_room_beside_a_bright_one_stays_exactly_dark(scale: float) -> None:
    p = prepared(two_rooms(scale=scale), integrator="cache", probes="lattice")
    assert p.light is not None
    state, path = (traced(q, (16,)) for q in (p, replace(p, light=None)))
    dark = np.flatnonzero(path.active() & (path.mean().max((1, 2)) == 0))
    assert len(dark) > 10
    assert not state.mean(dark).any()


def test_what_sticks_through_a_floor_is_not_read_from_below() -> None:
    """A post that stands in a lit room and reaches through its floor, with probes below: its cells straddle the floor."""
    w, grey = GlbWriter(), (0.6, 0.6, 0.6)
    for height in (0.0, 2.0):
        add_square(w, f"at {height:g} m", grey, matrix=_placed(4, 4, y=height), double_sided=True)
    for i in range(4):
        turn = i * math.pi / 2
        about = np.array([[math.cos(turn), 0, math.sin(turn), 0], [0, 1, 0, 0], [-math.sin(turn), 0, math.cos(turn), 0], [0, 0, 0, 1]])
        upright = np.array([[0, 1, 0, 0.5], [0.2, 0, 0, 0.1], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        add_square(w, f"post {i}", grey, matrix=about @ upright, double_sided=True)
    add_square(w, "lamp", (0.0, 0.0, 0.0), emission=(5.0, 5.0, 5.0), matrix=_placed(1, 1, y=1.9), double_sided=True)
    below = {"origin": [-0.9, -0.8, -0.9], "spacing": [0.6, 0.3, 0.6], "counts": [4, 2, 4]}
    above = {"origin": [-0.9, 0.3, -0.9], "spacing": [0.6, 0.4, 0.6], "counts": [4, 4, 4]}
    spec = {"version": 1, "volumes": [below, above], "probes": "lattice", "max_bounces": 4}
    p = prepare(load(w), parse_spec({**spec, "integrator": "cache"}), threads=2)
    path = traced(replace(p, light=None), (16, 32))
    state = traced(p, (16, 32))
    assert state.mean(slice(0, 32)).mean() == pytest.approx(path.mean(slice(0, 32)).mean(), rel=0.05)


def _placed(x: float, z: float, *, y: float) -> Array:
    """A matrix that makes the unit square this large, so high."""
    matrix = np.diag([x, 1, z, 1.0])
    matrix[1, 3] = y
    return matrix


# --- where it is made --------------------------------------------------------------------------------------------------------------


def test_threads_shards_and_a_process_that_takes_over_change_no_bit() -> None:
    spec = {"volumes": [{"fit": "scene", "counts": [4, 4, 4]}], "integrator": "cache"}
    whole = traced(prepared(cornell(), **spec), threads=1)
    split = traced(prepared(cornell(), **spec), shards=3, threads=2)
    assert np.array_equal(whole.irradiance, split.irradiance)
    late = prepared(cornell(), **spec)
    given = Allocation(whole.taken * 0 + 8, whole.eighths)
    first = trace_shard(prepared(cornell(), **spec), (0, 64), (0, 16), Allocation.start(64), threads=2)
    second = trace_shard(late, (0, 64), (16, 32), given, threads=2)
    both = empty_state(late)
    both.add([first])
    both.add([second])
    assert np.array_equal(whole.irradiance, both.irradiance)
    # Back to an earlier stage, as a job does that is run again.
    assert np.array_equal(trace_shard(late, (0, 64), (0, 16), Allocation.start(64), threads=2).irradiance, first.irradiance)


def test_who_is_stopped_while_it_learns_begins_again() -> None:
    p = prepared(cornell(), integrator="cache", volumes=[{"fit": "scene", "counts": [4, 4, 4]}])
    assert p.light is not None
    with pytest.raises(Cancelled):
        p.light.tracer(16, threads=2, cancelled=np.ones(1, np.uint8))
    afresh = prepared(cornell(), integrator="cache", volumes=[{"fit": "scene", "counts": [4, 4, 4]}])
    assert np.array_equal(traced(p, (16,)).irradiance, traced(afresh, (16,)).irradiance)


def test_a_large_bake_holds_no_more_points_than_it_may() -> None:
    """Many probes of many texels: more paths from each point instead, and the same number of them in all."""
    light = prepared(cornell(), integrator="cache").light
    assert light is not None
    tracer = light.blank()
    for probes, texels in ((512, 256), (512, 64 * 64), (20_000, 64 * 64), (1 << 20, 256)):
        large = SurfaceLight(tracer, np.zeros((probes, 3)), np.ones(probes), texels, 0)
        assert large.bytes(1 << 20) < 1.2e9
        for stage in range(8):
            assert large._rounds(stage) * large._paths(stage) == pytest.approx(texels / 2 * 2**stage, rel=0.5)


# --- when it is used ---------------------------------------------------------------------------------------------------------------


def test_auto_takes_it_where_it_pays() -> None:
    inside = {"origin": [-0.75, 0.25, -0.75], "spacing": [0.5, 0.5, 0.5]}
    many, few = [{**inside, "counts": [4, 4, 4]}], [{**inside, "counts": [4, 4, 3]}]
    assert isinstance(prepared(cornell(), volumes=many).light, SurfaceLight)
    assert prepared(cornell(), volumes=few).light is None, "nothing to share"
    assert prepared(cornell(), volumes=many, max_bounces=1).light is None, "nothing to know"
    assert prepared(closed_box(0.5, 1.0, roughness=0.5), volumes=[_INSIDE]).light is None, "no surface is matt"
    assert prepared(cornell(), volumes=many, integrator="path").light is None
    assert prepared(cornell(), volumes=few, integrator="cache").light is not None
    assert prepared(cornell(), volumes=many).light.blank().tables.cache.light.shape[1] == SCRAMBLES  # type: ignore[union-attr]
