"""Our own scenes are what their docstrings say: sealed where they say so, fronts inwards, closed forms true."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bake_core import examples
from bake_core.examples import Example
from bake_core.scene import Scene
from bake_core.spec import parse_spec
from tests.unit.gltf_build import face_normals, load_glb, world_triangles

ALL: dict[str, Callable[[], Example]] = {
    "cornell": examples.cornell,
    "closed_box": lambda: examples.closed_box(0.5, 1.0, 3),
    "plane_under_sun": examples.plane_under_sun,
    "square_emitter": examples.square_emitter,
    "two_rooms": examples.two_rooms,
}


def scene_of(example: Example, folder: Path) -> Scene:
    return load_glb(example[0], folder)


def probes_of(example: Example) -> np.ndarray:
    volume = parse_spec(example[1]).volumes[0]
    assert volume.origin is not None and volume.spacing is not None and volume.counts is not None
    steps = np.stack(np.meshgrid(*(np.arange(n) for n in volume.counts), indexing="ij"), axis=-1).reshape(-1, 3)
    positions: np.ndarray = np.array(volume.origin) + steps * np.array(volume.spacing)
    return positions


@pytest.mark.parametrize("name", ALL)
def test_same_bytes_each_time_and_a_valid_spec(name: str, tmp_path: Path) -> None:
    assert ALL[name]() == ALL[name]()
    example = ALL[name]()
    parse_spec(example[1])
    scene = scene_of(example, tmp_path)
    assert scene.triangle_count > 0 and scene.ignored == ()
    assert (scene.materials.metallic == 0).all() and (scene.materials.roughness == 1).all()


def sealed_from_inside(triangles: np.ndarray) -> bool:
    """Closed, and its fronts face inwards."""
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(triangles.shape[0] * 3).reshape(-1, 3), process=False)
    mesh.merge_vertices()
    return bool(mesh.is_watertight and mesh.volume < 0)


def test_closed_box(tmp_path: Path) -> None:
    example = examples.closed_box(0.75, 2.0, 3)
    scene = scene_of(example, tmp_path)
    assert sealed_from_inside(world_triangles(scene))
    assert scene.materials.base_color.tolist() == [[0.75] * 3] and scene.materials.emission.tolist() == [[2.0] * 3]
    assert (np.abs(probes_of(example)) < 0.7).all()
    assert parse_spec(example[1]).max_bounces == 3


def test_two_rooms(tmp_path: Path) -> None:
    example = examples.two_rooms()
    scene = scene_of(example, tmp_path)
    triangles = world_triangles(scene)
    room = (scene.triangle_material != scene.materials.name.index("lamp")).nonzero()[0]
    left = triangles[room][triangles[room][:, :, 0].mean(axis=1) < 0]
    right = triangles[room][triangles[room][:, :, 0].mean(axis=1) > 0]
    assert sealed_from_inside(left) and sealed_from_inside(right)
    assert left[:, :, 0].max() == pytest.approx(-0.01) and right[:, :, 0].min() == pytest.approx(0.01)
    probes = probes_of(example)
    assert len(probes) == 96 and (np.abs(probes[:, 0]) >= 0.5).all()
    lamp = triangles[scene.triangle_material == scene.materials.name.index("lamp")]
    np.testing.assert_allclose(face_normals(lamp), [[0, -1, 0]] * 2, atol=1e-6)


def test_cornell(tmp_path: Path) -> None:
    example = examples.cornell()
    scene = scene_of(example, tmp_path)
    triangles = world_triangles(scene)
    np.testing.assert_allclose(scene.bounds, [[-1, 0, -1], [1, 2, 1]])
    normals, middle = face_normals(triangles), triangles.mean(axis=1)
    walls = triangles[: scene.mesh_first_triangle[1]]
    inwards = np.einsum("ij,ij->i", face_normals(walls), np.array([0, 1, 0]) - walls.mean(axis=1))
    assert (inwards > 0).all()
    # Both blocks: outwards, standing on the floor, clear of the walls.
    assert len(scene.instance_mesh) == 2
    for block in np.split(np.arange(len(walls), len(triangles)), 2):
        centre = triangles[block].reshape(-1, 3).mean(axis=0)
        assert (np.einsum("ij,ij->i", normals[block], middle[block] - centre) > 0).all()
        assert triangles[block][:, :, 1].min() == pytest.approx(0, abs=1e-6)
        assert np.abs(triangles[block][:, :, (0, 2)]).max() < 0.95
    assert [c.name for c in scene.cameras] == ["front", "corner"]
    for camera in scene.cameras:
        assert (np.abs(camera.matrix[:3, 3] - [0, 1, 0]) < 1).all()
    probes = probes_of(example)
    assert len(probes) == 512
    np.testing.assert_allclose([probes.min(axis=0), probes.max(axis=0)], [[-0.875, 0.125, -0.875], [0.875, 1.875, 0.875]])


def test_plane_under_sun(tmp_path: Path) -> None:
    scene = scene_of(examples.plane_under_sun(direction=(0.48, -0.8, 0.36)), tmp_path)
    np.testing.assert_allclose(scene.lights.direction, [[0.48, -0.8, 0.36]], atol=1e-7)
    np.testing.assert_allclose(face_normals(world_triangles(scene)), [[0, 1, 0]] * 2)
    # What the plane's end takes away, as the docstring says, by integration over what is missing, h = 1, in polar coordinates.
    phi = (np.arange(4096) + 0.5) / 4096 * (math.pi / 4)
    missing_below = 8 * np.mean(np.cos(phi) ** 2) * (math.pi / 4) / (2 * math.pi)
    assert missing_below == pytest.approx(0.82, abs=0.005)
    sides = np.mean(np.cos(phi) ** 2 * 2 + np.cos(phi) * np.sin(phi) * 2) * (math.pi / 4) / math.pi * 2
    assert sides == pytest.approx(1.14, abs=0.005)


@pytest.mark.parametrize("shared_mesh", [True, False])
def test_square_emitter(shared_mesh: bool, tmp_path: Path) -> None:
    """The closed form by numerical integration over what the reader read, from both sides."""
    scene = scene_of(examples.square_emitter(2.0, shared=shared_mesh), tmp_path)
    assert len(scene.instance_mesh) == (2 if shared_mesh else 0)
    s = (np.arange(64) + 0.5) / 64
    u, v = (a.reshape(-1, 1) for a in np.meshgrid(s, s))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    for receiver in (np.array([1.0, 0, 0]), np.array([-1.0, 0, 0])):
        total = 0.0
        for t, n in zip(world_triangles(scene), face_normals(world_triangles(scene)), strict=True):
            points = t[0] + u * (t[1] - t[0]) + v * (t[2] - t[0])
            distance2 = (points**2).sum(axis=1)
            towards = points / np.sqrt(distance2)[:, None]
            cosines = np.maximum(towards @ receiver, 0) * np.maximum(-towards @ n, 0)
            total += 2.0 * float(np.mean(cosines / distance2)) * 0.5
        assert total == pytest.approx(examples.square_emitter_irradiance(2.0), rel=1e-3)
    assert examples.square_emitter_irradiance() == pytest.approx(0.752275, abs=1e-6)
