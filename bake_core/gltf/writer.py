"""A small GLB writer: the same calls give the same bytes. For our own scenes (examples, tests, the stability command)."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.gltf.accessors import FLOAT, UBYTE, UINT, USHORT
from bake_core.gltf.container import BIN_CHUNK, JSON_CHUNK, MAGIC
from bake_core.gltf.meshes import TRIANGLES
from bake_core.gltf.textures import LINEAR, NEAREST

Vec3 = Sequence[float]
TextureInfo = Mapping[str, Any]
REPEAT, MIRRORED, CLAMP = 10497, 33648, 33071


@dataclass(frozen=True)
class Part:
    """One primitive of a mesh.

    Attributes
    ----------
    positions : (v, 3) float
    indices : (k,) or (t, 3) int, optional
        Written as ubyte, ushort or uint, whichever is the smallest that holds them.
    normals : (v, 3) float, optional
    colors : (v, 3) or (v, 4) float, optional
        Linear COLOR_0.
    material : int, optional
        What :meth:`GlbWriter.material` gave.
    mode : int
        4 triangles, 5 strip, 6 fan.
    uvs : sequence of (v, 2) float
        TEXCOORD_0, TEXCOORD_1, ...
    """

    positions: ArrayLike
    indices: ArrayLike | None = None
    normals: ArrayLike | None = None
    colors: ArrayLike | None = None
    material: int | None = None
    mode: int = TRIANGLES
    uvs: Sequence[ArrayLike] = ()


class GlbWriter:
    """Collects materials, meshes, lights, cameras and nodes, each by a call that gives its index; :meth:`to_glb` writes them."""

    def __init__(self) -> None:
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._lights: list[dict[str, Any]] = []
        self._extensions: set[str] = set()
        self._binary = bytearray()

    def material(
        self,
        name: str,
        base_color: Vec3 = (1.0, 1.0, 1.0),
        *,
        metallic: float = 0.0,
        roughness: float = 1.0,
        emission: Vec3 = (0.0, 0.0, 0.0),
        double_sided: bool = False,
        alpha: float = 1.0,
        alpha_mode: str = "OPAQUE",
        alpha_cutoff: float | None = None,
        unlit: bool = False,
        base_color_texture: TextureInfo | None = None,
        metallic_roughness_texture: TextureInfo | None = None,
        emissive_texture: TextureInfo | None = None,
    ) -> int:
        """A material, Lambert unless told otherwise; `emission` is radiance, of any strength."""
        pbr: dict[str, Any] = {
            "baseColorFactor": [*map(float, base_color), float(alpha)],
            "metallicFactor": metallic,
            "roughnessFactor": roughness,
        }
        textures = {"baseColorTexture": base_color_texture, "metallicRoughnessTexture": metallic_roughness_texture}
        material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": pbr | {k: dict(v) for k, v in textures.items() if v is not None}}
        if emissive_texture is not None:
            material["emissiveTexture"] = dict(emissive_texture)
        if alpha_mode != "OPAQUE":
            material["alphaMode"] = alpha_mode
        if alpha_cutoff is not None:
            material["alphaCutoff"] = float(alpha_cutoff)
        extensions: dict[str, Any] = {}
        strength = max(1.0, *map(float, emission))
        if any(emission):
            material["emissiveFactor"] = [float(e) / strength for e in emission]
        if strength > 1:
            extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
        if unlit:
            extensions["KHR_materials_unlit"] = {}
        if extensions:
            material["extensions"] = extensions
            self._extensions |= extensions.keys()
        if double_sided:
            material["doubleSided"] = True
        return self._add("materials", material)

    def texture(
        self, image: bytes, *, wrap: tuple[int, int] = (REPEAT, REPEAT), nearest: bool = False, kind: str = "image/png"
    ) -> dict[str, Any]:
        """A texture of an encoded image, as the textureInfo that materials take; add texCoord or extensions to it as needed."""
        source = self._add("images", {"bufferView": self._view(image), "mimeType": kind})
        sampler = self._add("samplers", {"magFilter": NEAREST if nearest else LINEAR, "wrapS": wrap[0], "wrapT": wrap[1]})
        return {"index": self._add("textures", {"source": source, "sampler": sampler})}

    def transformed(self, info: TextureInfo, **transform: Any) -> dict[str, Any]:
        """A textureInfo with KHR_texture_transform: offset, rotation, scale, texCoord."""
        self._extensions.add("KHR_texture_transform")
        return {**info, "extensions": {"KHR_texture_transform": transform}}

    def mesh(self, name: str, parts: Sequence[Part]) -> int:
        return self._add("meshes", {"name": name, "primitives": [self._primitive(p) for p in parts]})

    def light(
        self,
        kind: str,
        color: Vec3 = (1.0, 1.0, 1.0),
        intensity: float = 1.0,
        *,
        range: float | None = None,
        inner: float = 0.0,
        outer: float | None = None,
    ) -> int:
        """A ``directional``, ``point`` or ``spot`` light, which shines along its node's -Z; angles in radians."""
        light: dict[str, Any] = {"type": kind, "color": [*map(float, color)], "intensity": float(intensity)}
        if range is not None:
            light["range"] = range
        if kind == "spot":
            light["spot"] = {"innerConeAngle": inner} | ({"outerConeAngle": outer} if outer is not None else {})
        self._extensions.add("KHR_lights_punctual")
        self._lights.append(light)
        return len(self._lights) - 1

    def camera(self, yfov: float, *, aspect: float = 16 / 9, near: float = 0.01) -> int:
        """A perspective camera; `yfov` in radians."""
        return self._add("cameras", {"type": "perspective", "perspective": {"yfov": yfov, "aspectRatio": aspect, "znear": near}})

    def node(
        self,
        name: str = "",
        *,
        mesh: int | None = None,
        light: int | None = None,
        camera: int | None = None,
        children: Sequence[int] = (),
        translation: Vec3 | None = None,
        rotation: Sequence[float] | None = None,
        scale: Vec3 | None = None,
        matrix: ArrayLike | None = None,
    ) -> int:
        """A node; `matrix` is (4, 4), applied to column vectors. Nodes that are nobody's child are the scene's roots."""
        node: dict[str, Any] = {"name": name} if name else {}
        node |= {k: v for k, v in (("mesh", mesh), ("camera", camera)) if v is not None}
        node |= {k: [*map(float, v)] for k, v in (("translation", translation), ("rotation", rotation), ("scale", scale)) if v is not None}
        if matrix is not None:
            node["matrix"] = np.asarray(matrix, np.float64).T.reshape(16).tolist()
        if children:
            node["children"] = list(children)
        if light is not None:
            node["extensions"] = {"KHR_lights_punctual": {"light": light}}
        return self._add("nodes", node)

    def document(self) -> dict[str, Any]:
        """The JSON of the file."""
        nodes = self._lists.get("nodes", [])
        below = {c for n in nodes for c in n.get("children", ())}
        roots = [i for i in range(len(nodes)) if i not in below]
        document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "octobake"}, "scene": 0}
        document["scenes"] = [{"nodes": roots} if roots else {}]
        if self._extensions:
            document["extensionsUsed"] = sorted(self._extensions)
        document |= self._lists
        if self._lights:
            document["extensions"] = {"KHR_lights_punctual": {"lights": self._lights}}
        if self._binary:
            document["buffers"] = [{"byteLength": len(self._binary)}]
        return document

    def to_glb(self) -> bytes:
        return pack_glb(json.dumps(self.document(), separators=(",", ":")).encode(), bytes(self._binary))

    def _add(self, kind: str, item: dict[str, Any]) -> int:
        items = self._lists.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def _primitive(self, part: Part) -> dict[str, Any]:
        positions = np.asarray(part.positions, np.float32).reshape(-1, 3)
        attributes = {"POSITION": self._accessor(positions, FLOAT, bounds=True)}
        if part.normals is not None:
            attributes["NORMAL"] = self._accessor(np.asarray(part.normals, np.float32).reshape(-1, 3), FLOAT)
        if part.colors is not None:
            attributes["COLOR_0"] = self._accessor(np.asarray(part.colors, np.float32), FLOAT)
        for i, uv in enumerate(part.uvs):
            attributes[f"TEXCOORD_{i}"] = self._accessor(np.asarray(uv, np.float32).reshape(-1, 2), FLOAT)
        primitive: dict[str, Any] = {"attributes": attributes}
        if part.indices is not None:
            indices = np.asarray(part.indices).reshape(-1)
            # The largest value of each type is primitive restart, which glTF forbids.
            component = next(c for c, limit in ((UBYTE, 0xFF), (USHORT, 0xFFFF), (UINT, 0xFFFFFFFF)) if indices.max(initial=0) < limit)
            primitive["indices"] = self._accessor(indices, component)
        if part.material is not None:
            primitive["material"] = part.material
        return primitive | ({"mode": part.mode} if part.mode != TRIANGLES else {})

    def _view(self, data: bytes) -> int:
        self._binary += bytes(-len(self._binary) % 4)
        view = self._add("bufferViews", {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(data)})
        self._binary += data
        return view

    def _accessor(self, values: NDArray[Any], component: int, *, bounds: bool = False) -> int:
        dtype = {UBYTE: "<u1", USHORT: "<u2", UINT: "<u4", FLOAT: "<f4"}[component]
        view = self._view(np.ascontiguousarray(values, dtype).tobytes())
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessor: dict[str, Any] = {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        if bounds:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self._add("accessors", accessor)


def pack_glb(document: bytes, binary: bytes | None = None) -> bytes:
    """Wrap JSON, and bytes where there are any, in GLB chunks (glTF 2.0, chapter 4)."""
    chunks = [(JSON_CHUNK, document + b" " * (-len(document) % 4))]
    if binary:
        chunks.append((BIN_CHUNK, binary + bytes(-len(binary) % 4)))
    body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in chunks)
    return MAGIC + struct.pack("<II", 2, 12 + len(body)) + body


def look_at(eye: Vec3, target: Vec3) -> NDArray[np.float64]:
    """(4, 4) matrix of a node at `eye` whose -Z looks at `target`, its +Y as far up as it can be."""
    position = np.asarray(eye, np.float64)
    back = position - np.asarray(target, np.float64)
    back /= np.linalg.norm(back)
    # Straight up or down, +Z is as good as any.
    up = np.array([0.0, 0.0, 1.0]) if abs(back[1]) > 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return matrix
