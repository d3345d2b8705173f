"""Paths, where the answer is known: emitters over a floor, roulette, sealed rooms, scales, shading normals, vertex colours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core import tally
from bake_core.allocation import Allocation
from bake_core.examples import closed_box, two_rooms
from bake_core.gltf.writer import GlbWriter, Part, look_at
from bake_core.picture import Picture, path_trace_picture
from bake_core.prepared import Prepared, prepare
from bake_core.scene import Camera, Scene
from bake_core.shards import trace_shard
from bake_core.spec import parse_spec
from bake_core.stability.scenes import box_with_hole
from bake_core.stability.scenes import scene as glb_of
from tests.scenes import QUAD, SQUARE, add_square, build, camera_at, icosphere, load, load_example, polygon_irradiance, sky
from tests.unit.gltf_build import load_glb

Array = NDArray[Any]
BLACK = (0.0, 0.0, 0.0)
WHITE = (1.0, 1.0, 1.0)


def prepared(scene: Scene | GlbWriter, spec: dict[str, Any]) -> Prepared:
    return prepare(load(scene) if isinstance(scene, GlbWriter) else scene, parse_spec(spec))


def irradiance(p: Prepared, samples: int) -> Array:
    """Every texel of every probe, (n, m, 3)."""
    tally = trace_shard(p, (0, p.probe_count), (0, samples), Allocation.start(p.probe_count), threads=1)
    return np.asarray(tally.irradiance.sum(1) / samples)


def means_over_seeds(scene: Scene, spec: dict[str, Any], samples: int, seeds: int) -> Array:
    """(seeds,) means over all probes and texels."""
    return np.array([irradiance(prepared(scene, {**spec, "seed": seed}), samples).mean() for seed in range(seeds)])


def assert_mean(found: Array, expected: float, *, within: float) -> None:
    """A z-test, and that it is sharp: the standard error of the mean is at most `within` of what is expected."""
    error = found.std(ddof=1) / math.sqrt(len(found))
    assert error < within * expected, "too few samples to tell"
    assert abs(found.mean() - expected) < 4 * error


# --- emitters ----------------------------------------------------------------------------------------------------------------------


def lamp_over_floor(height: float, *, double_sided: bool = False, turned: bool = False) -> GlbWriter:
    """A black square lamp of 1 m² that faces a large floor, or with `turned` faces away from it."""
    w = GlbWriter()
    add_square(w, "floor", (0.5, 0.5, 0.5), matrix=np.diag([20.0, 1, 20, 1]))
    matrix = np.diag([1.0, -1, -1, 1]) if not turned else np.eye(4)
    matrix[1, 3] = height
    add_square(w, "lamp", BLACK, matrix=matrix, emission=(3.0, 2.0, 1.0), double_sided=double_sided)
    return w


def spot_on_floor(w: GlbWriter, at: tuple[float, float], samples: int, max_bounces: int | None) -> Picture:
    """What leaves the floor at one point, from the side and below the lamp, so that the lamp is not in the way."""
    x, z = at
    # So narrow that the pixel is a point.
    camera = camera_at((x - 0.3, 0.02, z), (x, 0, z), width=1e-4)
    return path_trace_picture(build(w), camera, 4, 4, samples=samples, seed=3, max_bounces=max_bounces)


@pytest.mark.parametrize("height", [0.05, 0.5, 3.0])
@pytest.mark.parametrize("at", [(0.0, 0.0), (0.55, 0.2), (3.0, 1.0)])
def test_emitter_over_a_floor(height: float, at: tuple[float, float]) -> None:
    """Where light samples do well (far away), where material samples do (close by), and between: Lambert's polygon formula."""
    picture = spot_on_floor(lamp_over_floor(height), at, 8192, 1)
    e = polygon_irradiance(SQUARE + [0, height, 0], [at[0], 0, at[1]], [0, 1, 0])
    found = picture.indirect.mean((0, 1))
    assert found == pytest.approx(0.5 / math.pi * e * np.array([3.0, 2.0, 1.0]), rel=0.01)
    assert not picture.direct.any() and not picture.emission.any()


@pytest.mark.parametrize(("double_sided", "turned", "factor"), [(True, False, 1), (True, True, 1), (False, True, 0)])
def test_emitters_shine_from_the_front_and_from_the_back_only_where_double_sided(double_sided: bool, turned: bool, factor: int) -> None:
    w = lamp_over_floor(0.5, double_sided=double_sided, turned=turned)
    e = polygon_irradiance(SQUARE + [0, 0.5, 0], [0.2, 0, 0], [0, 1, 0])
    found = spot_on_floor(w, (0.2, 0.0), 1024, 1).indirect.mean((0, 1))
    assert found == pytest.approx(factor * 0.5 / math.pi * e * np.array([3.0, 2.0, 1.0]), rel=0.01)


def test_emitters_of_very_different_size_and_strength_add_up() -> None:
    """Instances of one mesh, mirrored and scaled, and a lamp of its own."""
    w = GlbWriter()
    add_square(w, "floor", (0.5, 0.5, 0.5), matrix=np.diag([40.0, 1, 40, 1]))
    part = Part(SQUARE, QUAD, material=w.material("glow", BLACK, emission=(5.0,) * 3))
    mesh = w.mesh("glow", [part])
    truth = 0.0
    for x, y, size in ((-1.0, 0.5, 0.1), (0.5, 1.0, -1.0), (-4.0, 6.0, 3.0)):  # none in front of another
        matrix = np.diag([size, -1, abs(size), 1])
        matrix[:3, 3] = x, y, 0
        w.node(mesh=mesh, matrix=matrix)
        truth += 5.0 * polygon_irradiance(SQUARE * abs(size) + [x, y, 0], [0, 0, 0], [0, 1, 0])
    matrix = np.diag([1.0, -1, -1, 1])
    matrix[:3, 3] = 0, 2, 2
    add_square(w, "own", BLACK, matrix=matrix, emission=(0.01,) * 3)
    truth += 0.01 * polygon_irradiance(SQUARE + [0, 2, 2], [0, 0, 0], [0, 1, 0])
    found = spot_on_floor(w, (0.0, 0.0), 4096, 1).indirect.mean()
    assert found == pytest.approx(0.5 / math.pi * truth, rel=0.01)


def test_max_bounces_cuts_where_it_says() -> None:
    """0: the floor is dark. 1: lit by the lamp. 2: a lamp of albedo 0 adds nothing. And the lamp itself is seen at 0."""
    w = lamp_over_floor(0.5)
    pictures = [spot_on_floor(w, (0.2, 0.0), 64, k).whole.mean() for k in (0, 1, 2)]
    assert pictures[0] == 0 < pictures[1] == pytest.approx(pictures[2], rel=1e-6)
    below = camera_at((0.1, 0.1, 0.1), (0.1, 0.5, 0.1), width=0.1)
    picture = path_trace_picture(build(w), below, 2, 2, samples=4, seed=0, max_bounces=0)
    np.testing.assert_array_equal(picture.emission, np.broadcast_to(np.array([3, 2, 1], np.float32), (2, 2, 3)))
    assert not picture.indirect.any()


# --- roulette ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("albedo", "seeds"), [(0.5, 40), (0.9, 40), (0.99, 12)])
def test_roulette_is_unbiased_in_a_furnace(tmp_path: Path, albedo: float, seeds: int) -> None:
    """Few samples, many seeds: the mean is the closed form, and what roulette adds to the spread is small."""
    glb, spec = closed_box(albedo, 1.0)
    expected = math.pi / (1 - float(np.float32(albedo)))
    found = means_over_seeds(load_glb(glb, tmp_path), spec, 1, seeds)
    assert_mean(found, expected, within=2e-3)
    # 8 probes of 256 paths, each with a relative σ of at most 0.1 √a (see bake_core.transport).
    assert found.std(ddof=1) / expected < 2 * 0.1 / math.sqrt(8 * 256)


PROBES = {"name": "box", "origin": [-0.55, -0.45, -0.6], "spacing": [1.0, 1.0, 1.0], "counts": [2, 2, 2]}


def test_white_and_nearly_closed_under_a_white_sky() -> None:
    """Albedo exactly 1: radiance is 1 everywhere, though a path takes 40 vertices to find the window."""
    scene = load_example(glb_of(box_with_hole(0.4), 1.0))
    found = means_over_seeds(scene, {"volumes": [PROBES], "environment": sky()}, 4, 12)
    assert_mean(found, math.pi, within=0.02)


def test_white_and_sealed_without_light_is_black_and_ends() -> None:
    """No path finds light and no throughput falls: only roulette ends them."""
    glb, spec = closed_box(1.0, 0.0)
    with_lamp_outside = {**spec, "environment": sky(1e6), "lights": [{"kind": "point", "position": [3, 0, 0], "intensity": [1e6] * 3}]}
    scene = load_example(glb)
    assert not irradiance(prepared(scene, with_lamp_outside), 16).any()


# --- leaks and scales ---------------------------------------------------------------------------------------------------------------


def test_a_sealed_room_beside_a_bright_one_is_exactly_black(tmp_path: Path) -> None:
    glb, spec = two_rooms()
    p = prepared(load_glb(glb, tmp_path), spec)
    texels = irradiance(p, 32)
    left = p.positions[:, 0] + p.scene.origin[0] < 0
    assert not texels[~left].any()
    assert (texels[left] > 0).all()


def furnace(kind: str, matrix: Array) -> Scene:
    """Albedo ½ and emission 1 inside, nothing outside: light is lost where a path slips out."""
    w = GlbWriter()
    wall = w.material("wall", (0.5,) * 3, emission=(1.0,) * 3)
    if kind == "box":
        corner = np.array([[(-1, 1)[i >> a & 1] for a in range(3)] for i in range(8)], np.float64)
        sides = [corner[list(s)] for s in ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))]
        part = Part(np.concatenate(sides), np.concatenate([QUAD + 4 * i for i in range(6)]), material=wall)
    else:
        vertices, faces = icosphere(3)
        part = Part(vertices, faces[:, ::-1], material=wall)
    mesh = w.mesh(kind, [part])
    w.node(kind, mesh=mesh, matrix=matrix)
    if kind == "instanced sphere":
        # A second one, far enough away: then both are instances of one mesh.
        elsewhere = matrix.copy()
        elsewhere[:3, 3] += 10 * np.abs(matrix[:3, :3]).max() * np.array([1, 0, 0])
        w.node("second", mesh=mesh, matrix=elsewhere)
    return load(w)


def placed(scale: float, at: float = 0.0, turn: float = 0.0) -> Array:
    """Scaled, turned about an odd axis, and moved by `at` metres along x, y and z."""
    from trimesh.transformations import rotation_matrix

    matrix = np.asarray(rotation_matrix(turn, [1, 2, 3]), np.float64) @ np.diag([scale, scale, scale, 1])
    matrix[:3, 3] = at
    return np.asarray(matrix)


@pytest.mark.parametrize("kind", ["box", "sphere", "instanced sphere"])
@pytest.mark.parametrize(("scale", "at"), [(1.0, 0.0), (1e-4, 0.0), (1e6, 0.0), (1.0, 1e6), (100.0, 1e6)])
def test_furnaces_of_every_size_and_place(kind: str, scale: float, at: float) -> None:
    """Leaving a surface by too little meets it again (brighter here), by too much passes through a wall (darker)."""
    matrix = placed(scale, at, turn=0.7)
    volume = {"origin": [at, at, at], "spacing": [0.3 * scale] * 3, "counts": [2, 2, 1]}
    p = prepared(furnace(kind, matrix), {"volumes": [volume]})
    texels = irradiance(p, 32)
    # The furnace's light is the same along every path, so what is left is roulette's noise.
    assert texels.mean() == pytest.approx(2 * math.pi, rel=1e-3)
    np.testing.assert_allclose(texels, 2 * math.pi, rtol=0.02)


def test_one_surface_does_not_see_itself() -> None:
    """A convex body of albedo 1 under a white sky: no path meets it twice, so radiance is 1 with no noise at all."""
    vertices, faces = icosphere(4)
    for scale, at in ((1.0, 0.0), (1e-4, 0.0), (1e6, 0.0), (1.0, 1e6)):
        w = GlbWriter()
        mesh = w.mesh("ball", [Part(vertices, faces, material=w.material("white", WHITE))])
        w.node("ball", mesh=mesh, matrix=placed(scale, at, 0.3))
        w.node("twin", mesh=mesh, matrix=placed(scale, at + 100 * scale))
        camera = Camera("c", look_at([at, at, at + 3 * scale], [at, at, at]), 0.9)
        picture = path_trace_picture(build(w, environment=sky()), camera, 64, 64, samples=16, seed=2)
        assert 0.3 < picture.hit.mean() < 0.9
        np.testing.assert_allclose(picture.whole, 1, rtol=2e-6)


# --- surfaces -----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("double_sided", [False, True])
def test_shading_normals_conserve_energy(double_sided: bool) -> None:
    """A coarse ball with smooth normals, albedo 1, sky 1: radiance is exactly 1, up to the silhouette."""
    vertices, faces = icosphere(1)
    w = GlbWriter()
    white = w.material("white", WHITE, double_sided=double_sided)
    w.node("ball", mesh=w.mesh("ball", [Part(vertices, faces, normals=vertices, material=white)]))
    camera = camera_at((0, 0, 3), (0, 0, 0), width=2.5)
    picture = path_trace_picture(build(w, environment=sky()), camera, 48, 48, samples=16, seed=4)
    assert picture.hit.mean() > 0.3
    np.testing.assert_allclose(picture.whole, 1, rtol=2e-6)


def test_shading_normals_shade() -> None:
    """A square whose normals all lean to +x, under a sun: the folded Lambert of the leaning normal."""
    lean, sun = np.array([0.6, 0.8, 0.0]), np.array([-0.8, -0.6, 0.0])
    w = GlbWriter()
    part = Part(SQUARE, QUAD, normals=np.tile(lean, (4, 1)), material=w.material("grey", (0.5,) * 3))
    w.node("square", mesh=w.mesh("square", [part]))
    lights = [{"kind": "directional", "direction": sun.tolist(), "irradiance": [2.0] * 3}]
    picture = path_trace_picture(build(w, lights=lights), camera_at((0, 5, 0), (0, 0, 0), width=0.5), 4, 4, samples=4, seed=0)
    mirrored = sun * [1, -1, 1]
    expected = 0.5 / math.pi * 2.0 * (max(0.0, float(-sun @ lean)) + max(0.0, float(-mirrored @ lean)))
    np.testing.assert_allclose(picture.direct, expected, rtol=1e-5)


def test_vertex_colours_multiply_the_base_colour() -> None:
    """A ramp along x under a white sky: radiance is base colour times the interpolated colour, with no noise."""
    base, left, right = np.array([0.9, 0.6, 0.3]), np.array([1.0, 0.2, 0.0]), np.array([0.0, 0.8, 0.5])
    colors = np.where(SQUARE[:, :1] < 0, left, right)
    w = GlbWriter()
    add_square(w, "square", base.tolist(), vertex_colors=colors)
    camera = camera_at((0, 50, 0), (0, 0, 0), width=0.8)
    picture = path_trace_picture(build(w, environment=sky()), camera, 8, 8, samples=64, seed=0).whole
    x = (((np.arange(8) + 0.5) / 8 - 0.5) * 0.8 * camera.matrix[0, 0])[:, None]
    expected = base * (left + (x + 0.5) * (right - left))
    np.testing.assert_allclose(picture, np.broadcast_to(expected, (8, 8, 3)), rtol=4e-3, atol=1e-3)


def test_camera_rays_pass_through_backs_of_single_sided_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """From behind: what lies beyond; from in front, and where double-sided: the surface. A probe's rays do not pass: black."""
    below, above = camera_at((0, -3, 0), (0, 0, 0), width=0.5), camera_at((0, 3, 0), (0, 0, 0), width=0.5)
    for double_sided, camera, shown in ((False, below, 0.25), (True, below, 0.5), (False, above, 0.5)):
        w = GlbWriter()
        add_square(w, "grey", (0.5,) * 3, double_sided=double_sided)
        picture = path_trace_picture(build(w, environment=sky(1.0)), camera, 2, 2, samples=4, seed=0)
        assert picture.hit.all() == (shown == 0.5)
        np.testing.assert_allclose(picture.whole, 1.0 if shown == 0.25 else 0.5, rtol=1e-6)
    # Seen by a probe 0.2 m below: the hemisphere above is black as far as the square reaches.
    w = GlbWriter()
    add_square(w, "grey", (0.5,) * 3, matrix=np.diag([1e4, 1, 1e4, 1]))
    volume = {"origin": [0, -0.2, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}
    p = prepared(w, {"volumes": [volume], "environment": sky()})
    monkeypatch.setattr(tally, "BACKFACE_LIMIT", 1.0)
    traced = trace_shard(p, (0, 1), (0, 16), Allocation.start(1), threads=1)
    assert traced.backface[0] == pytest.approx(0.5, abs=0.01)
    e = traced.irradiance.sum((1, 3))[0] / 16 / 3
    assert e.max() == pytest.approx(math.pi, rel=0.05) and e.min() < 0.05 * math.pi


def test_no_geometry() -> None:
    """Only the environment: π times its radiance everywhere, exactly black without it; a picture of nothing but sky."""
    w = GlbWriter()
    w.node("empty")
    spec: dict[str, Any] = {"volumes": [PROBES]}
    np.testing.assert_allclose(irradiance(prepared(w, {**spec, "environment": sky(3.0)}), 8), 3 * math.pi, rtol=1e-6)
    assert not irradiance(prepared(w, {**spec, "lights": [{"kind": "point", "position": [0, 0, 0], "intensity": [1.0] * 3}]}), 8).any()
    picture = path_trace_picture(build(w, environment=sky(2.0)), camera_at((0, 0, 1), (0, 0, 0), width=1), 2, 2, samples=1, seed=0)
    assert not picture.hit.any() and (picture.emission == 2).all()


def test_probes_on_surfaces_and_corners_are_finite() -> None:
    """A probe exactly on a wall, an edge, a corner: no NaN, no infinity, nothing negative."""
    glb, _ = closed_box(0.5, 1.0)
    volume = {"origin": [-1, -1, -1], "spacing": [1, 1, 1], "counts": [3, 3, 3]}
    texels = irradiance(prepared(load_example(glb), {"volumes": [volume]}), 8)
    assert np.isfinite(texels).all() and (texels >= -1e-6).all()
