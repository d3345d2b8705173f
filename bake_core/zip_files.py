"""A zip of a scene's folder: unpacked with its promises checked, never trusted."""

from __future__ import annotations

import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from bake_core.errors import SceneError

# Of a zip, and of one with nothing in it.
MAGICS = (b"PK\x03\x04", b"PK\x05\x06")
MAX_ENTRIES = 4096
MAX_BYTES = 1 << 33
# Deflate cannot do better than 1032 : 1, and real scenes stay below 20 : 1.
MAX_RATIO = 200
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ROOTS = (".gltf", ".glb")
_BLOCK = 1 << 20


def is_zip(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(4) in MAGICS
    except OSError:
        return False


def unpack(path: Path, folder: Path, name: str | None = None) -> tuple[str, dict[str, Path]]:
    """Unpack a zip with one .gltf or .glb in it.

    Parameters
    ----------
    folder : Path
        Empty; files get plain numbers for names there, whatever the zip calls them.
    name : str, optional
        What messages call the zip.

    Returns
    -------
    root : str
        Name of the scene in the zip.
    files : dict of str to Path
        Name in the zip to the file in `folder`: what :func:`bake_core.gltf.reader.load_scene_files` reads.

    Raises
    ------
    SceneError
        ``scene.bad_zip``, ``scene.unsafe_zip``, ``scene.zip_too_large``, ``scene.no_root``.
    """
    name = name or path.name
    try:
        with zipfile.ZipFile(path) as archive:
            # Not is_dir(), which looks at the last character of a name that may have none.
            entries = [e for e in archive.infolist() if not e.filename.endswith("/")]
            _check(entries, path.stat().st_size, name)
            roots = [e.filename for e in entries if PurePosixPath(e.filename).suffix.lower() in _ROOTS and not _is_metadata(e.filename)]
            if len(roots) != 1:
                found = "none" if not roots else ", ".join(sorted(roots)[:4])
                raise SceneError("scene.no_root", f"must hold exactly one .gltf or .glb, holds {found}", name)
            return roots[0], {e.filename: _extract(archive, e, folder / str(i), name) for i, e in enumerate(entries)}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, UnicodeError, ValueError) as e:
        raise SceneError("scene.bad_zip", f"cannot be unpacked: {e}; pack it again", name) from None


def _check(entries: list[zipfile.ZipInfo], packed: int, name: str) -> None:
    if len(entries) > MAX_ENTRIES:
        raise SceneError("scene.zip_too_large", f"holds {len(entries)} files, more than {MAX_ENTRIES}", name)
    total = sum(e.file_size for e in entries)
    if total > MAX_BYTES:
        raise SceneError("scene.zip_too_large", f"unpacks to {total} bytes, more than {MAX_BYTES} (2^33)", name)
    if total > MAX_RATIO * max(packed, 4096):
        raise SceneError("scene.zip_too_large", f"unpacks to {total} bytes from {packed}: more than {MAX_RATIO} times its size", name)
    seen: set[str] = set()
    for e in entries:
        place = f"{name}: {e.filename[:80]!r}"
        parts = e.filename.split("/")
        # zipfile cuts names at a NUL, and turns the backslashes of other systems into slashes there.
        odd = "\\" in e.orig_filename or any(ord(c) < 32 or ord(c) == 127 for c in e.orig_filename) or ":" in parts[0]
        if odd or e.filename.startswith("/") or any(p in ("", ".", "..") for p in parts):
            raise SceneError("scene.unsafe_zip", "must be a relative path with forward slashes and without '..'", place)
        mode = e.external_attr >> 16
        if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
            raise SceneError("scene.unsafe_zip", "is a link or a device; only plain files are read", place)
        if not 0 <= e.header_offset < packed:
            raise SceneError("scene.bad_zip", "is not where the zip's directory says; pack it again", place)
        if e.filename in seen:
            raise SceneError("scene.bad_zip", "occurs twice", place)
        seen.add(e.filename)
        if e.flag_bits & 1:
            raise SceneError("scene.bad_zip", "is encrypted", place)
        if e.compress_type not in _METHODS:
            raise SceneError("scene.bad_zip", f"uses compression method {e.compress_type}; only stored and deflated files are read", place)


def _extract(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, to: Path, name: str) -> Path:
    """One file, no further than the size it claims; zipfile checks its CRC."""
    left = entry.file_size
    with archive.open(entry) as source, to.open("xb") as out:
        while block := source.read(_BLOCK):
            left -= len(block)
            if left < 0:
                raise SceneError("scene.bad_zip", "is longer than it says", f"{name}: {entry.filename[:80]!r}")
            out.write(block)
    return to


def _is_metadata(name: str) -> bool:
    """What a Mac adds to every file it zips."""
    return name.startswith("__MACOSX/") or PurePosixPath(name).name.startswith("._")
