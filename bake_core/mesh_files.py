"""OBJ, PLY and STL, the last two through trimesh: triangles in a neutral material, for formats that say little about light."""

from __future__ import annotations

import hashlib
import io
import re
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from bake_core.errors import SceneError
from bake_core.gltf.meshes import MAX_TRIANGLES
from bake_core.gltf.names import read_file
from bake_core.gltf.placement import MAX_COORDINATE
from bake_core.obj_files import read_obj
from bake_core.scene import ALPHA_OPAQUE, NO_TEXTURE, Lights, Materials, Scene

SUFFIXES = (".obj", ".ply", ".stl")
PLY_FORMATS = (b"ascii", b"binary_little_endian", b"binary_big_endian")
# Half-way between black and white, seen from both sides: these files have no sure winding.
NEUTRAL_ALBEDO = 0.5
NOTE = f"materials, colours, normals and texture coordinates: all is flat Lambert of albedo {NEUTRAL_ALBEDO}, double-sided"


def read_mesh_file(path: Path, name: str) -> Scene:
    """Read a mesh; its units are metres and its +Y is up, for none of these formats says.

    Parameters
    ----------
    name : str
        With the suffix that says what it is; what messages call it.

    Raises
    ------
    SceneError
        ``gltf.missing_file``, ``scene.bad_mesh``, ``scene.mesh_too_large``.
    """
    data = read_file(path, name, name)
    kind = name.rpartition(".")[2].lower()
    if kind == "obj":
        vertices, faces = read_obj(data, name)
    else:
        (_check_ply if kind == "ply" else _check_stl)(data, name)
        vertices, faces = _read_with_trimesh(data, kind, name)
    if not len(faces):
        raise SceneError("scene.bad_mesh", f"has no triangles that could be read as {kind.upper()}", name)
    if len(faces) > MAX_TRIANGLES:
        raise SceneError("scene.mesh_too_large", f"{len(faces)} triangles are more than {MAX_TRIANGLES} (2^28)", name)
    if faces.min() < 0 or faces.max() >= len(vertices):
        worst = faces.min() if faces.min() < 0 else faces.max()
        raise SceneError("scene.bad_mesh", f"a triangle names vertex {worst}, but there are {len(vertices)}, counted from 0", name)
    used, indices = np.unique(faces, return_inverse=True)
    vertices = vertices[used]
    # Written so that NaN fails too.
    if not (np.abs(vertices) <= MAX_COORDINATE).all():
        raise SceneError("scene.bad_mesh", f"has vertices that are no numbers, or beyond {MAX_COORDINATE:g} m", name)
    bounds = np.array([vertices.min(axis=0), vertices.max(axis=0)])
    origin = bounds.mean(axis=0)
    return Scene(
        digest="sha256:" + hashlib.sha256(data).hexdigest(),
        origin=origin,
        bounds=bounds,
        positions=(vertices - origin).astype(np.float32),
        normals=np.zeros((0, 3), np.float32),
        colors=np.zeros((0, 4), np.float32),
        uvs=np.zeros((len(vertices), 0), np.float32),
        indices=indices.reshape(-1, 3).astype(np.uint32),
        triangle_material=np.zeros(len(faces), np.uint32),
        mesh_first_triangle=np.array([0, len(faces)], np.int64),
        instance_mesh=np.zeros(0, np.int32),
        instance_transform=np.zeros((0, 3, 4)),
        materials=_neutral(),
        lights=_dark(),
        cameras=(),
        nodes=(),
        textures=(),
        images=(),
        ignored=(f"{NOTE} (at {name})",),
    )


def _read_with_trimesh(data: bytes, kind: str, name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    try:
        mesh = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False).to_mesh()
        return np.asarray(mesh.vertices, np.float64).reshape(-1, 3), np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    except Exception as e:
        # Whatever trimesh's parsers stumble over, of any kind, is the file's fault.
        reason = str(e).partition("\n")[0][:120] or type(e).__name__
        raise SceneError("scene.bad_mesh", f"cannot be read as {kind.upper()}: {reason}", name) from None


def _check_ply(data: bytes, name: str) -> None:
    """What trimesh does not: that an ASCII file has as many lines as its header says. Of binary ones it checks the length itself."""
    header, end, body = data.partition(b"end_header")
    form = re.search(rb"^format[ \t]+(\w+)", header, re.MULTILINE)
    if not data.startswith(b"ply") or not end or form is None or form[1] not in PLY_FORMATS:
        forms = ", ".join(f.decode() for f in PLY_FORMATS)
        raise SceneError("scene.bad_mesh", f"has no header of a PLY, from 'ply' to 'end_header', of format {forms}", name)
    if form[1] == b"ascii":
        said = sum(map(int, re.findall(rb"^element[ \t]+\w+[ \t]+(\d+)", header, re.MULTILINE)))
        found = sum(bool(line.strip()) for line in body.splitlines())
        if found != said:
            raise SceneError("scene.bad_mesh", f"says it has {said} lines after its header, has {found}; export it again", name)


def _check_stl(data: bytes, name: str) -> None:
    """That it is one of the two kinds: binary of just the length that its count says, or ASCII, which begins with a word."""
    size = len(data)
    count = int.from_bytes(data[80:84], "little") if size >= 84 else 0
    if size != 84 + 50 * count and not data.lstrip().startswith(b"solid"):
        text = (
            f"is no ASCII STL, and as a binary one of {count} triangles it would have {84 + 50 * count} bytes, not {size}; export it again"
        )
        raise SceneError("scene.bad_mesh", text, name)


def _neutral() -> Materials:
    one = np.ones(1, np.float32)
    none = np.full(1, NO_TEXTURE, np.int32)
    return Materials(
        name=("(neutral)",),
        base_color=np.full((1, 3), NEUTRAL_ALBEDO, np.float32),
        metallic=0 * one,
        roughness=one,
        emission=np.zeros((1, 3), np.float32),
        double_sided=np.ones(1, np.bool_),
        unlit=np.zeros(1, np.bool_),
        alpha_mode=np.full(1, ALPHA_OPAQUE, np.uint8),
        alpha=one,
        alpha_cutoff=0.5 * one,
        base_color_texture=none,
        metallic_roughness_texture=none,
        emissive_texture=none,
    )


def _dark() -> Lights:
    vectors, numbers = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    return Lights(np.zeros(0, np.int32), vectors, vectors, vectors, numbers, numbers, numbers)
