"""OBJ, PLY and STL through trimesh: triangles in a neutral material, for formats that say little about light."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np
import trimesh

from bake_core.errors import SceneError
from bake_core.gltf.meshes import MAX_TRIANGLES
from bake_core.gltf.names import read_file
from bake_core.gltf.placement import MAX_COORDINATE
from bake_core.scene import ALPHA_OPAQUE, NO_TEXTURE, Lights, Materials, Scene

SUFFIXES = (".obj", ".ply", ".stl")
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
    try:
        # Without a resolver trimesh opens no other file.
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False, skip_materials=True)
        mesh = scene.to_mesh()
        vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    except Exception as e:
        # Whatever trimesh's parsers stumble over, of any kind, is the file's fault.
        reason = str(e).partition("\n")[0][:120] or type(e).__name__
        raise SceneError("scene.bad_mesh", f"cannot be read as {kind.upper()}: {reason}", name) from None
    if not len(faces):
        raise SceneError("scene.bad_mesh", f"has no triangles that could be read as {kind.upper()}", name)
    if len(faces) > MAX_TRIANGLES:
        raise SceneError("scene.mesh_too_large", f"{len(faces)} triangles are more than {MAX_TRIANGLES} (2^28)", name)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError("scene.bad_mesh", f"a triangle names vertex {faces.max()}, but there are {len(vertices)}", name)
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
