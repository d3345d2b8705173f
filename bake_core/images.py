"""The one module that touches OpenImageIO: EXR files out and in, PNG out, PNG and JPEG and Radiance HDR in."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from bake_core.drawing import Drawing, lines_as_pixels
from bake_core.errors import BakeError, InputError

F32 = NDArray[np.float32]

# What a picture's first bytes say it is, and the suffix by which OpenImageIO knows the format.
_PICTURES = {b"\x89PNG\r\n\x1a\n": ".png", b"\xff\xd8\xff": ".jpg"}

_RADIANCES = {b"\x76\x2f\x31\x01": ".exr", b"#?": ".hdr"}
# An 8192 × 4096 sky: 400 MB as float32 RGB.
_MAX_RADIANCE_TEXELS = 1 << 25

# One of those in OpenImageIO's wheel; it has ±, but neither a minus sign of its own nor superscripts.
_FONT = "DroidSans"
# EXR files carry a date; a fixed one keeps them the same bytes for the same texels.
_DATE = "2000:01:01 00:00:00"


def write_exr(path: Path, pixels: F32, channels: Sequence[str], *, half: bool = False) -> None:
    """Write a scan-line EXR with ZIP compression; the same bytes for the same pixels.

    Parameters
    ----------
    path : Path
    pixels : (height, width, len(channels)) float32
        Row 0 is stored first. All finite.
    channels : sequence of str
        Names; EXR keeps channels in alphabetical order, apart from R, G, B, A, so give them in that order.
    half : bool
        Store 16-bit floats.
    """
    height, width, depth = pixels.shape
    spec = oiio.ImageSpec(width, height, depth, "half" if half else "float")
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", _DATE)
    spec.attribute("Software", "octobake")
    if tuple(channels) == ("R", "G", "B"):
        spec.attribute("oiio:ColorSpace", "lin_rec709")
    _write(path, pixels, spec)


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write an 8-bit RGB PNG, (height, width, 3)."""
    height, width, depth = pixels.shape
    _write(path, pixels, oiio.ImageSpec(width, height, depth, "uint8"))


def write_drawing(path: Path, drawing: Drawing) -> None:
    """Write a drawing as an 8-bit PNG, its words in the sans-serif that OpenImageIO brings along."""
    image = oiio.ImageBuf(np.ascontiguousarray(lines_as_pixels(drawing), np.float32))
    for t in drawing.texts:
        x, y = (round(a) for a in t.place)
        box = oiio.ImageBufAlgo.text_size(t.words, round(t.size), _FONT)
        x -= {"start": 0, "middle": (box.xend - box.xbegin) // 2, "end": box.xend - box.xbegin}[t.anchor]
        if not oiio.ImageBufAlgo.render_text(image, x, y, t.words, round(t.size), _FONT, tuple(c / 255 for c in t.colour)):
            raise BakeError("bake.cannot_write", image.geterror() or "has words that cannot be drawn", str(path))
    write_png(path, np.rint(255 * np.asarray(image.get_pixels(oiio.FLOAT))).astype(np.uint8))


def _write(path: Path, pixels: NDArray[np.generic], spec: oiio.ImageSpec) -> None:
    out = oiio.ImageOutput.create(str(path))
    if out is None or not out.open(str(path), spec):
        raise BakeError("bake.cannot_write", (_complaint(out) if out else _complaint(oiio)) or "cannot be written", str(path))
    written = out.write_image(np.ascontiguousarray(pixels))
    if not (out.close() and written):
        raise BakeError("bake.cannot_write", _complaint(out) or "cannot be written; is the disk full?", str(path))


def read_exr(path: Path, error: type[InputError], slug: str) -> tuple[F32, bool]:
    """Read an EXR.

    Returns
    -------
    pixels : (height, width, channels) float32
    half : bool
        Whether the file stores 16-bit floats.

    Raises
    ------
    InputError
        `error` with `slug` where the file is missing or broken.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise error(slug, _complaint(oiio) or "cannot be read", path.name)
    spec = source.spec()
    pixels = source.read_image("float")
    half = spec.format == oiio.HALF
    complaint = _complaint(source)
    source.close()
    if pixels is None:
        raise error(slug, complaint or "cannot be read", path.name)
    return np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels), half


def read_radiance(path: Path, error: type[InputError], slug: str, where: str) -> F32:
    """Read an EXR or Radiance HDR, whatever its name, as linear RGB.

    Returns
    -------
    pixels : (height, width, 3) float32
        As stored, NaN and infinity too; a single luminance channel is spread over RGB, alpha and depth are left out.

    Raises
    ------
    InputError
        `error` with `slug` where it is neither, is broken, too large, or has no colour.
    """
    with path.open("rb") as file:
        start = file.read(4)
    suffix = next((s for magic, s in _RADIANCES.items() if start.startswith(magic)), None)
    if suffix is None:
        raise error(slug, "is neither an EXR nor a Radiance HDR", where)
    # OpenImageIO goes by the name, and a blob has none.
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / f"image{suffix}"
        link.symlink_to(path.absolute())
        source = oiio.ImageInput.open(str(link))
        if source is None:
            raise error(slug, _one_line(_complaint(oiio) or "cannot be read"), where)
        try:
            spec = source.spec()
            try:
                names = list(spec.channelnames)
            except UnicodeDecodeError:
                raise error(slug, "has a channel whose name is not UTF-8; give R, G and B, or Y", where) from None
            if spec.width * spec.height * spec.depth > _MAX_RADIANCE_TEXELS:
                raise error(slug, f"has {spec.width} × {spec.height} texels, more than 8192 × 4096", where)
            if (spec.x, spec.y, spec.width, spec.height) != (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
                raise error(slug, "is a part cut out of a larger image; store the whole", where)
            if not ({"R", "G", "B"} <= set(names) or names[0] == "Y"):
                raise error(slug, f"has the channels {', '.join(names)}; give R, G and B, or Y", where)
            pixels = source.read_image("float")
            complaint = _complaint(source)
        finally:
            source.close()
    if pixels is None or complaint:
        raise error(slug, _one_line(complaint or "cannot be read"), where)
    chosen = [names.index(c) for c in "RGB"] if "R" in names else [0, 0, 0]
    shaped = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)
    return np.ascontiguousarray(shaped[..., chosen])


def picture_size(data: bytes, error: type[InputError], slug: str, where: str) -> tuple[int, int]:
    """Width and height of a PNG or JPEG by its header; nothing is decoded.

    Raises
    ------
    InputError
        `error` with `slug` where it is neither, or its header is broken.
    """
    with _opened(data, error, slug, where) as source:
        spec = source.spec()
        return spec.width, spec.height


def decode_picture(data: bytes, error: type[InputError], slug: str, where: str) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Decode a PNG or JPEG as it is stored: no colour conversion, no premultiplication, no rotation.

    Returns
    -------
    pixels : (height, width, 4) uint8 or uint16
        RGBA; grey is spread over RGB, and alpha is full where there is none.

    Raises
    ------
    InputError
        `error` with `slug` where it cannot be decoded whole.
    """
    with _opened(data, error, slug, where) as source:
        spec = source.spec()
        dtype = np.uint16 if spec.format == oiio.UINT16 else np.uint8
        pixels = source.read_image("uint16" if dtype == np.uint16 else "uint8")
        complaint = _complaint(source)
        if pixels is None or complaint:
            raise error(slug, _one_line(complaint or "cannot be decoded"), where)
    channels = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    full = np.full((spec.height, spec.width, 4), np.iinfo(dtype).max, dtype)
    if spec.nchannels < 3:
        full[..., :3] = channels[..., :1]
    else:
        full[..., :3] = channels[..., :3]
    if spec.nchannels in (2, 4):
        full[..., 3] = channels[..., -1]
    return full


@contextmanager
def _opened(data: bytes, error: type[InputError], slug: str, where: str) -> Iterator[oiio.ImageInput]:
    suffix = next((s for magic, s in _PICTURES.items() if data.startswith(magic)), None)
    if suffix is None:
        raise error(slug, "is neither a PNG nor a JPEG, the formats of glTF", where)
    # OpenImageIO's Python module reads files only.
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
        file.write(data)
        file.flush()
        config = oiio.ImageSpec()
        config.attribute("oiio:UnassociatedAlpha", 1)
        source = oiio.ImageInput.open(file.name, config)
        if source is None:
            raise error(slug, _one_line(_complaint(oiio) or "cannot be read"), where)
        try:
            yield source
        finally:
            source.close()


def _complaint(of: Any) -> str:
    """What OpenImageIO, or one of its readers or writers, has to say; it may quote a broken file's bytes, which are no text."""
    try:
        return str(of.geterror())
    except UnicodeDecodeError:
        return "its header is damaged"


def _one_line(complaint: str) -> str:
    """A complaint of OpenImageIO's: its first line, for the others follow from it, without names of temporary files."""
    return "cannot be decoded: " + re.sub(r' \(("[^"]*"|/[^)]*)\)', "", complaint).strip().partition("\n")[0][:200]
