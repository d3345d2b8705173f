"""Local files: their digests, and which ones belong to a glTF."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from urllib.parse import unquote


def file_digest(path: Path) -> str:
    """``sha256:HEX`` of a file."""
    with open(path, "rb") as f:
        return "sha256:" + hashlib.file_digest(f, "sha256").hexdigest()


def scene_files(path: Path) -> dict[str, Path]:
    """The files of a scene, by the names that the service knows them by; the scene's own file is among them.

    Only files in the scene's folder or below are ever sent. What is missing, or named in another way, is left out, and the service says
    so with the place that names it.
    """
    found = {path.name: path}
    if path.suffix.lower() == ".gltf":
        top = path.parent.resolve()
        for uri in _uris(path):
            name = unquote(uri)
            parts = [p for p in name.split("/") if p not in ("", ".")]
            beside = path.parent.joinpath(*parts) if parts else path
            if ":" not in name and beside.is_file() and beside.resolve().is_relative_to(top):
                found["/".join(parts)] = beside
    return found


def _uris(path: Path) -> list[str]:
    try:
        document = json.loads(path.read_bytes())
        entries = [*document.get("buffers", []), *document.get("images", [])]
        return [e["uri"] for e in entries if isinstance(e.get("uri"), str)]
    except (ValueError, AttributeError, TypeError, RecursionError):
        # Not a glTF: the service's reader will say in what way.
        return []
