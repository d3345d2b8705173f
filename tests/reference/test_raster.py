"""The rasterised picture without a bake: closed forms, and small pictures beside the path tracer's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core import examples
from bake_core.bundle import VolumeData
from bake_core.cameras import looking
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.scene import Camera, Scene
from tests.conformance import synthetic
from tests.reference.small_pictures import QUAD, SQUARE, both, constant_volume, eye, raster, scene_of, spec_of


def test_indirect_light_is_albedo_over_pi_times_the_probes_irradiance(tmp_path: Path) -> None:
    w = GlbWriter()
    w.node(mesh=w.mesh("floor", [Part(SQUARE * 10, QUAD, material=w.material("m", (0.5, 0.25, 1.0), emission=(3, 2, 1)))]))
    picture = raster(scene_of(tmp_path, w), spec_of(), eye((0, 1, 0), (0, 0, -0.5)), constant_volume((math.pi, 2 * math.pi, 1)))
    np.testing.assert_allclose(picture.indirect, np.broadcast_to([0.5, 0.5, 1 / math.pi], picture.indirect.shape), rtol=1e-5)
    np.testing.assert_allclose(picture.emission, np.broadcast_to([3, 2, 1], picture.emission.shape), rtol=1e-6)
    assert not picture.direct.any()
    np.testing.assert_array_equal(picture.hit, 1)


def test_the_environment_stands_behind_everything_and_back_faces_are_not_there(tmp_path: Path) -> None:
    w = GlbWriter()
    w.node(mesh=w.mesh("floor", [Part(SQUARE, QUAD, material=w.material("m"))]))
    scene, spec = scene_of(tmp_path, w), spec_of(environment=(0.25, 0.5, 4))
    picture = raster(scene, spec, eye((0, -1, 0), (0, 0, 0)), constant_volume((1, 1, 1)))
    assert not picture.hit.any()
    np.testing.assert_array_equal(picture.emission, np.broadcast_to(np.array([0.25, 0.5, 4], np.float32), picture.emission.shape))
    assert not picture.indirect.any()
    above = raster(scene, spec, eye((0, 4, 0), (0, 0, 0)), constant_volume((1, 1, 1)))
    assert 0.1 < above.hit.mean() < 0.9


@pytest.mark.parametrize("elevation", [90, 45, 10, 2])
def test_a_plane_under_the_sun_does_not_shade_itself(tmp_path: Path, elevation: float) -> None:
    """Every pixel is albedo/π · E · sin(elevation), however slanted the light and whichever way the plane is turned."""
    a = math.radians(elevation)
    sun = {"kind": "directional", "direction": [math.cos(a), -math.sin(a), 0.1 * math.cos(a)], "irradiance": [2, 2, 2]}
    cosine = math.sin(a) / math.hypot(math.cos(a), math.sin(a), 0.1 * math.cos(a))
    w = GlbWriter()
    w.node(mesh=w.mesh("floor", [Part(SQUARE * 50, QUAD, material=w.material("m", (0.5, 0.5, 0.5)))]))
    picture = raster(scene_of(tmp_path, w), spec_of([sun]), eye((0.3, 2, 0.2), (9, 0, 7)), constant_volume((0, 0, 0)))
    on_floor = picture.hit == 1
    np.testing.assert_allclose(picture.direct[on_floor], 0.5 / math.pi * 2 * cosine, rtol=1e-4)


@pytest.mark.parametrize("kind", ["directional", "point"])
def test_a_sealed_room_is_dark_under_any_lamp_outside(tmp_path: Path, kind: str) -> None:
    glb, _ = examples.closed_box(0.5, 0.0)
    light = {
        "directional": {"kind": "directional", "direction": [-0.33, -0.56, -0.76], "irradiance": [1, 1, 1]},
        "point": {"kind": "point", "position": [7, 9, 8], "intensity": [200, 200, 200]},
    }[kind]
    scene = scene_of(tmp_path, glb)
    low, high = scene.bounds
    picture = raster(scene, spec_of([light]), eye(low * 0.1 + high * 0.9, low, 1.4), constant_volume((0, 0, 0)))
    assert picture.hit.mean() > 0.99
    # A lit wall would show 0.1 or more.
    assert picture.direct.mean() < 1e-5


def crowd() -> bytes:
    """A block used three times: turned, mirrored and squashed; a double-sided sheet; smooth normals; vertex colours."""
    w = GlbWriter()
    corner = np.array([[x, y, z] for z in (-0.3, 0.3) for y in (0.0, 1.0) for x in (-0.4, 0.2)])
    faces = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 4, 6, 2), (1, 3, 7, 5), (2, 6, 7, 3), (0, 1, 5, 4))
    colors = np.repeat(np.linspace(0.2, 1, 8)[:, None], 3, 1) * [1, 0.8, 0.5]
    triangles = [(a, b, c) for f in faces for a, b, c in ((f[0], f[1], f[2]), (f[0], f[2], f[3]))]
    block = w.mesh("block", [Part(corner, triangles, colors=colors, material=w.material("block", (0.8, 0.7, 0.6)))])
    w.node("turned", mesh=block, translation=(-1, 0, -0.5), rotation=(0, 0.28, 0, 0.96))
    w.node("mirrored", mesh=block, translation=(0.2, 0, -0.8), scale=(-1, 1, 1))
    w.node("squashed", mesh=block, translation=(1.1, 0, 0), scale=(1.4, 0.4, -0.7), rotation=(0, 0.6, 0, 0.8))
    w.node("floor", mesh=w.mesh("floor", [Part(SQUARE * 3, QUAD, material=w.material("floor", (0.5, 0.5, 0.5)))]))
    sheet = w.material("sheet", (0.3, 0.6, 0.9), double_sided=True)
    upright = SQUARE[:, [0, 2, 1]] * [0.5, 0.4, 1] + [-0.2, 0.7, 0.6]
    normals = upright - [-0.2, 0.7, 0.0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    w.node("sheet", mesh=w.mesh("sheet", [Part(upright, QUAD, normals=normals, material=sheet)]))
    return w.to_glb()


@pytest.mark.parametrize(
    "light",
    [
        {"kind": "directional", "direction": [0.5, -0.8, -0.35], "irradiance": [3, 2, 1]},
        {"kind": "point", "position": [0.6, 1.7, 1.2], "intensity": [3, 2, 1]},
        {
            "kind": "spot",
            "position": [1.5, 2, 1.5],
            "direction": [-0.7, -0.9, -0.8],
            "intensity": [9, 8, 7],
            "inner_angle": 0.2,
            "outer_angle": 0.6,
        },
        {
            "kind": "spot",
            "position": [0, 2, 0.8],
            "direction": [0.1, -1, -0.2],
            "intensity": [3, 2, 1],
            "inner_angle": 0.4,
            "outer_angle": 1.5,
        },
    ],
    ids=["directional", "point", "narrow spot", "wide spot"],
)
@pytest.mark.parametrize("position", [(1.5, 1.6, 2.6), (-1.2, 1.3, -2.4)], ids=["front", "back"])
def test_direct_light_and_its_shadows_are_the_path_tracers(tmp_path: Path, light: dict[str, Any], position: Sequence[float]) -> None:
    scene = scene_of(tmp_path, crowd())
    picture, traced = both(scene, spec_of([light]), eye(position, (0, 0.4, 0)))
    assert np.abs(picture.hit - traced.hit).mean() < 2e-3
    assert traced.direct.mean() > 0.005
    assert picture.direct.mean() == pytest.approx(traced.direct.mean(), rel=0.01)
    # Inside a lit or a dark region the two agree to rounding; pixels that an edge or a shadow's edge crosses are few.
    apart = np.abs(picture.direct - traced.direct).max(-1) > 0.02 * traced.direct.max()
    assert apart.mean() < 0.04


def test_many_lights_are_drawn_in_batches(tmp_path: Path) -> None:
    """Sixteen point lights need 96 shadow maps, more than a batch holds; together they are as bright as one sixteen times as bright."""
    lamp = {"kind": "point", "position": [0.6, 1.7, 1.2], "intensity": [0.5, 0.5, 0.5]}
    scene, camera = scene_of(tmp_path, crowd()), eye((1.5, 1.6, 2.6), (0, 0.4, 0))
    many = raster(scene, spec_of([lamp] * 16), camera, constant_volume((1, 1, 1)), 48, 27)
    one = raster(scene, spec_of([lamp | {"intensity": [8, 8, 8]}]), camera, constant_volume((1, 1, 1)), 48, 27)
    np.testing.assert_array_equal(many.indirect, one.indirect)
    np.testing.assert_array_equal(many.hit, one.hit)
    # Their shadow maps are coarser, so edges of shadows differ.
    assert np.quantile(np.abs(many.direct - one.direct).max(-1) / one.direct.max(), 0.97) < 0.01


def test_a_scene_a_million_metres_from_zero_looks_the_same(tmp_path: Path) -> None:
    glb, _ = examples.cornell()
    near = scene_of(tmp_path, glb)
    away = np.array([1e6, -2e6, 3e6])
    far = Scene(**{**vars(near), "origin": near.origin + away, "bounds": near.bounds + away})
    sun = spec_of([{"kind": "directional", "direction": [-0.3, -0.5, -0.7], "irradiance": [1, 1, 1]}])
    volume = synthetic.volume("room", (-0.95, 0.05, -0.95), (0.95, 0.95, 0.95), (3, 3, 3))
    moved = VolumeData(**{**vars(volume), "origin": volume.origin + away})
    here = raster(near, sun, eye((0, 1, 0.9), (0, 0.9, -1)), volume)
    there = raster(far, sun, Camera("far", looking(away + [0, 1, 0.9], away + [0, 0.9, -1]), 0.9), moved)
    assert here.indirect.mean() > 0.05
    np.testing.assert_allclose(there.whole, here.whole, atol=2e-4 * here.whole.max())


def test_a_scene_without_geometry_is_its_environment(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, GlbWriter())
    picture = raster(scene, spec_of(environment=(1, 2, 3)), eye((0, 0, 0), (0, 0, -1)), constant_volume((1, 1, 1)))
    np.testing.assert_array_equal(picture.whole, np.broadcast_to(np.array([1, 2, 3], np.float32), picture.whole.shape))
    assert not picture.hit.any()


def test_the_same_picture_every_time(tmp_path: Path) -> None:
    glb, _ = examples.cornell()
    scene, spec = scene_of(tmp_path, glb), spec_of([{"kind": "point", "position": [0, 1.5, 0], "intensity": [1, 1, 1]}])
    volume = synthetic.volume("room", (-0.95, 0.05, -0.95), (0.95, 0.95, 0.95), (3, 3, 3))
    first, second = (raster(scene, spec, eye((0, 1, 0.9), (0, 0.9, -1)), volume, 48, 27) for _ in range(2))
    for part in ("direct", "indirect", "emission", "hit"):
        np.testing.assert_array_equal(getattr(first, part), getattr(second, part))
