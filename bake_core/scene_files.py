"""Every kind of scene file behind one door: glTF, a zip of a glTF's folder, or a bare mesh."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from bake_core import zip_files
from bake_core.gltf import reader
from bake_core.mesh_files import SUFFIXES, read_mesh_file
from bake_core.scene import Scene


def load_scene(path: str | Path) -> Scene:
    """Read a scene: .glb, .gltf with the files beside it, a .zip of such a folder, .obj, .ply or .stl.

    Returns
    -------
    Scene
        Its digest is the same for a folder and for a zip of it.

    Raises
    ------
    SceneError
        ``gltf.*`` and ``scene.*``; nothing is left behind.
    """
    path = Path(path)
    return _mesh_or_zip(path, path.name) or reader.load_scene(path)


def load_scene_files(root: str, files: Mapping[str, Path]) -> Scene:
    """Read a scene from uploaded files, as :func:`bake_core.gltf.reader.load_scene_files` does; `root` may be of any kind.

    Raises
    ------
    SceneError
    """
    found = _mesh_or_zip(files[root], root.rpartition("/")[2]) if root in files else None
    return found or reader.load_scene_files(root, files)


def _mesh_or_zip(path: Path, name: str) -> Scene | None:
    if name.lower().endswith(SUFFIXES):
        return read_mesh_file(path, name)
    if not zip_files.is_zip(path) and not (name.lower().endswith(".zip") and path.is_file()):
        return None
    with tempfile.TemporaryDirectory(prefix="octobake-zip-") as folder:
        return reader.load_scene_files(*zip_files.unpack(path, Path(folder), name))
