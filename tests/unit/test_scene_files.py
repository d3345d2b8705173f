"""Zips and bare meshes, beside the glTF that they hold or stand for."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from bake_core.gltf.writer import GlbWriter, Part
from bake_core.scene import Scene
from bake_core.scene_files import load_scene, load_scene_files
from tests.faults.fault import sound
from tests.faults.other_files import make_zip
from tests.pictures import png
from tests.unit.gltf_build import TRIANGLE, Raw, world_triangles

PICTURE = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)


def folder_scene() -> dict[str, bytes]:
    """A .gltf with a buffer and a textured material in files below it, and a file that nothing uses."""
    w = GlbWriter()
    w.node(mesh=w.mesh("m", [Part(TRIANGLE, material=w.material("m", base_color_texture=w.texture(b"")), uvs=[[[0, 0], [1, 0], [0, 1]]])]))
    document = w.document()
    document["buffers"][0]["uri"] = "data/scene.bin"
    document["images"] = [{"uri": "data/my%20picture.png"}]
    document["bufferViews"].pop(0)
    for accessor in document["accessors"]:
        accessor["bufferView"] -= 1
    files = {"scene.gltf": json.dumps(document).encode(), "data/scene.bin": bytes(w._binary), "data/my picture.png": png(PICTURE)}
    return files | {"data/unused.png": b"nobody looks"}


def write(files: dict[str, bytes], folder: Path) -> Path:
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return folder / "scene.gltf"


def same(a: Scene, b: Scene) -> None:
    assert a.digest == b.digest
    np.testing.assert_array_equal(world_triangles(a), world_triangles(b))
    np.testing.assert_array_equal(a.uvs, b.uvs)
    for x, y in zip(a.images, b.images, strict=True):
        np.testing.assert_array_equal(x.pixels, y.pixels)


def test_a_zip_of_a_folder_is_that_folder(tmp_path: Path) -> None:
    files = folder_scene()
    scene = load_scene(write(files, tmp_path / "folder"))
    np.testing.assert_array_equal(scene.images[0].pixels[..., :3], PICTURE)
    assert (scene.images[0].pixels[..., 3] == 255).all()
    for prefix in ("", "my scene/"):
        path = tmp_path / "scene.zip"
        extra = {"__MACOSX/._scene.gltf": b"a Mac was here", f"{prefix}data/": b""}
        path.write_bytes(make_zip({prefix + name: data for name, data in files.items()} | extra))
        same(load_scene(path), scene)
        # An upload has no file names of its own to go by.
        blob = tmp_path / "blob"
        blob.write_bytes(path.read_bytes())
        same(load_scene_files("scene.zip", {"scene.zip": blob}), scene)


def test_the_digest_counts_what_is_used(tmp_path: Path) -> None:
    files = folder_scene()
    digest = load_scene(write(files, tmp_path / "a")).digest
    assert load_scene(write(files | {"data/unused.png": b"other"}, tmp_path / "b")).digest == digest
    assert load_scene(write(files | {"data/my picture.png": png(PICTURE + 1)}, tmp_path / "c")).digest != digest


def test_an_image_is_the_same_from_a_file_a_view_and_a_data_uri(tmp_path: Path) -> None:
    files = folder_scene()
    from_file = load_scene(write(files, tmp_path / "a")).images[0].pixels
    document = json.loads(files["scene.gltf"])
    document["images"] = [{"uri": "data:image/png;base64," + base64.b64encode(png(PICTURE)).decode()}]
    from_data = load_scene(write(files | {"scene.gltf": json.dumps(document).encode()}, tmp_path / "b")).images[0].pixels
    w = GlbWriter()
    material = w.material("m", base_color_texture=w.texture(png(PICTURE)))
    w.node(mesh=w.mesh("m", [Part(TRIANGLE, material=material, uvs=[np.zeros((3, 2))])]))
    (tmp_path / "c.glb").write_bytes(w.to_glb())
    for pixels in (from_data, load_scene(tmp_path / "c.glb").images[0].pixels):
        np.testing.assert_array_equal(pixels, from_file)


@pytest.mark.parametrize("kind", ["obj", "ply", "stl"])
def test_meshes_come_in_neutral(kind: str, tmp_path: Path) -> None:
    box = trimesh.creation.icosphere(1)
    box.apply_translation([1e6, 2, 3])
    path = tmp_path / f"mesh.{kind.upper()}"
    data: Any = box.export(file_type=kind)
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    scene = load_scene(path)
    m = scene.materials
    assert m.base_color.tolist() == [[0.5] * 3] and m.lambert.all() and m.double_sided.all()
    assert scene.triangle_count == len(box.faces) and len(scene.ignored) == 1
    # STL holds float32, of which a quarter is left at 1,000 km.
    np.testing.assert_allclose(scene.bounds, box.bounds, atol=0.05 if kind != "obj" else 1e-4)
    assert np.abs(scene.positions).max() < 1.1
    np.testing.assert_array_equal(load_scene_files(path.name, {path.name: path}).positions, scene.positions)


def test_an_obj_of_relative_indices_polygons_and_any_encoding(tmp_path: Path) -> None:
    """Indices count back from where they stand, not from the file's end; lines go on after a backslash; comments are of any encoding."""
    path = tmp_path / "a.obj"
    path.write_bytes(
        b"# caf\xe9\nmtllib no.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf -3/1/1 -2/2/2 -1\no \xff\n"
        b"v 5 5 5 1 0 0\r\nv 6 5 5\nv 6 6 5\nv 5 6 5\nusemtl x\nf -4 -3 \\\n-2//1 -1 # all\n"
    )
    found = world_triangles(load_scene(path))
    expected = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[5, 5, 5], [6, 5, 5], [6, 6, 5]], [[5, 5, 5], [6, 6, 5], [5, 6, 5]]]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_an_obj_opens_no_other_file(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("mtllib ../secret.mtl\nusemtl x\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert load_scene(path).triangle_count == 2


@pytest.mark.parametrize(
    ("component", "normalized", "scale"), [(5120, True, 127), (5122, True, 32767), (5121, True, 255), (5123, True, 65535), (5122, False, 1)]
)
def test_quantized_vertices(component: int, normalized: bool, scale: int, tmp_path: Path) -> None:
    """KHR_mesh_quantization's positions, dequantised by their node as exporters do."""
    raw = Raw()
    whole = np.array(TRIANGLE) * 100
    position = raw.accessor(whole, component, normalized=normalized)
    nodes = [{"mesh": 0, "scale": [scale / 100] * 3}]
    mesh = {"primitives": [{"attributes": {"POSITION": position}}]}
    needed = ["KHR_mesh_quantization"]
    scene = raw.load(tmp_path, nodes=nodes, meshes=[mesh], extensionsUsed=needed, extensionsRequired=needed)
    np.testing.assert_allclose(world_triangles(scene)[0], TRIANGLE, atol=1e-6)


def test_the_lowest_signed_value_is_minus_one(tmp_path: Path) -> None:
    raw = Raw()
    position = raw.accessor([[-128, 0, 0], [127, 0, 0], [0, -127, 0]], 5120, normalized=True)
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": {"POSITION": position}}]}], extensionsUsed=["KHR_mesh_quantization"])
    np.testing.assert_array_equal(scene.bounds, [[-1, -1, 0], [1, 0, 0]])


def test_the_sound_scene_of_the_corpus_survives_a_zip(tmp_path: Path) -> None:
    document, binary = sound()
    document["buffers"][0]["uri"] = "scene.bin"
    (tmp_path / "a.zip").write_bytes(make_zip({"scene.gltf": json.dumps(document).encode(), "scene.bin": binary}))
    assert load_scene(tmp_path / "a.zip").triangle_count == 4
