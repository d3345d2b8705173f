"""What a URI in a glTF may name: a ``data:`` URI, or a file in or below the scene's folder. Nothing else is ever opened."""

from __future__ import annotations

import base64
import binascii
import os
import re
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from urllib.parse import unquote_to_bytes

from bake_core.gltf.fields import fail, quoted

# (name relative to the scene's folder, place that names it) -> the file to read
Opener = Callable[[str, str], Path]

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


def is_data(uri: str) -> bool:
    return uri[:5].lower() == "data:"


def decode_data(uri: str, where: str) -> bytes:
    """The bytes of a base64 ``data:`` URI (RFC 2397).

    Raises
    ------
    SceneError
        ``gltf.bad_data_uri``.
    """
    header, comma, payload = uri.partition(",")
    if not comma or not header.lower().endswith(";base64"):
        fail("bad_data_uri", "a data: URI must be data:TYPE;base64,DATA", where)
    try:
        return base64.b64decode(unquote_to_bytes(payload) if "%" in payload else payload, validate=True)
    except (binascii.Error, ValueError):
        fail("bad_data_uri", "its base64 data cannot be decoded", where)


def safe_name(uri: str, where: str) -> str:
    """A relative URI as a name below the scene's folder, percent-decoded exactly once.

    Raises
    ------
    SceneError
        ``gltf.unsafe_uri`` for schemes, drives, absolute paths, backslashes, control characters and ``..``.
    """
    try:
        name = unquote_to_bytes(uri).decode("utf-8")
    except UnicodeError:
        fail("unsafe_uri", f"{quoted(uri)} is not UTF-8 once percent-decoded", where)
    if _SCHEME.match(uri) or _SCHEME.match(name):
        fail("unsafe_uri", f"{quoted(uri)} has a scheme or a drive; only data: URIs and files beside the scene are read", where)
    if name.startswith("/") or "\\" in name or _CONTROL.search(name):
        fail("unsafe_uri", f"{quoted(uri)} must be a relative path with forward slashes", where)
    parts = [p for p in name.split("/") if p not in ("", ".")]
    if not parts or ".." in parts:
        fail("unsafe_uri", f"{quoted(uri)} must name a file in the scene's folder or below it, without '..'", where)
    return "/".join(parts)


def folder_opener(folder: Path) -> Opener:
    """Files in `folder` or below; a symbolic link may not lead out of it."""
    top = os.path.realpath(folder)

    def open_name(name: str, where: str) -> Path:
        try:
            real = os.path.realpath(os.path.join(top, name))
        except (OSError, ValueError) as e:
            fail("missing_file", f"{quoted(name)} cannot be looked up: {e}", where)
        if os.path.commonpath([top, real]) != top:
            fail("unsafe_uri", f"{quoted(name)} is a link that leaves the scene's folder", where)
        return Path(real)

    return open_name


def upload_opener(root: str, files: Mapping[str, Path]) -> Opener:
    """Files of an upload: names beside `root`, which is itself a name in `files`."""
    folder = root.rpartition("/")[0]

    def open_name(name: str, where: str) -> Path:
        path = files.get(f"{folder}/{name}" if folder else name)
        return path if path is not None else fail("missing_file", f"{quoted(name)} is not among the files sent with the scene", where)

    return open_name


def read_file(path: Path, name: str, where: str) -> bytes:
    """All bytes of a regular file.

    Raises
    ------
    SceneError
        ``gltf.missing_file`` for what is absent, unreadable, or not a file (reading a pipe or a device might never end).
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            fail("missing_file", f"{quoted(name)} is not a regular file", where)
        return path.read_bytes()
    except (OSError, ValueError) as e:
        reason = e.strerror if isinstance(e, OSError) and e.strerror else "not a file name"
        fail("missing_file", f"{quoted(name)} cannot be read: {reason}", where)
