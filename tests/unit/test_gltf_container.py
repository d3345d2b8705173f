"""Files: .gltf with files beside it, data: URIs, uploads, digests, links."""

from __future__ import annotations

import base64
import hashlib
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from bake_core.errors import SceneError
from bake_core.gltf.reader import load_scene, load_scene_files
from bake_core.gltf.writer import pack_glb
from bake_core.scene import Scene
from tests.faults.fault import changed, sound


def sha256(data: bytes) -> str:
    return "sha256:" + hashlib.sha256(data).hexdigest()


def gltf_with(uri: str) -> tuple[bytes, bytes]:
    document, binary = sound()
    document["buffers"][0]["uri"] = uri
    return json.dumps(document).encode(), binary


def same(a: Scene, b: Scene) -> bool:
    return all(np.array_equal(getattr(a, k), getattr(b, k)) for k in ("positions", "indices", "normals", "colors", "instance_transform"))


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        ("scene.bin", "scene.bin"),
        ("./scene.bin", "scene.bin"),
        ("parts/mesh.bin", "parts/mesh.bin"),
        ("parts%2Fmesh.bin", "parts/mesh.bin"),
        ("with%20space%25.bin", "with space%.bin"),
        ("with space.bin", "with space.bin"),
        ("B%C3%BCrste.bin", "Bürste.bin"),
        ("a#b?c.bin", "a#b?c.bin"),
        ("..dots..", "..dots.."),
    ],
)
def test_files_beside_the_scene(uri: str, name: str, tmp_path: Path) -> None:
    text, binary = gltf_with(uri)
    scene_path, bin_path = tmp_path / "room.gltf", tmp_path / name
    bin_path.parent.mkdir(exist_ok=True)
    scene_path.write_bytes(text)
    bin_path.write_bytes(binary)
    scene = load_scene(scene_path)
    (tmp_path / "twin.glb").write_bytes(changed())
    assert same(scene, load_scene(tmp_path / "twin.glb"))
    document = f'{{"files":{{{json.dumps(name)}:"{sha256(binary)}","room.gltf":"{sha256(text)}"}},"root":"room.gltf"}}'
    if name < "room.gltf":
        assert scene.digest == sha256(document.encode())
    # An upload of the same files, whatever they are called on this machine, and in a folder of its own, is the same scene.
    for folder in ("", "up/load/"):
        uploaded = load_scene_files(
            f"{folder}room.gltf", {f"{folder}room.gltf": scene_path, f"{folder}{name}": bin_path, "other": scene_path}
        )
        assert uploaded.digest == scene.digest and same(uploaded, scene)


def test_one_file_has_its_own_digest(tmp_path: Path) -> None:
    glb = changed()
    (tmp_path / "a.glb").write_bytes(glb)
    assert load_scene(str(tmp_path / "a.glb")).digest == sha256(glb)
    # Blobs have no suffix: anything but .gltf is a GLB.
    (tmp_path / "0123abcd").write_bytes(glb)
    assert load_scene_files("scene.glb", {"scene.glb": tmp_path / "0123abcd"}).digest == sha256(glb)
    _, binary = sound()
    text, _ = gltf_with("data:application/octet-stream;base64," + base64.b64encode(binary).decode())
    (tmp_path / "a.gltf").write_bytes(text)
    assert load_scene(tmp_path / "a.gltf").digest == sha256(text)


def test_a_glb_may_name_files_too(tmp_path: Path) -> None:
    text, binary = gltf_with("side.bin")
    (tmp_path / "side.bin").write_bytes(binary + b"longer than it says")
    (tmp_path / "scene.glb").write_bytes(pack_glb(text, b"not used"))
    assert load_scene(tmp_path / "scene.glb").ignored == ("a BIN chunk that no buffer uses (at chunk 1)",)


def test_links_that_stay_in_the_folder_are_followed(tmp_path: Path) -> None:
    text, binary = gltf_with("link.bin")
    folder = tmp_path / "folder"
    (folder / "data").mkdir(parents=True)
    (folder / "data" / "real.bin").write_bytes(binary)
    (folder / "link.bin").symlink_to(folder / "data" / "real.bin")
    (folder / "room.gltf").write_bytes(text)
    (tmp_path / "alias").symlink_to(folder)
    assert load_scene(tmp_path / "alias" / "room.gltf").triangle_count == 4


def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    import os

    text, _ = gltf_with("pipe.bin")
    os.mkfifo(tmp_path / "pipe.bin")
    (tmp_path / "room.gltf").write_bytes(text)
    with pytest.raises(SceneError, match="not a regular file"):
        load_scene(tmp_path / "room.gltf")


@pytest.mark.parametrize("path", ["nowhere.glb", "", "folder", "nowhere/scene.gltf", "a\0b.glb"])
def test_no_such_scene(path: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(SceneError) as caught:
        load_scene(tmp_path / path)
    assert caught.value.slug == "gltf.missing_file"


def test_an_upload_reads_nothing_but_its_files(tmp_path: Path) -> None:
    text, binary = gltf_with("scene.bin")
    (tmp_path / "room.gltf").write_bytes(text)
    (tmp_path / "scene.bin").write_bytes(binary)
    for root, files, where in (
        ("room.gltf", {"room.gltf": tmp_path / "room.gltf"}, "buffers[0].uri"),
        ("a/room.gltf", {"a/room.gltf": tmp_path / "room.gltf", "scene.bin": tmp_path / "scene.bin"}, "buffers[0].uri"),
        ("other.gltf", {"room.gltf": tmp_path / "room.gltf"}, "root"),
    ):
        with pytest.raises(SceneError) as caught:
            load_scene_files(root, files)
        assert (caught.value.slug, caught.value.where) == ("gltf.missing_file", where)


def test_unknown_chunks_and_optional_extensions_are_listed_as_ignored(tmp_path: Path) -> None:
    glb = changed(("extensionsUsed", lambda old: [*old, "VENDOR_thing"]), ("animations", [{}]), ("cameras/0/type", "orthographic"))
    extra = struct.pack("<II", 4, 0x21212121) + b"abcd"
    glb = glb[:8] + struct.pack("<I", len(glb) + len(extra)) + glb[12:] + extra
    (tmp_path / "a.glb").write_bytes(glb)
    assert load_scene(tmp_path / "a.glb").ignored == (
        "a GLB chunk of unknown type 0x21212121 (at a.glb: chunk 2)",
        "optional extension 'VENDOR_thing' (at extensionsUsed[2])",
        "animation: the static pose is baked (at animations)",
        "orthographic camera (at node 'eye' (nodes[3]))",
    )
