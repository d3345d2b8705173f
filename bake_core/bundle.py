"""The bundle: what a bake hands over. docs/bundle.md describes it for a stranger who writes a reader."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import tempfile
import zipfile
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core import strict_json
from bake_core.atlas import Layout, unpack
from bake_core.errors import BundleError
from bake_core.images import read_exr

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Atlas:
    """One output of one volume: a tile for each probe that is kept, packed in layers.

    Tile t lies in layer ``t // (columns * rows)``, row ``t % (columns * rows) // columns``, column ``t % columns``.

    Attributes
    ----------
    output : str
        ``irradiance``, ``visibility``, ``walls``, ``radiance``, ``distance`` or ``normal``.
    texels : (layers, rows * tile, columns * tile, channels) float32
    tile, interior : int
        Texels along a tile's side with its border (interior + 2) and without.
    columns, rows, layers : int
    encoding : str
        ``half`` or ``float``: how the file stores it.
    miss : float
        Of distances: what stands for no surface, metres.
    """

    output: str
    texels: F32
    tile: int
    interior: int
    columns: int
    rows: int
    layers: int
    encoding: str
    miss: float = math.inf


@dataclass(frozen=True)
class VolumeData:
    """One volume's probes and atlases.

    Attributes
    ----------
    name : str
    origin, spacing : (3,) float64
        Metres, world.
    counts : (3,) int64
    states : (n,) uint8
        1 active; 0 inside geometry, 2 needed by no surface: no tile, weight 0 in every query.
    offsets : (n, 3) float32
        Metres from the lattice point to where the probe stands.
    backface : (n,) float32
        Fraction of a probe's sphere that sees back faces.
    parameters : dict of str to float
        What the query shader reads: biases, floor.
    distance_limit : float
        Metres; distances are clamped to it (1.5 × cell diagonal).
    atlases : dict of str to Atlas
    """

    name: str
    origin: F64
    spacing: F64
    counts: NDArray[np.int64]
    states: NDArray[np.uint8]
    offsets: F32
    backface: F32
    parameters: dict[str, float]
    distance_limit: float
    atlases: dict[str, Atlas]

    @property
    def tiles(self) -> NDArray[np.int64]:
        """(n,) int64: each probe's tile in all atlases, -1 for one that has none. Tiles follow flat order."""
        kept = self.states == 1
        return np.where(kept, np.cumsum(kept) - 1, -1)

    def maps(self, output: str) -> F32:
        """Its active probes' maps, in flat order and without borders, (k, t, t, channels) float32."""
        a = self.atlases[output]
        return unpack(a.texels, Layout(a.columns, a.rows, a.layers), int((self.states == 1).sum()))

    def positions(self) -> F64:
        """Where the probes stand, offsets included: (n, 3) float64, world, in flat order."""
        lattice = np.stack(np.unravel_index(np.arange(len(self.states)), tuple(self.counts[::-1]))[::-1], -1)
        out: F64 = self.origin + self.spacing * lattice + self.offsets
        return out


@dataclass(frozen=True)
class Bundle:
    """A bundle in memory. `path` is where it was read from."""

    manifest: dict[str, Any]
    volumes: tuple[VolumeData, ...]
    path: Path


FORMAT = "octobake-bundle"
VERSION = 2
MANIFEST = "manifest.json"
# EXR keeps channels in alphabetical order, R, G, B, A aside; these are in that order.
CHANNELS = {
    "irradiance": ("R", "G", "B"),
    "visibility": ("mean", "square"),
    "walls": ("inverse",),
    "radiance": ("R", "G", "B"),
    "distance": ("distance",),
    "normal": ("x", "y", "z"),
    "probes": ("R", "G", "B", "A"),
}
SHADERS = ("octahedral.glsl", "grid.glsl", "irradiance.glsl", "trace.glsl")
# ZIP cannot say earlier; every entry carries it, so that the same bundle is the same bytes.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)


def is_zip(path: Path) -> bool:
    """Whether a bundle of that name is a zip file rather than a folder."""
    return path.suffix.lower() == ".zip"


def check_replaceable(out: Path) -> None:
    """Refuse to write where something stands that is no bundle.

    Raises
    ------
    BundleError
        ``bundle.in_the_way``, ``bundle.no_folder``.
    """
    if not out.parent.is_dir():
        raise BundleError("bundle.no_folder", "the folder that it should go into does not exist; create it", str(out))
    if not out.exists():
        return
    if is_zip(out) and out.is_file():
        with suppress(BundleError):
            _open_zip(out).close()
            return
    elif out.is_dir() and not is_zip(out) and (not any(out.iterdir()) or _names_format(out / MANIFEST)):
        return
    raise BundleError("bundle.in_the_way", "exists and is not a bundle; give another name or remove it", str(out))


def _names_format(manifest: Path) -> bool:
    try:
        return _is_ours(manifest.read_bytes())
    except OSError:
        return False


def _is_ours(manifest: bytes) -> bool:
    try:
        document = strict_json.parse(manifest, BundleError, "bundle", MANIFEST)
    except BundleError:
        return False
    return isinstance(document, dict) and document.get("format") == FORMAT


def _open_zip(path: Path) -> zipfile.ZipFile:
    try:
        archive = zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile) as e:
        raise BundleError("bundle.unreadable", f"cannot be read as a zip file: {e}", str(path)) from None
    with suppress(KeyError, zipfile.BadZipFile, zlib.error, OSError):
        if _is_ours(archive.read(MANIFEST)):
            return archive
    archive.close()
    raise BundleError("bundle.not_a_bundle", f"has no {MANIFEST} of format {FORMAT}", str(path))


def dump_json(document: Any) -> bytes:
    """JSON as every file of a bundle has it: keys in the order given, two spaces, no NaN."""
    return (json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n").encode()


def digest_file(path: Path) -> str:
    """``sha256:HEX`` of a file's bytes."""
    with path.open("rb") as f:
        return "sha256:" + hashlib.file_digest(f, "sha256").hexdigest()


def content_digest(manifest: bytes) -> str:
    """A bundle's identity: the digest of its manifest, which names the digest of every other file but the report."""
    return "sha256:" + hashlib.sha256(manifest).hexdigest()


def publish(folder: Path, out: Path) -> None:
    """Put a finished folder of files under its final name, as a folder or as a zip, all or nothing.

    Parameters
    ----------
    folder : Path
        On the same file system as `out`; it is gone afterwards.
    out : Path
        A bundle that stands there is replaced.
    """
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    if is_zip(out):
        packed = folder.with_name(folder.name + ".zip")
        try:
            with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
                # The manifest first: a reader of a stream learns what follows.
                for path in sorted(files, key=lambda p: (p.name != MANIFEST, p.as_posix())):
                    entry = zipfile.ZipInfo(path.relative_to(folder).as_posix(), _ZIP_DATE)
                    entry.external_attr = 0o644 << 16
                    with path.open("rb") as source, archive.open(entry, "w", force_zip64=True) as target:
                        shutil.copyfileobj(source, target, 1 << 20)
            _sync(packed)
            packed.replace(out)
        finally:
            packed.unlink(missing_ok=True)
        shutil.rmtree(folder)
    else:
        for path in [*files, *(p for p in folder.rglob("*") if p.is_dir()), folder]:
            _sync(path)
        if out.exists():
            # A folder cannot replace one that has files in it: move the old one out of the way first.
            old = folder.with_name(folder.name + ".old")
            out.replace(old)
            try:
                folder.replace(out)
            except BaseException:  # Ctrl-C as well
                old.replace(out)
                raise
            shutil.rmtree(old)
        else:
            folder.replace(out)
    _sync(out.parent)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_bundle(path: str | Path) -> Bundle:
    """Read a bundle from a folder or a zip; every file is held against its digest.

    Raises
    ------
    BundleError
        ``bundle.unreadable``, ``bundle.not_a_bundle``, ``bundle.version``, ``bundle.damaged``.
    """
    path = Path(path)
    if path.is_dir():
        if not (path / MANIFEST).is_file():
            raise BundleError("bundle.not_a_bundle", f"has no {MANIFEST}", str(path))
        return _read_folder(path, path)
    if not path.is_file():
        raise BundleError("bundle.unreadable", "does not exist", str(path))
    with _open_zip(path) as archive, tempfile.TemporaryDirectory(prefix="octobake-") as folder:
        names = json.loads(archive.read(MANIFEST)).get("files")
        try:
            # What else is wrong with it, reading the folder tells.
            for name in [MANIFEST, *(names if isinstance(names, dict) else ())]:
                target = _inside(Path(folder), name, path)
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(name) as source, target.open("wb") as copy:
                    shutil.copyfileobj(source, copy, 1 << 20)
        except (KeyError, zipfile.BadZipFile, EOFError, zlib.error, OSError) as e:
            raise BundleError("bundle.damaged", f"a file in it cannot be read: {e}", str(path)) from None
        return _read_folder(Path(folder), path)


def read_report(path: str | Path) -> dict[str, Any] | None:
    """A bundle's ``report.json``; None where somebody has left it out."""
    path = Path(path)
    try:
        if path.is_dir():
            text = (path / "report.json").read_bytes()
        else:
            with _open_zip(path) as archive:
                text = archive.read("report.json")
    except (OSError, KeyError):
        return None
    report: dict[str, Any] = strict_json.parse(text, BundleError, "bundle", f"{path}: report.json")
    return report


def _inside(folder: Path, name: str, path: Path) -> Path:
    if not isinstance(name, str) or name.startswith("/") or ".." in Path(name).parts:
        raise BundleError("bundle.damaged", f"names a file outside itself: {name!r}", str(path))
    return folder / name


def _read_folder(folder: Path, path: Path) -> Bundle:
    manifest = strict_json.parse((folder / MANIFEST).read_bytes(), BundleError, "bundle", f"{path}: {MANIFEST}")
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise BundleError("bundle.not_a_bundle", f"its {MANIFEST} is not of format {FORMAT}", str(path))
    if manifest.get("version") != VERSION:
        raise BundleError("bundle.version", f"is of version {manifest.get('version')}; this octobake reads {VERSION}", str(path))
    try:
        for name, entry in manifest["files"].items():
            file = _inside(folder, name, path)
            if not file.is_file() or digest_file(file) != entry["sha256"]:
                raise BundleError("bundle.damaged", f"{name} is missing or not what the manifest says; fetch or bake it again", str(path))
        return Bundle(manifest, tuple(_read_volume(folder, v, manifest["files"]) for v in manifest["volumes"]), path)
    except (AttributeError, KeyError, TypeError, ValueError) as e:
        raise BundleError("bundle.damaged", f"its manifest lacks or misstates {e}", str(path)) from None


def _read_volume(folder: Path, v: dict[str, Any], files: dict[str, Any]) -> VolumeData:
    n = int(np.prod(v["counts"]))
    packing = v["layout"]
    backface = np.asarray(v["probes"]["backface"], np.float32)
    if len(v["counts"]) != 3 or backface.shape != (n,) or len(v["probes"]["states"]) != n:
        raise ValueError(f"volume {v['name']!r}: its counts are not those of its probes")
    atlases = {}
    for file in (v["probes"]["file"], *(a["file"] for a in v["atlases"] if a["file"] is not None)):
        if file not in files:
            raise ValueError(f"the digest of {file!r}")
    for a in v["atlases"]:
        size = (packing["layers"], packing["rows"] * a["tile"], packing["columns"] * a["tile"], len(CHANNELS[a["output"]]))
        if a["file"] is None:
            texels = np.broadcast_to(np.asarray(a["constant"], np.float32), size)
        else:
            pixels, _ = read_exr(folder / a["file"], BundleError, "bundle.damaged")
            # One channel may stand for several.
            names = list(dict.fromkeys(a["channels"]))
            texels = np.ascontiguousarray(pixels[..., [names.index(name) for name in a["channels"]]]).reshape(size)
        shape = (packing["columns"], packing["rows"], packing["layers"])
        atlases[a["output"]] = Atlas(a["output"], texels, a["tile"], a["interior"], *shape, a["encoding"], a.get("miss", math.inf))
    probes, _ = read_exr(folder / v["probes"]["file"], BundleError, "bundle.damaged")
    probes = probes.reshape(-1, 4)[:n]
    volume = VolumeData(
        name=v["name"],
        origin=np.asarray(v["origin"], np.float64),
        spacing=np.asarray(v["spacing"], np.float64),
        counts=np.asarray(v["counts"], np.int64),
        states=np.asarray(v["probes"]["states"], np.uint8),
        offsets=np.ascontiguousarray(probes[:, :3]),
        backface=backface,
        parameters=v["parameters"],
        distance_limit=float(v["distance_limit"]),
        atlases=atlases,
    )
    if not np.array_equal(volume.tiles, probes[:, 3].astype(np.int64) - 1):
        raise ValueError(f"volume {v['name']!r}: its states are not those of its probe table")
    return volume
