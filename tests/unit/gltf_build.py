"""A glTF put together field by field, for what our own writer does not write; and scenes seen as plain triangles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.gltf.accessors import DTYPES
from bake_core.gltf.reader import load_scene
from bake_core.gltf.writer import pack_glb
from bake_core.scene import Scene

TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
FLOAT, UBYTE, USHORT, UINT = 5126, 5121, 5123, 5125


class Raw:
    """Collects accessors; `load` makes a scene of whatever JSON it is given."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, **more: Any) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)} | more)
        self.binary += data
        return len(self.views) - 1

    def accessor(self, values: ArrayLike, component: int = FLOAT, **more: Any) -> int:
        array = np.asarray(values).astype(DTYPES[component])
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        self.accessors.append(
            {"bufferView": self.view(array.tobytes()), "componentType": component, "count": len(array), "type": kind} | more
        )
        return len(self.accessors) - 1

    def document(self, **parts: Any) -> dict[str, Any]:
        """`parts` with defaults: node 0 shows mesh 0, and every node is a root of the only scene."""
        nodes = parts.setdefault("nodes", [{"mesh": 0}])
        document = {"asset": {"version": "2.0"}, "scenes": [{"nodes": list(range(len(nodes)))}], **parts}
        if self.binary:
            document |= {"buffers": [{"byteLength": len(self.binary)}], "bufferViews": self.views, "accessors": self.accessors}
        return document

    def load(self, folder: Path, **parts: Any) -> Scene:
        path = folder / "raw.glb"
        path.write_bytes(pack_glb(json.dumps(self.document(**parts)).encode(), bytes(self.binary)))
        return load_scene(path)


def load_glb(data: bytes, folder: Path) -> Scene:
    path = folder / "scene.glb"
    path.write_bytes(data)
    return load_scene(path)


def world_triangles(scene: Scene) -> NDArray[np.float64]:
    """(t, 3, 3) corners in the world as rays see them, instances expanded, counter-clockwise from the front."""
    first = scene.mesh_first_triangle
    local = scene.positions.astype(np.float64)[scene.indices]
    parts = [local[: first[1]]]
    for mesh, matrix in zip(scene.instance_mesh, scene.instance_transform, strict=True):
        corners = local[first[mesh] : first[mesh + 1]] @ matrix[:, :3].T + matrix[:, 3]
        parts.append(corners if np.linalg.det(matrix[:, :3]) >= 0 else corners[:, ::-1])
    return np.concatenate(parts) + scene.origin


def face_normals(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return unit
