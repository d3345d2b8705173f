"""The scenes beside this checkout against trimesh and against a direct parse that shares no code with the reader."""

from __future__ import annotations

import json
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from bake_core.gltf.reader import load_scene
from bake_core.scene import ALPHA_MASK, ALPHA_OPAQUE, NO_TEXTURE
from tests.unit.gltf_build import face_normals, world_triangles

TRIANGLES = {
    "rtxgi_furnace": 12,
    "rtxgi_cornell": 34,
    "rtxgi_two_rooms": 90,
    "bevy_irradiance_volume": 32,
    "godot_zdm2": 58_772,
    "atrium": 289_368,
    "playcanvas_house": 10_497,
}


def parse(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def _features(triangles: np.ndarray) -> np.ndarray:
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.concatenate([triangles.mean(axis=1), area], axis=1)


@pytest.mark.parametrize("name", TRIANGLES)
def test_triangles_and_bounds_agree_with_trimesh(name: str, shared: Path) -> None:
    path = shared / "scenes" / f"{name}.glb"
    began = time.perf_counter()
    scene = load_scene(path)
    seconds = time.perf_counter() - began
    assert scene.triangle_count == TRIANGLES[name]
    # A tenth of this on an idle core; the machine may be busy.
    assert seconds < 2
    peer = trimesh.load_scene(path, process=False).to_mesh()
    assert len(peer.faces) == scene.triangle_count
    np.testing.assert_allclose(scene.bounds, peer.bounds, rtol=1e-6, atol=1e-5)
    ours = world_triangles(scene)
    # Neither order nor first corners need to agree. Centre and area vector of a triangle know no first corner, but know the winding;
    # along any direction, the sorted projections of all of them agree if the triangles do.
    size = float(np.ptp(scene.bounds, axis=0).max())
    for direction in np.random.default_rng(6).normal(size=(8, 6)):
        a, b = (np.sort(_features(t / size) @ direction) for t in (ours, np.array(peer.triangles)))
        np.testing.assert_allclose(a, b, atol=3e-6)


@pytest.mark.parametrize("name", ["rtxgi_cornell", "rtxgi_two_rooms", "atrium"])
def test_vertices_agree_with_a_direct_parse(name: str, shared: Path) -> None:
    """All nodes of these are one mesh with at most a quarter turn about x, and their primitives are plain indexed triangles."""
    path = shared / "scenes" / f"{name}.glb"
    gltf, binary = parse(path)
    kinds = {5123: "<u2", 5125: "<u4", 5126: "<f4"}

    def read(index: int) -> np.ndarray:
        a = gltf["accessors"][index]
        width = {"SCALAR": 1, "VEC3": 3}[a["type"]]
        offset = gltf["bufferViews"][a["bufferView"]].get("byteOffset", 0)
        return np.frombuffer(binary, kinds[a["componentType"]], a["count"] * width, offset).reshape(-1, width)

    corners = np.concatenate([read(p["attributes"]["POSITION"])[read(p["indices"])[:, 0]] for p in gltf["meshes"][0]["primitives"]]).astype(
        np.float64
    )
    if "rotation" in gltf["nodes"][0]:
        corners = corners @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    scene = load_scene(path)
    np.testing.assert_allclose(world_triangles(scene).reshape(-1, 3), corners, rtol=1e-6, atol=2e-6 * np.abs(corners).max())
    if name == "atrium":
        colors = read(gltf["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
        np.testing.assert_allclose(scene.colors[:, :3], np.clip(colors, 0, 1))
        assert (scene.colors[:, 3] == 1).all()


def test_cornell_walls_face_inwards(shared: Path) -> None:
    scene = load_scene(shared / "scenes" / "rtxgi_cornell.glb")
    t = world_triangles(scene)
    normals, middle = face_normals(t), t.mean(axis=1)
    for axis, side in ((0, -1), (0, 1), (2, -1)):
        wall = np.abs(middle[:, axis] - side) < 1e-3
        # Each wall is a thin slab: the side at the room's inside faces the room.
        assert wall.any() and (normals[wall][:, axis] * side < 0).any()


def test_textured_house_is_cut_out_and_textured(shared: Path) -> None:
    scene = load_scene(shared / "scenes" / "playcanvas_house.glb")
    m = scene.materials
    assert m.name == ("White", "WhiteAlpha")
    assert m.alpha_mode.tolist() == [ALPHA_OPAQUE, ALPHA_MASK] and m.alpha_cutoff[1] == 0.5
    assert m.base_color_texture.tolist() == [NO_TEXTURE, 0] and m.lambert.all()
    # Only the first of its two sets of texture coordinates is looked at.
    assert scene.uvs.shape == (len(scene.positions), 2)
    (image,) = scene.images
    alpha = image.pixels[..., 3]
    assert 0 < (alpha >= 128).mean() < 1


def test_bevy_volume_node(shared: Path) -> None:
    scene = load_scene(shared / "scenes" / "bevy_irradiance_volume.glb")
    node = next(n for n in scene.nodes if n.name == "IrradianceVolume")
    np.testing.assert_allclose(np.diag(node.matrix), [-20.5176, 1.4820, -21.6250, 1], atol=1e-4)
    np.testing.assert_allclose(scene.materials.roughness, 0.5)
    assert scene.materials.double_sided.all()
