"""Primitives to triangles: modes, normals, shared vertices, materials."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bake_core.gltf.writer import GlbWriter, Part
from tests.unit.gltf_build import TRIANGLE, UBYTE, Raw, face_normals, load_glb, world_triangles

# A zigzag and a fan in the plane z = 0 whose triangles all face +z when read as glTF 2.0, 3.7.2.1 says.
ZIGZAG = np.array([[0, 0, 0], [1, 0, 0], [0.2, 1, 0], [1.2, 1, 0], [0.4, 2, 0], [1.4, 2, 0]], np.float32)
FAN = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 1, 0]], np.float32)


@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize(
    ("mode", "points", "expected"),
    [
        (4, ZIGZAG[[0, 1, 2, 2, 1, 3]], [(0, 1, 2), (3, 4, 5)]),
        (5, ZIGZAG, [(0, 1, 2), (1, 3, 2), (2, 3, 4), (3, 5, 4)]),
        (6, FAN, [(1, 2, 0), (2, 3, 0), (3, 4, 0)]),
    ],
    ids=["triangles", "strip", "fan"],
)
def test_modes(mode: int, points: np.ndarray, expected: list[tuple[int, int, int]], indexed: bool, tmp_path: Path) -> None:
    raw = Raw()
    n = len(points)
    # Indexed: the same order through a reversed vertex list.
    stored = points[::-1] if indexed else points
    primitive = {"attributes": {"POSITION": raw.accessor(stored)}, "mode": mode}
    if indexed:
        primitive["indices"] = raw.accessor(np.arange(n)[::-1], UBYTE)
    scene = raw.load(tmp_path, meshes=[{"primitives": [primitive]}])
    np.testing.assert_allclose(world_triangles(scene), points[np.array(expected)], atol=1e-6)
    np.testing.assert_allclose(face_normals(world_triangles(scene)), [[0, 0, 1]] * len(expected), atol=1e-6)


def test_degenerate_triangles_of_a_strip_stay(tmp_path: Path) -> None:
    raw = Raw()
    order = raw.accessor([0, 1, 2, 2, 3, 3, 4, 5], UBYTE)
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": {"POSITION": raw.accessor(ZIGZAG)}, "indices": order, "mode": 5}]}])
    assert scene.triangle_count == 6


@pytest.mark.parametrize("mode", [0, 1, 2, 3])
def test_points_and_lines_are_listed_as_ignored(mode: int, tmp_path: Path) -> None:
    raw = Raw()
    primitives = [{"attributes": {"POSITION": raw.accessor(TRIANGLE)}, "mode": m} for m in (mode, 4)]
    scene = raw.load(tmp_path, meshes=[{"primitives": primitives}])
    assert scene.triangle_count == 1
    assert len(scene.ignored) == 1 and "no area (at meshes[0].primitives[0])" in scene.ignored[0]
    assert raw.load(tmp_path, meshes=[{"primitives": primitives[:1]}]).triangle_count == 0


@pytest.mark.parametrize("others", [5, 50])
def test_unused_vertices_are_left_out(others: int, tmp_path: Path) -> None:
    raw = Raw()
    points = np.concatenate([np.full((5, 3), 1e6), TRIANGLE, np.full((others, 3), -1e6)])
    colors = np.concatenate([np.linspace(0, 1, 24).reshape(8, 3), np.zeros((others, 3))])
    attributes = {"POSITION": raw.accessor(points), "COLOR_0": raw.accessor(colors)}
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": attributes, "indices": raw.accessor([5, 6, 7], UBYTE)}]}])
    assert len(scene.positions) == 3
    assert scene.bounds.tolist() == [[0, 0, 0], [1, 1, 0]]
    np.testing.assert_allclose(scene.colors[:, 0], np.linspace(0, 1, 24)[15:24:3], atol=1e-7)


def test_primitives_share_vertices_and_keep_their_materials(tmp_path: Path) -> None:
    raw = Raw()
    attributes = {"POSITION": raw.accessor(ZIGZAG)}
    primitives = [
        {"attributes": attributes, "indices": raw.accessor([0, 1, 2], UBYTE), "material": 1},
        {"attributes": attributes, "indices": raw.accessor([2, 1, 3, 2, 3, 4], UBYTE), "material": 0},
        {"attributes": {"POSITION": raw.accessor(TRIANGLE)}},
    ]
    materials = [{"name": "a"}, {"name": "b"}, {"name": "never used"}]
    scene = raw.load(tmp_path, meshes=[{"primitives": primitives}], materials=materials)
    assert len(scene.positions) == 5 + 3
    assert scene.materials.name == ("a", "b", "(default)")
    assert scene.triangle_material.tolist() == [1, 0, 0, 2]
    assert (scene.materials.metallic[2], scene.materials.roughness[2]) == (1, 1)
    np.testing.assert_allclose(world_triangles(scene)[1], ZIGZAG[[2, 1, 3]], atol=1e-6)


def test_normals(tmp_path: Path) -> None:
    """Unit where given, zero where not, and none at all where they say nothing that the triangles do not."""
    w = GlbWriter()
    smooth = np.array([[0, 0, 5], [0.6, 0, 0.8], [0, 0, 0]])
    w.node(mesh=w.mesh("m", [Part(TRIANGLE, normals=smooth), Part(TRIANGLE)]))
    scene = load_glb(w.to_glb(), tmp_path)
    expected = np.zeros((6, 3))
    expected[:2] = smooth[:2] / [[5], [1]]
    np.testing.assert_allclose(scene.normals, expected, atol=1e-7)
    w = GlbWriter()
    w.node(mesh=w.mesh("m", [Part(TRIANGLE, normals=np.array([[0, 0, 2], [5e-5, 0, 1], [0, 0, 1]]))]))
    assert load_glb(w.to_glb(), tmp_path).normals.shape == (0, 3)
    # Facing the other way says something.
    w = GlbWriter()
    w.node(mesh=w.mesh("m", [Part(TRIANGLE, normals=[[0, 0, -1]] * 3)]))
    assert load_glb(w.to_glb(), tmp_path).normals.tolist() == [[0, 0, -1]] * 3


def test_other_attributes_are_listed_as_ignored(tmp_path: Path) -> None:
    raw = Raw()
    attributes = {"POSITION": raw.accessor(TRIANGLE)}
    attributes |= {"TEXCOORD_0": raw.accessor([[0, 0]] * 3), "TANGENT": raw.accessor([[1, 0, 0, 1]] * 3), "_LAYER": raw.accessor([1, 2, 3])}
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": attributes}, {"attributes": attributes}]}])
    assert scene.ignored == tuple(f"vertex attribute '{a}' (at meshes[0].primitives[0], and 1 more)" for a in ("TANGENT", "_LAYER"))
