"""Meshes: primitives checked against the accessors they name, then read as triangles in object space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.gltf import extensions
from bake_core.gltf.accessors import Accessors, semantic_of
from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.scene import F32, F64, I64, U32

TRIANGLES, STRIP, FAN = 4, 5, 6
MODES = ("points", "lines", "line loop", "line strip", "triangles", "triangle strip", "triangle fan")
# Vertex normals this close to their triangle's say nothing that the triangle does not.
FLAT = 1e-4
# About 30 GB in Embree. A small file may name one index list a million times: what that would take is counted before it is taken.
MAX_TRIANGLES = 1 << 28


@dataclass(frozen=True)
class Primitive:
    """A checked primitive: accessor indices, not read yet."""

    where: str
    mode: int
    indices: int | None
    position: int
    normal: int | None
    color: int | None
    texcoords: Mapping[int, int]
    material: int | None
    triangle_count: int


@dataclass(frozen=True)
class Outline:
    """A checked mesh: only what has area; `unsupported` holds the arguments of :func:`fail` if it has what is not read yet."""

    primitives: tuple[Primitive, ...]
    unsupported: tuple[str, str, str] | None

    @property
    def triangle_count(self) -> int:
        return sum(p.triangle_count for p in self.primitives)


@dataclass(frozen=True)
class Mesh:
    """Triangles in object space.

    Attributes
    ----------
    positions : (v, 3) float32
    normals : (v, 3) float32 or None
        Unit, or zero where there is none; None where all are.
    colors : (v, 4) float32 or None
        Linear, in [0, 1].
    uvs : (v, 2 s) float32 or None
        Texture coordinates of the scene's s sets; None where it has none.
    triangles : (t, 3) uint32
    material : (t,) uint32
        Rows of the scene's materials.
    """

    positions: F32
    normals: F32 | None
    colors: F32 | None
    uvs: F32 | None
    triangles: U32
    material: U32


def check_mesh(f: Fields, accessors: Accessors, materials: int, notes: Notes) -> Outline:
    """Check one mesh's fields and indices; nothing is read from buffers.

    Raises
    ------
    SceneError
        What :class:`Fields` raises, ``gltf.bad_accessor``, ``gltf.count_mismatch``, ``gltf.bad_count``.
    """
    unsupported = None
    primitives = []
    if not f.count("primitives"):
        fail("missing_key", "must list at least one primitive", f.place("primitives"))
    if "weights" in f:
        unsupported = ("unsupported_morph_targets", "morph targets are not read yet; apply them first", f.place("weights"))
    for p in f.children("primitives"):
        if "targets" in p:
            unsupported = ("unsupported_morph_targets", "morph targets are not read yet; apply them first", p.place("targets"))
        refused = next((name for name in p.child("extensions").value if name in extensions.REFUSED), None)
        if refused is not None:
            hint = f"is not read; {extensions.REFUSED[refused]}"
            unsupported = ("unsupported_extension", hint, p.child("extensions").place(refused))
        primitive = _check_primitive(p, accessors, materials, notes)
        if primitive is not None:
            primitives.append(primitive)
    return Outline(tuple(primitives), unsupported)


def _check_primitive(p: Fields, accessors: Accessors, materials: int, notes: Notes) -> Primitive | None:
    attributes = p.child("attributes")
    if "POSITION" not in attributes:
        fail("missing_key", "is required: without positions there is no geometry", attributes.place("POSITION"))
    found: dict[str, int] = {}
    texcoords: dict[int, int] = {}
    vertices = 0
    for name in ["POSITION", *(k for k in attributes.value if k != "POSITION")]:
        accessor = attributes.required_index(name, len(accessors), "accessors")
        found[name] = accessor
        semantic = semantic_of(name)
        place = attributes.place(name if semantic else quoted(name))
        if semantic is not None:
            accessors.check_attribute(accessor, semantic, place)
        vertices = vertices or accessors.count(accessor)
        if accessors.count(accessor) != vertices:
            fail("count_mismatch", f"has {accessors.count(accessor)} elements, POSITION has {vertices}", place)
        if semantic == "TEXCOORD":
            texcoords[int(name.partition("_")[2])] = accessor
        elif name not in ("POSITION", "NORMAL", "COLOR_0"):
            notes.add(f"vertex attribute {quoted(name)}", p.where)
    indices = p.index("indices", len(accessors), "accessors")
    if indices is not None:
        accessors.check_indices(indices, p.place("indices"))
    material = p.index("material", materials, "materials")
    mode = p.integer("mode", default=TRIANGLES, high=6)
    corners = vertices if indices is None else accessors.count(indices)
    if mode < TRIANGLES:
        notes.add(f"{MODES[mode]}, which have no area", p.where)
        return None
    if corners < 3 or (mode == TRIANGLES and corners % 3):
        counted = p.where if indices is None else p.place("indices")
        fail("bad_count", f"{corners} vertices do not make {MODES[mode]}", counted)
    count = corners // 3 if mode == TRIANGLES else corners - 2
    return Primitive(p.where, mode, indices, found["POSITION"], found.get("NORMAL"), found.get("COLOR_0"), texcoords, material, count)


def check_size(triangles: int, where: str) -> None:
    if triangles > MAX_TRIANGLES:
        fail("too_large", f"{triangles} triangles are more than {MAX_TRIANGLES} (2^28)", where)


def read_mesh(outline: Outline, accessors: Accessors, row_of: Mapping[int | None, int], sets: Sequence[int]) -> Mesh:
    """Read a mesh's vertices, each that a triangle uses, once.

    Parameters
    ----------
    row_of : mapping
        Material index in the file, or None, to row in the scene.
    sets : sequence of int
        The TEXCOORDs that textures look at; zeros where a primitive has none, for then its material looks at none.

    Raises
    ------
    SceneError
        ``gltf.index_out_of_range`` for a vertex, ``gltf.primitive_restart``, ``gltf.not_finite``.
    """
    # Exporters let the primitives of one mesh share their vertices.
    groups: dict[tuple[int | None, ...], list[Primitive]] = {}
    for p in outline.primitives:
        groups.setdefault((p.position, p.normal, p.color, *(p.texcoords.get(s) for s in sets)), []).append(p)
    parts = [_read_group(g, accessors, row_of, sets) for g in groups.values()]
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return Mesh(np.zeros((0, 3), np.float32), None, None, None, np.zeros((0, 3), np.uint32), np.zeros(0, np.uint32))
    first = np.cumsum([0] + [len(p.positions) for p in parts])
    return Mesh(
        positions=np.concatenate([p.positions for p in parts]),
        normals=join([(p.normals, len(p.positions)) for p in parts], 3, 0.0),
        colors=join([(p.colors, len(p.positions)) for p in parts], 4, 1.0),
        uvs=join([(p.uvs, len(p.positions)) for p in parts], 2 * len(sets), 0.0),
        triangles=np.concatenate([p.triangles + np.uint32(base) for p, base in zip(parts, first, strict=False)]),
        material=np.concatenate([p.material for p in parts]),
    )


def join(parts: list[tuple[F32 | None, int]], width: int, fill: float) -> F32 | None:
    """Concatenate (values, count) parts, `fill` where a part has none; None where none has."""
    if all(values is None for values, _ in parts):
        return None
    return np.concatenate([np.full((count, width), fill, np.float32) if values is None else values for values, count in parts])


def _read_group(group: list[Primitive], accessors: Accessors, row_of: Mapping[int | None, int], sets: Sequence[int]) -> Mesh:
    first = group[0]
    positions = accessors.floats(first.position)
    corners = np.concatenate([_triangles(p, accessors, len(positions)) for p in group])
    material = np.repeat([row_of[p.material] for p in group], [p.triangle_count for p in group]).astype(np.uint32)
    used, triangles = _renumber(corners, len(positions))
    positions = np.ascontiguousarray(positions[used])
    normals = _unit(accessors.floats(first.normal)[used]) if first.normal is not None else None
    colors = _rgba(accessors.floats(first.color)[used]) if first.color is not None else None
    uvs = None
    if any(s in first.texcoords for s in sets):
        none = np.zeros((len(positions), 2), np.float32)
        uvs = np.hstack([accessors.floats(first.texcoords[s])[used] if s in first.texcoords else none for s in sets])
    if normals is not None and _say_nothing(normals, positions, triangles):
        normals = None
    return Mesh(positions, normals, colors, uvs, triangles, material)


def _renumber(corners: NDArray[np.integer], vertices: int) -> tuple[NDArray[np.integer] | NDArray[np.bool_], U32]:
    """Which of so many vertices occur in (t, 3) `corners`, and the corners as indices into those."""
    # Many small meshes may share one large list of vertices: then a table of it for each of them would cost far more than sorting.
    if corners.size < vertices // 8:
        used, triangles = np.unique(corners, return_inverse=True)
        return used, triangles.reshape(corners.shape).astype(np.uint32)
    occurs = np.zeros(vertices, np.bool_)
    occurs[corners] = True
    return occurs, (np.cumsum(occurs) - 1).astype(np.uint32)[corners]


def _triangles(p: Primitive, accessors: Accessors, vertices: int) -> NDArray[np.integer]:
    """(t, 3) vertex indices, counter-clockwise from the front (glTF 2.0, 3.7.2.1)."""
    order: NDArray[np.integer]
    if p.indices is None:
        order = np.arange(vertices)
    else:
        place = f"{p.where}.indices"
        order = accessors.indices(p.indices, place)
        if int(order.max()) >= vertices:
            at = int(np.argmax(order >= vertices))
            fail("index_out_of_range", f"element {at} is vertex {order[at]}, but there are {vertices}", place)
    if p.mode == TRIANGLES:
        return order.reshape(-1, 3)
    i: I64 = np.arange(p.triangle_count)
    if p.mode == STRIP:
        return order[np.stack([i, i + 1 + i % 2, i + 2 - i % 2], axis=1)]
    return order[np.stack([i + 1, i + 2, np.zeros_like(i)], axis=1)]


def _unit(vectors: F32) -> F32:
    """Unit vectors; zero stays zero."""
    wide = vectors.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    unit: F64 = np.divide(wide, length, out=np.zeros_like(wide), where=length > 0)
    return unit.astype(np.float32)


def _rgba(colors: F32) -> F32:
    # glTF 2.0, 3.7.2.1: COLOR_n must be clamped to [0, 1].
    clamped: F32 = np.clip(colors, 0, 1)
    padded: F32 = np.pad(clamped, ((0, 0), (0, 4 - clamped.shape[1])), constant_values=1)
    return padded


def _say_nothing(normals: F32, positions: F32, triangles: U32) -> bool:
    """Whether every triangle's vertex normals are its own."""
    if not normals.any():
        return True
    faces = cross_of(positions.astype(np.float64)[triangles])
    length = np.linalg.norm(faces, axis=1)
    solid = length > 0
    faces = faces[solid] / length[solid, None]
    return bool((np.abs(normals[triangles[solid]] - faces[:, None, :]) <= FLAT).all())


def cross_of(corners: F64) -> F64:
    """(t, 3) cross products of the edges of (t, 3, 3) corners: twice the area, towards the front."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
