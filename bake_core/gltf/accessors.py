"""Accessors: typed arrays over the buffers' bytes. All sizes are checked in Python integers before anything is allocated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.gltf import extensions
from bake_core.gltf.container import Document
from bake_core.gltf.fields import Fields, fail, quoted

BYTE, UBYTE, SHORT, USHORT, UINT, FLOAT = 5120, 5121, 5122, 5123, 5125, 5126
DTYPES = {BYTE: "<i1", UBYTE: "<u1", SHORT: "<i2", USHORT: "<u2", UINT: "<u4", FLOAT: "<f4"}
COMPONENT_NAMES = {BYTE: "byte", UBYTE: "ubyte", SHORT: "short", USHORT: "ushort", UINT: "uint", FLOAT: "float"}
# type -> (columns, rows)
SHAPES = {"SCALAR": (1, 1), "VEC2": (1, 2), "VEC3": (1, 3), "VEC4": (1, 4), "MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4)}
# A sparse accessor may stand over zeros that are in no buffer: a few bytes of file must not ask for gigabytes of memory.
MAX_ZEROS = 1 << 20


@dataclass(frozen=True)
class View:
    """A slice of a buffer; `stride` is 0 where elements are tightly packed."""

    fields: Fields
    data: memoryview
    offset: int
    stride: int


@dataclass(frozen=True)
class Rule:
    """What core glTF allows in one place: element types, and pairs of component type and `normalized`."""

    types: tuple[str, ...]
    components: tuple[tuple[int, bool], ...]

    def __str__(self) -> str:
        parts = [("normalised " if normalized else "") + COMPONENT_NAMES[c] for c, normalized in self.components]
        return f"{' or '.join(self.types)} of {' or '.join(parts)}"


_UNIT = ((FLOAT, False), (UBYTE, True), (USHORT, True))
INDICES = Rule(("SCALAR",), ((UBYTE, False), (USHORT, False), (UINT, False)))
# By semantic, without its number (glTF 2.0, 3.7.2.1).
ATTRIBUTES = {
    "POSITION": Rule(("VEC3",), ((FLOAT, False),)),
    "NORMAL": Rule(("VEC3",), ((FLOAT, False),)),
    "TANGENT": Rule(("VEC4",), ((FLOAT, False),)),
    "TEXCOORD": Rule(("VEC2",), _UNIT),
    "COLOR": Rule(("VEC3", "VEC4"), _UNIT),
    "JOINTS": Rule(("VEC4",), ((UBYTE, False), (USHORT, False))),
    "WEIGHTS": Rule(("VEC4",), _UNIT),
}
_SIGNED = ((BYTE, True), (SHORT, True))
_INTEGERS = tuple((c, n) for c in (BYTE, UBYTE, SHORT, USHORT) for n in (False, True))
# KHR_mesh_quantization allows these too.
QUANTIZED = ATTRIBUTES | {
    "POSITION": Rule(("VEC3",), ((FLOAT, False), *_INTEGERS)),
    "NORMAL": Rule(("VEC3",), ((FLOAT, False), *_SIGNED)),
    "TANGENT": Rule(("VEC4",), ((FLOAT, False), *_SIGNED)),
    "TEXCOORD": Rule(("VEC2",), ((FLOAT, False), *_INTEGERS)),
}


@dataclass(frozen=True)
class Accessor:
    """One checked accessor, not read yet."""

    where: str
    component: int
    kind: str
    count: int
    normalized: bool
    view: int | None
    offset: int
    sparse: Fields | None


class Accessors:
    """All accessors of a document, checked when it is made, read when asked for.

    Raises
    ------
    SceneError
        On making: what :class:`Fields` raises, ``gltf.view_out_of_buffer``, ``gltf.accessor_out_of_view``, ``gltf.bad_stride``,
        ``gltf.misaligned`` and ``gltf.bad_accessor``, also for what nothing uses.
    """

    def __init__(self, document: Document) -> None:
        self._views = [_view(v, document.buffers) for v in document.root.children("bufferViews")]
        self._all = [self._check(a) for a in document.root.children("accessors")]
        self._floats: dict[int, NDArray[np.float32]] = {}
        used = (*document.root.texts("extensionsUsed"), *document.root.texts("extensionsRequired"))
        self._attributes = QUANTIZED if "KHR_mesh_quantization" in used else ATTRIBUTES

    def __len__(self) -> int:
        return len(self._all)

    @property
    def views(self) -> int:
        """How many bufferViews there are."""
        return len(self._views)

    def view_bytes(self, index: int) -> bytes:
        """What a bufferView holds."""
        view = self._views[index]
        extensions.of(view.fields)
        return bytes(view.data[view.offset :])

    def count(self, index: int) -> int:
        return self._all[index].count

    def indices(self, index: int, where: str) -> NDArray[np.unsignedinteger]:
        """(count,) unsigned integers, as stored.

        Raises
        ------
        SceneError
            ``gltf.primitive_restart`` where the type's largest value occurs, which glTF forbids.
        """
        values: NDArray[np.unsignedinteger] = self._read(self._all[index])[:, 0]
        restart = np.iinfo(values.dtype).max
        if values.max() == restart:
            fail("primitive_restart", f"has the value {restart}, which glTF does not allow (primitive restart)", where)
        return values

    def check_indices(self, index: int, where: str) -> None:
        """Refuse an accessor that cannot be a list of indices."""
        view = self._require(index, INDICES, where).view
        if view is not None and self._views[view].stride:
            fail("bad_stride", f"indices must be tightly packed, but {self._views[view].fields.where} has a byteStride", where)

    def check_attribute(self, index: int, semantic: str, where: str) -> None:
        """Refuse an accessor whose type the attribute's semantic does not allow."""
        self._require(index, self._attributes[semantic], where)

    def floats(self, index: int) -> NDArray[np.float32]:
        """(count, n) float32, normalised integers in [0, 1] or [-1, 1]; do not write to it.

        Raises
        ------
        SceneError
            ``gltf.not_finite`` for NaN and infinities.
        """
        if index not in self._floats:
            accessor = self._all[index]
            values = self._read(accessor)
            if accessor.component == FLOAT:
                finite = np.isfinite(values).all(axis=1)
                if not finite.all():
                    fail("not_finite", f"element {int(np.argmin(finite))} is NaN or infinite", accessor.where)
            elif accessor.normalized:
                # glTF 2.0, 3.11: the one value beyond -1 is -1 too.
                values = np.maximum(np.divide(values, np.iinfo(values.dtype).max, dtype=np.float32), np.float32(-1))
            else:
                values = values.astype(np.float32)
            self._floats[index] = values
        return self._floats[index]

    def _require(self, index: int, rule: Rule, where: str) -> Accessor:
        """The accessor, if its type is right and it has data."""
        a = self._all[index]
        if a.kind not in rule.types or (a.component, a.normalized) not in rule.components:
            given = f"{a.kind} of {'normalised ' if a.normalized else ''}{COMPONENT_NAMES[a.component]}"
            fail("bad_accessor", f"accessor {index} is {given}, must be {rule}", where)
        if a.view is None and a.sparse is None:
            fail("bad_accessor", f"accessor {index} has no bufferView and is not sparse: it has no data", where)
        for view in [a.view, *(a.sparse.child(k).value["bufferView"] for k in ("indices", "values") if a.sparse)]:
            if view is not None:
                extensions.of(self._views[view].fields)
        return a

    def _read(self, a: Accessor) -> NDArray[Any]:
        """(count, rows) values with the sparse ones in place; a view of the buffer where it can be."""
        rows = SHAPES[a.kind][1]
        values: NDArray[Any]
        if a.view is None:
            values = np.zeros((a.count, rows), DTYPES[a.component])
        else:
            view = self._views[a.view]
            size = np.dtype(DTYPES[a.component]).itemsize
            values = np.ndarray((a.count, rows), DTYPES[a.component], view.data, view.offset + a.offset, (view.stride or size * rows, size))
        if a.sparse is not None:
            values = values.copy()
            count = a.sparse.value["count"]
            places, new = a.sparse.child("indices"), a.sparse.child("values")
            at = self._packed(places, places.value["componentType"], count, 1)[:, 0].astype(np.int64)
            if (np.diff(at) <= 0).any() or at[-1] >= a.count:
                fail("bad_accessor", f"must grow strictly and stay below the accessor's count of {a.count}", places.where)
            values[at] = self._packed(new, a.component, count, rows)
        return values

    def _packed(self, part: Fields, component: int, count: int, rows: int) -> NDArray[Any]:
        view = self._views[part.value["bufferView"]]
        return np.ndarray((count, rows), DTYPES[component], view.data, view.offset + part.value.get("byteOffset", 0))

    def _check(self, f: Fields) -> Accessor:
        component = _component(f, tuple(DTYPES))
        kind = f.text("type")
        if kind not in SHAPES:
            fail("out_of_range", f"is {quoted(kind)}, must be one of {', '.join(SHAPES)}", f.place("type"))
        normalized = f.boolean("normalized")
        if normalized and component in (FLOAT, UINT):
            fail("bad_accessor", f"must not be true for {COMPONENT_NAMES[component]} components", f.place("normalized"))
        count = f.integer("count", low=1)
        columns, rows = SHAPES[kind]
        size = np.dtype(DTYPES[component]).itemsize
        # A matrix's columns begin at multiples of 4 bytes.
        element = size * rows if columns == 1 else (columns - 1) * (-(-size * rows // 4) * 4) + size * rows
        view = f.index("bufferView", len(self._views), "bufferViews")
        offset = f.integer("byteOffset", default=0)
        if view is not None:
            self._check_fit(f, view, offset, count, element, size)
        elif "byteOffset" in f:
            fail("bad_accessor", "must not stand without a bufferView", f.place("byteOffset"))
        sparse = f.child("sparse") if "sparse" in f else None
        if sparse is not None:
            self._check_sparse(sparse, count, component, size * rows)
            if view is None and count > MAX_ZEROS:
                fail("too_large", f"a sparse accessor without a bufferView may have at most {MAX_ZEROS} elements", f.place("count"))
        return Accessor(f.where, component, kind, count, normalized, view, offset, sparse)

    def _check_sparse(self, f: Fields, count: int, component: int, element: int) -> None:
        changed = f.integer("count", low=1, high=count)
        for key in ("indices", "values"):
            part = f.child(key)
            view = part.required_index("bufferView", len(self._views), "bufferViews")
            if self._views[view].stride:
                fail("bad_stride", "sparse data must be tightly packed, but its bufferView has a byteStride", part.where)
            inner = component if key == "values" else _component(part, (UBYTE, USHORT, UINT))
            size = np.dtype(DTYPES[inner]).itemsize
            self._check_fit(part, view, part.integer("byteOffset", default=0), changed, element if key == "values" else size, size)

    def _check_fit(self, f: Fields, index: int, offset: int, count: int, element: int, size: int) -> None:
        view = self._views[index]
        if view.stride and view.stride < element:
            fail("bad_stride", f"{view.fields.where} has byteStride {view.stride}, less than the {element} bytes of an element", f.where)
        if offset % size or (view.offset + offset) % size or view.stride % size:
            fail("misaligned", f"must begin at a multiple of {size} bytes, in {view.fields.where} and in its buffer", f.place("byteOffset"))
        needed = offset + (view.stride or element) * (count - 1) + element
        length = len(view.data) - view.offset
        if needed > length:
            fail("accessor_out_of_view", f"{count} elements need {needed} bytes, but {view.fields.where} has {length}", f.place("count"))


def _view(f: Fields, buffers: tuple[memoryview, ...]) -> View:
    buffer = f.required_index("buffer", len(buffers), "buffers")
    offset = f.integer("byteOffset", default=0)
    length = f.integer("byteLength", low=1)
    stride = f.integer("byteStride", default=0)
    if "byteStride" in f and (not 4 <= stride <= 252 or stride % 4):
        fail("bad_stride", f"is {stride}, must be a multiple of 4 from 4 to 252", f.place("byteStride"))
    available = len(buffers[buffer])
    if offset + length > available:
        fail("view_out_of_buffer", f"ends at byte {offset + length}, but buffers[{buffer}] has {available}", f.place("byteLength"))
    return View(f, buffers[buffer][: offset + length], offset, stride)


def _component(f: Fields, allowed: tuple[int, ...]) -> int:
    component = f.integer("componentType")
    if component not in allowed:
        names = ", ".join(f"{c} ({COMPONENT_NAMES[c]})" for c in allowed)
        fail("out_of_range", f"is {component}, must be one of {names}", f.place("componentType"))
    return component


def semantic_of(attribute: str) -> str | None:
    """The semantic of an attribute's name without its number (``COLOR_0`` → ``COLOR``), None for one that glTF does not know."""
    stem, _, number = attribute.partition("_")
    if stem in ("POSITION", "NORMAL", "TANGENT"):
        return stem if attribute == stem else None
    return stem if stem in ATTRIBUTES and number.isascii() and number.isdecimal() else None
