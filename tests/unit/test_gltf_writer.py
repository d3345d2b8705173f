"""What our writer writes, our reader reads back; and the same calls give the same bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bake_core.gltf.writer import GlbWriter, Part
from tests.unit.gltf_build import load_glb, world_triangles


@pytest.mark.parametrize("vertices", [255, 256, 65_535, 65_536], ids=str)
def test_indices_take_the_smallest_type_that_is_not_restart(vertices: int, tmp_path: Path) -> None:
    points = np.random.default_rng(4).random((vertices, 3)).astype(np.float32)
    faces = np.array([[0, 1, vertices - 1], [vertices - 1, vertices - 2, 0]])
    w = GlbWriter()
    w.node(mesh=w.mesh("m", [Part(points, faces)]))
    expected = {255: 5121, 256: 5123, 65_535: 5123, 65_536: 5125}[vertices]
    assert w.document()["accessors"][1]["componentType"] == expected
    np.testing.assert_allclose(world_triangles(load_glb(w.to_glb(), tmp_path)), points[faces], atol=1e-7)


def test_round_trip_and_determinism(tmp_path: Path) -> None:
    draw = np.random.default_rng(5)
    points, normals, colors = draw.random((90, 3)), draw.normal(size=(90, 3)), draw.random((90, 4))
    faces = draw.permutation(90).reshape(30, 3)

    def write() -> bytes:
        w = GlbWriter()
        material = w.material("m", draw_color, emission=(3, 2, 1))
        w.node("n", mesh=w.mesh("mesh", [Part(points, faces, normals, colors, material)]))
        return w.to_glb()

    draw_color = (0.1, 0.2, 0.3)
    assert write() == write()
    scene = load_glb(write(), tmp_path)
    assert scene.indices.tolist() == faces.tolist()
    np.testing.assert_allclose(scene.positions + scene.origin, points, atol=1e-7)
    np.testing.assert_allclose(scene.normals, normals / np.linalg.norm(normals, axis=1, keepdims=True), atol=1e-6)
    np.testing.assert_allclose(scene.colors, colors, atol=1e-7)
    np.testing.assert_allclose(scene.materials.emission, [[3, 2, 1]], rtol=1e-6)
    assert scene.ignored == ()
