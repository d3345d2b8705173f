"""What a fault is, and the sound scene that most of them are made from."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bake_core.gltf.writer import GlbWriter, Part, pack_glb

Json = dict[str, Any]
GLB, GLTF = "scene.glb", "scene.gltf"
FLOAT32_NAN, FLOAT32_INF, FLOAT32_HUGE = (struct.pack("<f", v) for v in (float("nan"), float("inf"), 3e38))


@dataclass(frozen=True)
class Fault:
    """One scene that must be refused.

    Attributes
    ----------
    name : str
        What is wrong with it, in a few words; unique.
    slug : str
        Expected slug of the SceneError.
    where : str
        Expected place, exactly.
    files : mapping of str to bytes
        The scene's files by name.
    root : str
        Which of them is the scene.
    links : mapping of str to str
        Symbolic links to make in the folder, name to target: faults that only a file system can have, not an upload.
    folders : tuple of str
        Folders to make, likewise.
    """

    name: str
    slug: str
    where: str
    files: Mapping[str, bytes]
    root: str = GLB
    links: Mapping[str, str] = field(default_factory=dict)
    folders: tuple[str, ...] = ()

    @property
    def needs_file_system(self) -> bool:
        return bool(self.links or self.folders)

    def write(self, folder: Path) -> Path:
        """Write it into an empty folder; the scene's path."""
        for name, data in self.files.items():
            (folder / name).write_bytes(data)
        for name in self.folders:
            (folder / name).mkdir()
        for name, target in self.links.items():
            os.symlink(target, folder / name)
        return folder / self.root


def sound() -> tuple[Json, bytes]:
    """JSON and binary of the sound scene that most faults are made from: a square with everything on it, used by two nodes."""
    w = GlbWriter()
    grey = w.material("grey", (0.5, 0.5, 0.5), emission=(2.0, 1.0, 0.0))
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    part = Part(square, [0, 1, 2, 0, 2, 3], [[0, 0, 1], [0, 1, 1], [0, 0, 1], [0, 0, 1]], [[1, 1, 1, 1]] * 4, grey)
    mesh = w.mesh("square", [part])
    w.node("floor", mesh=mesh)
    lamp = w.node("lamp", light=w.light("spot", inner=0.1, outer=0.5))
    w.node("twin", mesh=mesh, translation=(0, 0, 2), rotation=(0, 0, 0, 1), scale=(1, 2, 1), children=[lamp])
    w.node("eye", camera=w.camera(1.0))
    return w.document(), bytes(w._binary)


def changed(*edits: tuple[str, Any]) -> bytes:
    """The sound scene with fields set; paths as ``accessors/0/count``. A callable gets the old value and gives the new."""
    document, binary = sound()
    for path, value in edits:
        put(document, path, value)
    return pack_glb(dump(document), binary)


# In the place of a value: the field goes.
REMOVE = object()


def put(document: Any, path: str, value: Any) -> None:
    """Set one field, by its path."""
    parts: list[Any] = [int(s) if s.isdecimal() else s for s in path.split("/")]
    *steps, last = parts
    for step in steps:
        document = document[step] if isinstance(document, list) else document.setdefault(step, {})
    if value is REMOVE:
        del document[last]
    else:
        document[last] = value(document[last]) if callable(value) else value


def dump(document: Any) -> bytes:
    """As JSON."""
    return json.dumps(document, separators=(",", ":")).encode()
