"""Materials, lights and cameras."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bake_core.gltf.writer import GlbWriter, Part, look_at
from bake_core.scene import LIGHT_DIRECTIONAL, LIGHT_POINT, LIGHT_SPOT
from tests.unit.gltf_build import TRIANGLE, Raw, load_glb


def test_materials(tmp_path: Path) -> None:
    w = GlbWriter()
    rows = [
        w.material("grey", (0.25, 0.5, 0.75)),
        w.material("lamp", emission=(1e6, 0.5e6, 0)),
        w.material("glow", emission=(0.5, 0.25, 0), double_sided=True),
        w.material("metal", metallic=0.75, roughness=0.125),
    ]
    w.material("never used")
    w.node(mesh=w.mesh("m", [Part(TRIANGLE, material=i) for i in reversed(rows)]))
    scene = load_glb(w.to_glb(), tmp_path)
    m = scene.materials
    assert m.name == ("grey", "lamp", "glow", "metal")
    assert scene.triangle_material.tolist() == [3, 2, 1, 0]
    assert m.base_color.tolist() == [[0.25, 0.5, 0.75], [1, 1, 1], [1, 1, 1], [1, 1, 1]]
    assert m.emission.tolist() == [[0, 0, 0], [1e6, 0.5e6, 0], [0.5, 0.25, 0], [0, 0, 0]]
    assert m.metallic.tolist() == [0, 0, 0, 0.75] and m.roughness.tolist() == [1, 1, 1, 0.125]
    assert m.double_sided.tolist() == [False, False, True, False]
    assert [a.dtype for a in (m.base_color, m.metallic, m.roughness, m.emission, m.double_sided)] == [np.float32] * 4 + [np.bool_]


def test_default_materials_and_occlusion(tmp_path: Path) -> None:
    raw = Raw()
    position = raw.accessor(TRIANGLE)
    primitives = [{"attributes": {"POSITION": position}, "material": 0}, {"attributes": {"POSITION": position}}]
    materials = [{"occlusionTexture": {"index": 0}, "normalTexture": {"index": 0, "scale": 2}}]
    scene = raw.load(tmp_path, meshes=[{"primitives": primitives}], materials=materials, textures=[{}])
    assert scene.materials.name == ("materials[0]", "(default)")
    assert scene.materials.metallic.tolist() == scene.materials.roughness.tolist() == [1, 1]
    assert [line.partition(" ")[0] for line in scene.ignored] == ["normalTexture", "occlusionTexture"]
    assert not scene.images and not scene.textures


def test_lights(tmp_path: Path) -> None:
    w = GlbWriter()
    sun = w.light("directional", (1, 0.5, 0.25), 4)
    bulb = w.light("point", (1, 1, 1), 3, range=7)
    cone = w.light("spot", (0, 1, 0), 2, inner=0.25, outer=1.0)
    plain = w.light("spot")
    w.light("point")
    spot = look_at((1, 2, 3), (1, 5, 7))
    spot[:3, :3] *= [2, 3, 0.5]
    w.node(light=bulb, translation=(1, 2, 3), scale=(0, 0, 0))
    # Mirrored along z: what looked at -z now looks at +z.
    w.node(light=sun, scale=(1, 1, -2), translation=(5, 5, 5))
    w.node(light=cone, matrix=spot)
    w.node(light=plain)
    scene = load_glb(w.to_glb(), tmp_path)
    lights = scene.lights
    assert lights.kind.tolist() == [LIGHT_POINT, LIGHT_DIRECTIONAL, LIGHT_SPOT, LIGHT_SPOT]
    np.testing.assert_allclose(lights.position, [[1, 2, 3], [0, 0, 0], [1, 2, 3], [0, 0, 0]])
    np.testing.assert_allclose(lights.direction, np.array([[0, 0, 0], [0, 0, 1], [0, 0.6, 0.8], [0, 0, -1]]), atol=1e-7)
    np.testing.assert_allclose(lights.value, [[3, 3, 3], [4, 2, 1], [0, 2, 0], [1, 1, 1]])
    np.testing.assert_allclose(lights.cos_inner, [1, 1, math.cos(0.25), 1], rtol=1e-6)
    np.testing.assert_allclose(lights.cos_outer, [-1, -1, math.cos(1), math.cos(math.pi / 4)], rtol=1e-6)
    assert lights.range.tolist() == [7, math.inf, math.inf, math.inf]
    assert scene.ignored == ("a light that no node carries (at extensions.KHR_lights_punctual.lights)",)


def test_no_lights(tmp_path: Path) -> None:
    lights = Raw().load(tmp_path, nodes=[{}]).lights
    assert lights.kind.shape == lights.range.shape == (0,) and lights.value.shape == lights.position.shape == lights.direction.shape == (
        0,
        3,
    )


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 3, 4), (1e-9, 1e9, 1)], ids=str)
def test_cameras_look_along_minus_z(scale: tuple[float, float, float], tmp_path: Path) -> None:
    w = GlbWriter()
    lens = w.camera(0.75)
    expected = look_at((1, 2, 3), (4, -2, 3))
    node = expected.copy()
    node[:3, :3] *= scale
    w.node("eye", camera=lens, matrix=node)
    w.node(camera=lens)
    cameras = load_glb(w.to_glb(), tmp_path).cameras
    assert [(c.name, c.yfov) for c in cameras] == [("eye", 0.75), ("camera1", 0.75)]
    np.testing.assert_allclose(cameras[0].matrix, expected, atol=1e-7)
    np.testing.assert_allclose(cameras[0].matrix[:3, 2], [-0.6, 0.8, 0], atol=1e-7)
    np.testing.assert_array_equal(cameras[1].matrix, np.eye(4))


def test_look_at_straight_down() -> None:
    matrix = look_at((0, 5, 0), (0, 0, 0))
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(-matrix[:3, 2], [0, -1, 0])
    assert np.linalg.det(matrix) == pytest.approx(1)
