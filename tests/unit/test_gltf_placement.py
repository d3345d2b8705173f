"""Meshes in the world: fronts under mirroring, instances, flattened meshes, scenes far from zero, exact bounds."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core.gltf.writer import GlbWriter, Part
from tests.unit.gltf_build import TRIANGLE, face_normals, load_glb, world_triangles

SMOOTH = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, -0.6, 0.8]])
MIRRORS: list[dict[str, Any]] = [
    {"scale": (1, 1, 1)},
    {"scale": (-1, 1, 1)},
    {"scale": (2, -3, 0.5)},
    {"scale": (-1, -1, -4)},
    {"scale": (-2, -1, 1)},
    {"matrix": [[1, 0.5, 0.2, 3], [0, -2, 0.7, 1], [0.3, 0, 1, 2], [0, 0, 0, 1]]},
]


def tetrahedron() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles that face outwards."""
    return np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.mark.parametrize("uses", [1, 2], ids=["baked", "instanced"])
@pytest.mark.parametrize("transform", MIRRORS, ids=str)
def test_fronts_follow_the_inverse_transpose(transform: dict[str, Any], uses: int, tmp_path: Path) -> None:
    points, faces = tetrahedron()
    w = GlbWriter()
    mesh = w.mesh("m", [Part(points, faces)])
    for _ in range(uses):
        node = w.node(mesh=mesh, **transform)
    scene = load_glb(w.to_glb(), tmp_path)
    matrix = scene.nodes[node].matrix
    assert len(scene.instance_mesh) == (0 if uses == 1 else uses)
    triangles = world_triangles(scene)[-4:]
    expected = face_normals(points[faces]) @ np.linalg.inv(matrix[:3, :3])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(face_normals(triangles), expected, atol=1e-5)
    # And outwards it is: away from the middle, whatever the mirror.
    middle = triangles.reshape(-1, 3).mean(axis=0)
    assert (np.einsum("ij,ij->i", face_normals(triangles), triangles.mean(axis=1) - middle) > 0).all()


@pytest.mark.parametrize("transform", MIRRORS, ids=str)
def test_vertex_normals_follow_the_inverse_transpose(transform: dict[str, Any], tmp_path: Path) -> None:
    w = GlbWriter()
    w.node(mesh=w.mesh("m", [Part(TRIANGLE, normals=SMOOTH)]), **transform)
    scene = load_glb(w.to_glb(), tmp_path)
    expected = SMOOTH @ np.linalg.inv(scene.nodes[0].matrix[:3, :3])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(scene.normals, expected, atol=1e-6)
    face = face_normals(world_triangles(scene))[0]
    assert (scene.normals @ face > 0).all()


def test_prototypes_and_the_static_world(tmp_path: Path) -> None:
    """Two meshes used twice, one used once, one never."""
    points, faces = tetrahedron()
    w = GlbWriter()
    a, once, b = (w.mesh(name, [Part(points + i, faces)]) for i, name in enumerate("abc"))
    w.mesh("never", [Part(points, faces)])
    for mesh, x in ((b, 0), (a, 10), (once, 20), (a, 30), (b, 40)):
        w.node(mesh=mesh, translation=(x, 0, 0), scale=(1, 1, 2))
    scene = load_glb(w.to_glb(), tmp_path)
    assert scene.mesh_first_triangle.tolist() == [0, 4, 8, 12]
    assert scene.instance_mesh.tolist() == [2, 1, 1, 2]
    assert scene.triangle_count == 20 and len(scene.positions) == 12
    found = {tuple(np.round(t.min(axis=(0, 1)), 5).tolist()) for t in world_triangles(scene).reshape(5, 4, 3, 3)}
    assert found == {(20 + 1, 1, 2), (2, 2, 4), (10, 0, 0), (30, 0, 0), (42, 2, 4)}
    assert scene.bounds.tolist() == [[2, 0, 0], [43, 3, 6]]
    assert scene.origin.tolist() == scene.bounds.mean(axis=0).tolist()


@pytest.mark.parametrize("scale", [(1, 0, 1), (0, 0, 3), (0, 0, 0)], ids=str)
def test_flattened_meshes_are_baked(scale: tuple[float, ...], tmp_path: Path) -> None:
    """A scale of 0 below two turns: nothing is exactly singular any more, and still nothing is NaN."""
    points, faces = tetrahedron()
    w = GlbWriter()
    mesh = w.mesh("m", [Part(points, faces, normals=[[0.6, 0, 0.8]] * 4)])
    turn = (0.48, 0.36, 0.0, 0.8)
    inner = [w.node(mesh=mesh, rotation=turn) for _ in range(2)]
    w.node(scale=scale, children=[w.node(children=inner, rotation=turn)])
    w.node(mesh=mesh)
    scene = load_glb(w.to_glb(), tmp_path)
    assert scene.mesh_first_triangle[1] == 8 and len(scene.instance_mesh) == 1
    assert np.isfinite(scene.positions).all() and np.isfinite(scene.normals).all() and np.isfinite(scene.instance_transform).all()
    flat = scene.positions[np.unique(scene.indices[:8])] + scene.origin
    assert np.ptp(flat[:, np.array(scale) == 0], axis=0).max() < 1e-6
    assert (scene.normals[np.unique(scene.indices[:8])] == 0).all()


@pytest.mark.parametrize("uses", [1, 2])
def test_a_million_metres_away(uses: int, tmp_path: Path) -> None:
    """float32 has steps of 6 cm at 1e6 m; the local frame keeps them below a micrometre."""
    points = np.random.default_rng(1).random((300, 3)).astype(np.float32)
    w = GlbWriter()
    mesh = w.mesh("m", [Part(points)])
    light = w.light("point")
    for i in range(uses):
        w.node(mesh=mesh, translation=(1e6 + 0.001 * i, -2e6, 3e6), rotation=(0, 0.6, 0, 0.8))
    w.node(light=light, translation=(1e6 + 0.25, -2e6, 3e6))
    scene = load_glb(w.to_glb(), tmp_path)
    matrix = scene.nodes[uses - 1].matrix
    expected = points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    last = world_triangles(scene)[-100:].reshape(-1, 3)
    assert np.abs(last - expected).max() < 1e-6
    assert np.abs(scene.positions).max() < 2 and np.abs(scene.instance_transform).max(initial=0) < 2
    np.testing.assert_allclose(scene.lights.position[0] + scene.origin, [1e6 + 0.25, -2e6, 3e6], atol=1e-6)


def test_a_prototype_far_from_its_own_zero(tmp_path: Path) -> None:
    """The node takes back what the vertices hold: both are large, the difference is small."""
    points = np.float32(4e6) + np.random.default_rng(2).integers(0, 16, (30, 3)).astype(np.float32)
    w = GlbWriter()
    mesh = w.mesh("m", [Part(points)])
    for x in (0, 20):
        w.node(mesh=mesh, translation=(x - 4e6, -4e6, -4e6), scale=(1, 1, 1))
    scene = load_glb(w.to_glb(), tmp_path)
    assert np.abs(scene.positions).max() <= 8 and np.abs(scene.instance_transform).max() < 40
    np.testing.assert_array_equal(world_triangles(scene)[:10].reshape(-1, 3), points.astype(np.float64) - 4e6)


@pytest.mark.parametrize("turned", [False, True])
def test_bounds_are_those_of_every_instance(turned: bool, tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    points = draw.normal(size=(60, 3))
    w = GlbWriter()
    mesh = w.mesh("m", [Part(points)])
    for i in range(400):
        rotation = draw.normal(size=4)
        rotation /= np.linalg.norm(rotation)
        at = (i % 20, (i * 7) % 13, i // 20)
        if turned:
            w.node(mesh=mesh, translation=at, rotation=rotation.tolist(), scale=draw.uniform(-1, 1, 3).tolist())
        else:
            w.node(mesh=mesh, translation=at)
    scene = load_glb(w.to_glb(), tmp_path)
    everything = world_triangles(scene).reshape(-1, 3)
    np.testing.assert_allclose(scene.bounds, [everything.min(axis=0), everything.max(axis=0)], atol=1e-5)


def test_100_000_instances_load_in_seconds(tmp_path: Path) -> None:
    points = np.random.default_rng(7).normal(size=(300, 3))
    w = GlbWriter()
    mesh = w.mesh("m", [Part(points)])
    for i in range(100_000):
        w.node(mesh=mesh, translation=(i % 317, 0, i // 317), scale=(1, 1, -1))
    data = w.to_glb()
    began = time.perf_counter()
    scene = load_glb(data, tmp_path)
    # About 1 s on an idle core; the machine may be busy.
    assert time.perf_counter() - began < 10
    assert scene.triangle_count == 10_000_000 and len(scene.positions) == 300
    size = np.float32(points).max(axis=0) - np.float32(points).min(axis=0)
    np.testing.assert_allclose(np.ptp(scene.bounds, axis=0), size + [316, 0, 99_999 // 317], rtol=1e-6)


def test_local_frame_of_a_plain_scene_is_exact(tmp_path: Path) -> None:
    """Coordinates of a few bits stay exactly what they are."""
    points, faces = tetrahedron()
    w = GlbWriter()
    w.node(mesh=w.mesh("m", [Part(points, faces)]), translation=(0.5, 0.25, -3))
    scene = load_glb(w.to_glb(), tmp_path)
    np.testing.assert_array_equal(world_triangles(scene), (points + [0.5, 0.25, -3])[faces])
