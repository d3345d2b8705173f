"""A glTF from its files: GLB chunks or JSON, its buffers, its digest, and whether its version and extensions can be read."""

from __future__ import annotations

import hashlib
import json
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from bake_core import strict_json
from bake_core.errors import SceneError
from bake_core.gltf import extensions, names
from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.gltf.names import Opener

MAGIC = b"glTF"
JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942


@dataclass(frozen=True)
class Document:
    """A glTF whose bytes are all here, and whose version and required extensions are ones that can be read.

    Attributes
    ----------
    root : Fields
        The JSON document.
    buffers : tuple of bytes
        Cut to their declared byteLength.
    resources : Resources
        The files of the scene, of which the buffers' are read already.
    notes : Notes
        What was read over so far.
    """

    root: Fields
    buffers: tuple[memoryview, ...]
    resources: Resources
    notes: Notes


class Resources:
    """The bytes behind URIs: ``data:`` or files, each read once; it knows which files the scene uses.

    Parameters
    ----------
    root : str
        Name of the .glb or .gltf.
    data : bytes
        What it holds.
    opener : Opener
    """

    def __init__(self, root: str, data: bytes, opener: Opener) -> None:
        self._root = root
        self._opener = opener
        self._digests = {root: _sha256(data)}
        self._read: dict[str, bytes] = {}

    def get(self, uri: str, place: str) -> bytes:
        """What a URI stands for.

        Raises
        ------
        SceneError
            ``gltf.bad_data_uri``, ``gltf.unsafe_uri``, ``gltf.missing_file``.
        """
        if names.is_data(uri):
            return names.decode_data(uri, place)
        name = names.safe_name(uri, place)
        if name not in self._read:
            self._read[name] = names.read_file(self._opener(name, place), name, place)
            self._digests[name] = _sha256(self._read[name])
        return self._read[name]

    def digest(self) -> str:
        """``sha256:HEX`` of the scene by the files read so far, see :func:`scene_digest`."""
        return scene_digest(self._root, self._digests)


def open_path(path: Path) -> Document:
    """A scene from the file system."""
    return _open(path.name, path, names.folder_opener(path.parent))


def open_upload(root: str, files: Mapping[str, Path]) -> Document:
    """A scene from uploaded files, by name; nothing but `files` is read."""
    if root not in files:
        fail("missing_file", f"{quoted(root)} is not among the files sent with the scene", "root")
    return _open(root.rpartition("/")[2], files[root], names.upload_opener(root, files))


def scene_digest(root: str, files: Mapping[str, str]) -> str:
    """Digest of a scene by the digests of the files it uses.

    Parameters
    ----------
    root : str
        Name of the .glb or .gltf, without its folder.
    files : mapping of str to str
        Name, relative to the scene's folder, to ``sha256:HEX``; `root` included.

    Returns
    -------
    str
        A scene of one file has that file's digest; else sha256 over ``{"files":{NAME:DIGEST,...},"root":NAME}`` with sorted keys,
        no spaces and non-ASCII characters escaped.
    """
    if len(files) == 1:
        return files[root]
    return _sha256(json.dumps({"files": dict(files), "root": root}, sort_keys=True, separators=(",", ":")).encode())


def _sha256(data: bytes) -> str:
    return "sha256:" + hashlib.sha256(data).hexdigest()


def _open(name: str, path: Path, opener: Opener) -> Document:
    data = names.read_file(path, name, name)
    notes = Notes()
    if data.startswith(MAGIC) or not name.lower().endswith(".gltf"):
        text, binary = _chunks(data, name, notes)
    else:
        text, binary = data, None
    root = Fields(strict_json.parse(text, SceneError, "gltf", name), name).at("")
    _check_version(root)
    extensions.check_required(root, notes)
    for image in root.children("images"):
        if "uri" in image and not names.is_data(image.text("uri")):
            names.safe_name(image.text("uri"), image.place("uri"))
    resources = Resources(name, data, opener)
    return Document(root, _buffers(root, binary, resources, notes), resources, notes)


def _chunks(data: bytes, name: str, notes: Notes) -> tuple[bytes, memoryview | None]:
    """The JSON chunk and, where there is one, the binary chunk of a GLB (glTF 2.0, chapter 4)."""
    if len(data) < 4 or data[:4] != MAGIC:
        fail(
            "bad_magic",
            "is not a GLB file (it does not begin with 'glTF'); other scenes are told by their names: .gltf, .zip, .obj, .ply, .stl",
            name,
        )
    if len(data) < 20:
        fail("truncated", f"ends after {len(data)} bytes, inside the GLB header", name)
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        fail("bad_version", f"is GLB version {version}; only version 2 can be read", name)
    if length > len(data):
        fail("truncated", f"says it has {length} bytes, but has only {len(data)}; copy it again", name)
    if length < len(data):
        fail("bad_length", f"says it has {length} bytes, but has {len(data)}", name)
    view = memoryview(data)
    text, binary = b"", None
    position, number = 12, 0
    while position < length:
        where = f"{name}: chunk {number}"
        if length - position < 8:
            fail("truncated", "the file ends inside the chunk's header", where)
        size, kind = struct.unpack_from("<II", data, position)
        position += 8
        if size > length - position:
            fail("truncated", f"says it has {size} bytes, but the file ends after {length - position}", where)
        if size % 4:
            fail("bad_chunk", f"has {size} bytes; chunks are multiples of 4", where)
        if (kind == JSON_CHUNK) != (number == 0):
            fail("bad_chunk", "the JSON chunk must be the first, and the only one", where)
        if kind == JSON_CHUNK:
            text = bytes(view[position : position + size])
        elif kind == BIN_CHUNK:
            if number != 1:
                fail("bad_chunk", "the BIN chunk must be the second", where)
            binary = view[position : position + size]
        else:
            notes.add(f"a GLB chunk of unknown type 0x{kind:08X}", where)
        position += size
        number += 1
    return text, binary


def _check_version(root: Fields) -> None:
    if "asset" not in root:
        fail("missing_key", "is required: a glTF says its version here", "asset")
    asset = root.child("asset")
    version = asset.text("version")
    needed = asset.text("minVersion", version)
    for key, value in (("version", version), ("minVersion", needed)):
        if not re.fullmatch(r"[0-9]{1,9}\.[0-9]{1,9}", value):
            fail("bad_version", f"is {quoted(value)}, must look like '2.0'", asset.place(key))
    if not version.startswith("2."):
        fail("bad_version", f"is {quoted(version)}; only glTF 2 can be read", asset.place("version"))
    if "minVersion" in asset and needed != "2.0":
        fail("bad_version", f"the file asks for a reader of glTF {needed}; this one reads 2.0", asset.place("minVersion"))


def _buffers(root: Fields, binary: memoryview | None, resources: Resources, notes: Notes) -> tuple[memoryview, ...]:
    """Every buffer's bytes."""
    buffers = []
    fields = root.children("buffers")
    if binary is not None and (not fields or "uri" in fields[0]):
        notes.add("a BIN chunk that no buffer uses", "chunk 1")
    for i, buffer in enumerate(fields):
        length = buffer.integer("byteLength", low=1)
        place = buffer.place("uri")
        if "uri" not in buffer:
            if i > 0:
                fail("missing_key", "is required: only the first buffer of a GLB may go without", place)
            data = binary if binary is not None else fail("missing_bin", "has no uri, and the file has no BIN chunk", buffer.where)
        else:
            data = memoryview(resources.get(buffer.text("uri"), place))
        if len(data) < length:
            fail("buffer_too_short", f"is {length}, but there are only {len(data)} bytes", buffer.place("byteLength"))
        buffers.append(data[:length])
    return tuple(buffers)
