"""Bad documents made by our own code: specs and their skies, cameras, thresholds, points, bundles; each with its slug and its place."""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bake_core.images import write_exr
from tests.pictures import png

GRID = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}
SPEC: dict[str, Any] = {"volumes": [GRID], "stop": {"target_error": None, "max_samples": 1}}
SKY = "sky.exr"


@dataclass(frozen=True)
class DocumentFault:
    """One JSON file, or one image that it names, which must be refused.

    Attributes
    ----------
    name : str
        What is wrong with it; unique.
    kind : str
        ``spec``, ``cameras``, ``thresholds`` or ``points``.
    slug : str
    where : str
        The place; {document} stands for what the document is called, {image} for what it calls its image.
    document : bytes
    images : mapping of str to bytes
        Beside the document.
    shape : bool
        Over HTTP the request's own schema refuses it, as ``request.invalid``: it is not even a list where one goes.
    """

    name: str
    kind: str
    slug: str
    where: str
    document: bytes
    images: Mapping[str, bytes] = field(default_factory=dict)
    shape: bool = False

    @property
    def is_json(self) -> bool:
        """Whether it can be part of a request's JSON at all; where not, the request is what is wrong."""
        return not self.slug.endswith(("bad_json", "duplicate_key", "json_too_deep")) and b"NaN" not in self.document


@dataclass(frozen=True)
class BundleFault:
    """What is done to a sound bundle's folder, and how it is refused then; the place is its path."""

    name: str
    slug: str
    damage: Callable[[Path], object]


def documents() -> list[DocumentFault]:
    """Every fault of a document, in a fixed order."""
    return [*_specs(), *_skies(), *_cameras(), *_thresholds(), *_points()]


def _texts(kind: str, area: str, sound: bytes) -> Iterator[DocumentFault]:
    """What any JSON can suffer."""
    twice = b'{"a":1,"a":2}' if sound.startswith(b"{") else b'[{"a":1,"a":2}]'
    for what, slug, text in (
        ("is empty", "bad_json", b""),
        ("is cut off", "bad_json", sound[:-1]),
        ("is not UTF-8", "bad_json", b'["\xff"]'),
        ("is nested 100,000 deep", "json_too_deep", b"[" * 100_000),
        ("names a key twice", "duplicate_key", twice),
        ("holds NaN", "not_finite", b"[NaN]"),
    ):
        yield DocumentFault(f"{kind}: {what}", kind, f"{area}.{slug}", "{document}", text)


def _specs() -> Iterator[DocumentFault]:
    def of(what: str, slug: str, place: str, **changes: Any) -> DocumentFault:
        where = place if slug in ("no_geometry", "unknown_node") else f"{{document}}: {place}" if place else "{document}"
        return DocumentFault(f"spec: {what}", "spec", f"spec.{slug}", where, json.dumps({**SPEC, **changes}).encode())

    yield from _texts("spec", "spec", json.dumps(SPEC).encode())
    yield DocumentFault("spec: is a list", "spec", "spec.invalid", "{document}", b"[]", shape=True)
    yield DocumentFault("spec: has no volumes", "spec", "spec.missing_key", "{document}: volumes", b"{}")
    yield of("version 2", "invalid", "version", version=2)
    yield of("an unknown key", "unknown_key", "volume", volume=[])
    yield of("no volume", "invalid", "volumes", volumes=[])
    yield of("65 volumes", "invalid", "volumes", volumes=[{**GRID, "name": f"n{i}"} for i in range(65)])
    value: Any
    for key, value, slug, place in (
        ("counts", [0, 1, 1], "invalid", "counts[0]"),
        ("counts", [1, 1.5, 1], "invalid", "counts[1]"),
        ("counts", [4096, 4096, 4096], "too_many_probes", ""),
        ("spacing", [1, 1, 0], "invalid", "spacing[2]"),
        ("spacing", [1, -1, 1], "invalid", "spacing[1]"),
        ("spacing", [1, "1", 1], "invalid", "spacing[1]"),
        ("origin", [0, 0], "missing_key", "origin[2]"),
        ("origin", [0, 1e31, 0], "invalid", "origin[1]"),
        ("name", "../up", "invalid", "name"),
        ("name", "", "invalid", "name"),
        ("fit", "room", "invalid", "fit"),
        ("node", "n", "invalid", ""),
        ("spacin", 1, "unknown_key", "spacin"),
    ):
        inside = f"volumes[0].{place}" if place else "volumes[0]"
        yield of(f"a volume's {key} is {value!r}", slug, inside, volumes=[{**GRID, key: value}])
    yield of("two volumes of a name", "invalid", "", volumes=[{**GRID, "name": "a"}] * 2)
    yield of("a volume about a node that is not there", "unknown_node", "volumes[0].node", volumes=[_about("nowhere")])
    for key, value, slug, place in (
        ("environment", {"kind": "cube"}, "invalid", "environment"),
        ("environment", {"kind": "constant", "radiance": [1, -1, 1]}, "invalid", "environment.radiance[1]"),
        ("environment", {"kind": "equirect"}, "missing_key", "environment.image"),
        ("environment", {"kind": "equirect", "image": ""}, "invalid", "environment.image"),
        ("environment", {"kind": "equirect", "image": "a.exr", "scale": -1}, "invalid", "environment.scale"),
        ("environment", {"kind": "equirect", "image": "a.exr", "turn": 1}, "unknown_key", "environment.turn"),
        ("lights", [{"kind": "area"}], "invalid", "lights[0]"),
        ("lights", [{"kind": "point", "position": [0, 0, 0]}], "missing_key", "lights[0].intensity"),
        ("lights", [{"kind": "directional", "direction": [0, 0, 0], "irradiance": [1, 1, 1]}], "invalid", "lights[0].direction"),
        ("lights", [{**_SPOT, "inner_angle": 1.0, "outer_angle": 0.5}], "invalid", "lights[0]"),
        ("outputs", [], "invalid", "outputs"),
        ("outputs", ["albedo"], "invalid", "outputs[0]"),
        ("outputs", ["normal", "normal"], "invalid", ""),
        ("resolution", {"irradiance": 7}, "invalid", "resolution.irradiance"),
        ("resolution", {"distance": 2048}, "invalid", "resolution.distance"),
        ("max_bounces", -1, "invalid", "max_bounces"),
        ("max_bounces", True, "invalid", "max_bounces"),
        ("stop", {"target_error": 0}, "invalid", "stop.target_error"),
        ("stop", {"max_samples": 0}, "invalid", "stop.max_samples"),
        ("stop", {"max_seconds": -1}, "invalid", "stop.max_seconds"),
        ("seed", 1 << 64, "invalid", "seed"),
        ("seed", "0", "invalid", "seed"),
    ):
        yield of(f"{key} is {json.dumps(value)[:70]}", slug, place, **{key: value})


_SPOT = {"kind": "spot", "position": [0, 0, 0], "direction": [0, -1, 0], "intensity": [1, 1, 1]}


def _about(node: str) -> dict[str, Any]:
    return {"fit": "node", "node": node, "counts": [1, 1, 1]}


def exr(pixels: np.ndarray[Any, np.dtype[np.float32]], channels: tuple[str, ...] = ("R", "G", "B")) -> bytes:
    """An EXR's bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / SKY
        write_exr(path, pixels, channels)
        return path.read_bytes()


def _skies() -> Iterator[DocumentFault]:
    def of(what: str, slug: str, where: str, data: bytes | None, **changes: Any) -> DocumentFault:
        environment = {"kind": "equirect", "image": SKY, **changes}
        spec = json.dumps({**SPEC, "environment": environment}).encode()
        return DocumentFault(f"sky: {what}", "spec", f"spec.image_{slug}", where, spec, {} if data is None else {SKY: data})

    grey = np.ones((8, 16, 3), np.float32)
    sound = exr(grey)
    image = "environment.image {image}"
    yield of("is not there", "not_found", "environment.image", None)
    yield of("a digest of nothing", "not_found", "environment.image", None, image="sha256:" + "0" * 64)
    yield of("a name too long for any file", "not_found", "environment.image", None, image="x" * 5000)
    yield of("a name with a NUL", "not_found", "environment.image", None, image="a\0b")
    yield of("a folder", "not_found", "environment.image", None, image=".")
    for number in ("nan", "inf", "-inf"):
        pixels = grey.copy()
        pixels[3, 5, 1] = float(number)
        yield of(f"a texel of {number}", "not_finite", f"{image}: row 3, column 5, G", exr(pixels))
    pixels = grey.copy()
    pixels[7, 15, 2] = -1e-3
    yield of("a negative texel", "negative", f"{image}: row 7, column 15, B", exr(pixels))
    yield of("brighter than float32 by its scale", "not_finite", "environment.scale", exr(grey * np.float32(1e20)), scale=1e30)
    broken = {
        "is empty": b"",
        "is a PNG": png(np.zeros((4, 8, 3), np.uint8)),
        "is a JPEG": b"\xff\xd8\xff\xe0" + bytes(64),
        "is an EXR's magic alone": sound[:4],
        "an EXR cut in its header": sound[:60],
        "an EXR cut in its texels": sound[:-20],
        "an EXR of a header in no encoding": sound.replace(b"box2i", b"box\xff\xfe", 1),
        "an EXR of alpha alone": exr(grey[..., :1], ("A",)),
        "an EXR of 10^12 texels": _resized(sound, 10**6, 10**6),
        "an EXR of more texels than a sky has": _resized(sound, 8192, 4097),
        "an EXR of 2^25 texels, all but 128 of them missing": _resized(sound, 8192, 4096),
        "an EXR of no size": _resized(sound, 0, 0),
        "an EXR of negative size": _resized(sound, -5, -5),
        "a part of a larger EXR": _windowed(sound, "dataWindow", (4, 0, 11, 7)),
        "a Radiance HDR's magic alone": b"#?",
        "a Radiance HDR cut in its texels": _HDR % (8, 16) + bytes([128, 128, 128, 129]) * 100,
        "a Radiance HDR of 10^12 texels": _HDR % (10**6, 10**6),
        "a Radiance HDR of no format": b"#?RADIANCE\n\n-Y 8 +X 16\n" + bytes(512),
    }
    for what, data in broken.items():
        yield of(what, "unreadable", image, data)


_HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n"


def _windowed(data: bytes, window: str, box: tuple[int, int, int, int]) -> bytes:
    """An EXR whose header states another window."""
    at = data.index(f"{window}\0box2i\0".encode()) + len(window) + 7 + 4
    return data[:at] + struct.pack("<4i", *box) + data[at + 16 :]


def _resized(data: bytes, width: int, height: int) -> bytes:
    box = (0, 0, width - 1, height - 1)
    return _windowed(_windowed(data, "dataWindow", box), "displayWindow", box)


def _cameras() -> Iterator[DocumentFault]:
    sound = {"name": "eye", "position": [0, 1, 3], "target": [0, 1, 0]}

    def of(what: str, place: str, document: Any) -> DocumentFault:
        shape = not isinstance(document, list) or len(document) > 64
        text = json.dumps(document).encode()
        return DocumentFault(f"cameras: {what}", "cameras", "camera.invalid", f"{{document}}{place}", text, shape=shape)

    yield from _texts("cameras", "camera", json.dumps([sound]).encode())
    yield of("an object", "", {})
    yield of("none", "", [])
    yield of("65", "", [{**sound, "name": f"c{i}"} for i in range(65)])
    yield of("no position", "[0].position", [{k: v for k, v in sound.items() if k != "position"}])
    for key, value, place in (
        ("name", "../../x", "name"),
        ("name", 1, "name"),
        ("position", [0, 1], "position[2]"),
        ("position", [0, 1e31, 0], "position[1]"),
        ("target", [0, 1, 3], "target"),
        ("yfov", 0, "yfov"),
        ("yfov", 3.2, "yfov"),
        ("fov", 1, "fov"),
    ):
        yield of(f"{key} is {value!r}", f"[0].{place}", [{**sound, key: value}])
    yield of("two of a name", "[1].name", [sound, sound])


def _thresholds() -> Iterator[DocumentFault]:
    def of(what: str, place: str, document: Any) -> DocumentFault:
        text = json.dumps(document).encode()
        return DocumentFault(
            f"thresholds: {what}", "thresholds", "thresholds.invalid", "{document}" + place, text, shape=isinstance(document, list)
        )

    yield from _texts("thresholds", "thresholds", b"{}")
    yield of("a list", "", [])
    yield of("an unknown part", ": direct", {"direct": {}})
    yield of("an unknown limit", ": whole.psnr", {"whole": {"psnr": 30}})
    yield of("a negative limit", ": indirect.relmse", {"indirect": {"relmse": -1}})
    yield of("a limit in words", ": whole.flip", {"whole": {"flip": "low"}})
    yield of("a ratio upside down", ": indirect", {"indirect": {"mean_ratio": [2, 1]}})


def _points() -> Iterator[DocumentFault]:
    sound = {"position": [0, 0, 0], "normal": [0, 1, 0]}

    def of(what: str, place: str, document: Any, slug: str = "invalid") -> DocumentFault:
        where = f"{{document}}{place}" if slug == "invalid" else place
        return DocumentFault(f"points: {what}", "points", f"sample.{slug}", where, json.dumps(document).encode())

    yield from _texts("points", "sample", json.dumps([sound]).encode())
    yield of("an object", "", {})
    yield of("a point that is a number", ": [0].position", [1])
    yield of("no normal", ": [0].normal", [{"position": [0, 0, 0]}])
    yield of("a position of two", ": [1].position", [sound, {**sound, "position": [0, 0]}])
    yield of("a coordinate in words", ": [0].position", [{**sound, "position": [0, "1", 0]}])
    yield of("a normal of length 0", "point 1", [sound, {**sound, "normal": [0, 0, 0]}], "zero_normal")
    yield of("none", "--at", [], "usage")


def bundles() -> list[BundleFault]:
    """Every fault of a bundle: what is done to the folder of a sound one."""

    def edit(change: Callable[[Any], None]) -> Callable[[Path], None]:
        def damage(folder: Path) -> None:
            path = folder / "manifest.json"
            manifest = json.loads(path.read_text())
            change(manifest)
            path.write_text(json.dumps(manifest))

        return damage

    def flip(name: str) -> Callable[[Path], None]:
        def damage(folder: Path) -> None:
            data = bytearray((folder / name).read_bytes())
            data[len(data) // 2] ^= 1
            (folder / name).write_bytes(data)

        return damage

    def outside(manifest: Any) -> None:
        manifest["files"]["../up.exr"] = next(iter(manifest["files"].values()))

    image = "v0.irradiance.exr"
    return [
        BundleFault("bundle: no manifest", "bundle.not_a_bundle", lambda f: (f / "manifest.json").unlink()),
        BundleFault("bundle: another format", "bundle.not_a_bundle", edit(lambda m: m.update(format="other"))),
        BundleFault("bundle: a newer version", "bundle.version", edit(lambda m: m.update(version=99))),
        BundleFault("bundle: a flipped bit in an atlas", "bundle.damaged", flip(image)),
        BundleFault("bundle: a flipped bit in a shader", "bundle.damaged", flip("shaders/grid.glsl")),
        BundleFault("bundle: an atlas is missing", "bundle.damaged", lambda f: (f / image).unlink()),
        BundleFault("bundle: an atlas cut off", "bundle.damaged", lambda f: (f / image).write_bytes((f / image).read_bytes()[:100])),
        BundleFault("bundle: a file outside itself", "bundle.damaged", edit(outside)),
        BundleFault("bundle: no volumes in its manifest", "bundle.damaged", edit(lambda m: m.pop("volumes"))),
        BundleFault("bundle: files is a list", "bundle.damaged", edit(lambda m: m.update(files=[]))),
        BundleFault("bundle: counts of other probes", "bundle.damaged", edit(lambda m: m["volumes"][0].update(counts=[9, 9, 9]))),
        BundleFault("bundle: tiles of another size", "bundle.damaged", edit(lambda m: m["volumes"][0]["atlases"][0].update(tile=99))),
    ]
