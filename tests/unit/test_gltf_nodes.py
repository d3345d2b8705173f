"""The node hierarchy: transforms, the scene that is chosen, depth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core.errors import SceneError
from tests.unit.gltf_build import TRIANGLE, Raw, world_triangles


def quaternion(axis: list[float], angle: float) -> list[float]:
    return [*(np.array(axis) * math.sin(angle / 2)), math.cos(angle / 2)]


def rotation(axis: list[float], angle: float) -> np.ndarray:
    """Rodrigues' formula, independent of quaternions."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: np.ndarray = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
    return turned


def test_hierarchy_composes(tmp_path: Path) -> None:
    """World = parent · translation · rotation · scale, with a matrix among them."""
    axis = [2 / 3, -1 / 3, 2 / 3]
    shear = np.array([[1, 0.5, 0, 3], [0, 1, 0, -1], [0.25, 0, 2, 0.5], [0, 0, 0, 1]])
    raw = Raw()
    nodes = [
        {"children": [1], "translation": [1, 2, 3], "rotation": quaternion(axis, 0.7), "scale": [2, 0.5, -1]},
        {"children": [2], "matrix": shear.T.reshape(16).tolist()},
        {"mesh": 0, "name": "leaf", "rotation": quaternion([0, 1, 0], -1.1)},
    ]
    meshes = [{"primitives": [{"attributes": {"POSITION": raw.accessor(TRIANGLE)}}]}]
    scene = raw.load(tmp_path, meshes=meshes, nodes=nodes, scenes=[{"nodes": [0]}])
    top, leaf = np.eye(4), np.eye(4)
    top[:3, :3] = rotation(axis, 0.7) * [2, 0.5, -1]
    top[:3, 3] = [1, 2, 3]
    leaf[:3, :3] = rotation([0, 1, 0], -1.1)
    expected = top @ shear @ leaf
    assert [n.name for n in scene.nodes] == ["", "", "leaf"]
    np.testing.assert_allclose(scene.nodes[2].matrix, expected, atol=1e-14)
    corners = np.array(TRIANGLE) @ expected[:3, :3].T + expected[:3, 3]
    # det < 0: the winding is reversed.
    np.testing.assert_allclose(world_triangles(scene)[0], corners[[0, 2, 1]], atol=1e-6)


@pytest.mark.parametrize(("more", "expected"), [({}, 0), ({"scene": 1}, 1)])
def test_chosen_scene(more: dict[str, int], expected: int, tmp_path: Path) -> None:
    raw = Raw()
    parts = {"nodes": [{"name": "a"}, {"name": "b"}], "scenes": [{"nodes": [0]}, {"nodes": [1]}], **more}
    scene = raw.load(tmp_path, **parts)
    assert [n.index for n in scene.nodes] == [expected]


def test_what_is_outside_the_scene_is_not_refused(tmp_path: Path) -> None:
    """Skins, morph targets and images matter only where the scene shows them."""
    raw = Raw()
    primitive = {"attributes": {"POSITION": raw.accessor(TRIANGLE)}}
    scene = raw.load(
        tmp_path,
        nodes=[{"mesh": 0}, {"mesh": 1, "skin": 0}],
        scenes=[{"nodes": [0]}],
        skins=[{"joints": [0]}],
        meshes=[{"primitives": [primitive]}, {"primitives": [{**primitive, "targets": [{}], "material": 0}]}],
        textures=[{}],
        materials=[{"normalTexture": {"index": 0}}],
    )
    assert scene.triangle_count == 1
    assert scene.ignored == ()


def test_a_scene_without_geometry(tmp_path: Path) -> None:
    cases: tuple[dict[str, Any], ...] = ({"nodes": [], "scenes": [{}]}, {"nodes": [{"name": "empty"}]})
    for parts in cases:
        scene = Raw().load(tmp_path, **parts)
        assert scene.triangle_count == 0 and scene.mesh_first_triangle.tolist() == [0, 0]
        assert scene.bounds.tolist() == [[0, 0, 0], [0, 0, 0]] and scene.origin.tolist() == [0, 0, 0]
        assert scene.positions.shape == scene.normals.shape == scene.indices.shape == (0, 3)
        assert scene.instance_transform.shape == (0, 3, 4)


def test_100_000_deep(tmp_path: Path) -> None:
    n = 100_000
    raw = Raw()
    nodes = [{"children": [i + 1], "translation": [1, 0, 0]} for i in range(n - 1)] + [{"mesh": 0}]
    meshes = [{"primitives": [{"attributes": {"POSITION": raw.accessor(TRIANGLE)}}]}]
    scene = raw.load(tmp_path, nodes=nodes, meshes=meshes, scenes=[{"nodes": [0]}])
    assert scene.bounds[0].tolist() == [n - 1, 0, 0]


def test_a_cycle_100_000_long(tmp_path: Path) -> None:
    n = 100_000
    nodes = [{"children": [(i + 1) % n]} for i in range(n)]
    with pytest.raises(SceneError) as caught:
        Raw().load(tmp_path, nodes=nodes, scenes=[{}])
    assert caught.value.slug == "gltf.node_cycle"
