"""The one module that touches OpenImageIO: EXR files out and in, PNG out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from bake_core.errors import BakeError, InputError

F32 = NDArray[np.float32]

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


def _write(path: Path, pixels: NDArray[np.generic], spec: oiio.ImageSpec) -> None:
    out = oiio.ImageOutput.create(str(path))
    if out is None or not out.open(str(path), spec):
        raise BakeError("bake.cannot_write", (out.geterror() if out else oiio.geterror()) or "cannot be written", str(path))
    written = out.write_image(np.ascontiguousarray(pixels))
    if not (out.close() and written):
        raise BakeError("bake.cannot_write", out.geterror() or "cannot be written; is the disk full?", str(path))


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
        raise error(slug, oiio.geterror() or "cannot be read", path.name)
    spec = source.spec()
    pixels = source.read_image("float")
    half = spec.format == oiio.HALF
    complaint = source.geterror()
    source.close()
    if pixels is None:
        raise error(slug, complaint or "cannot be read", path.name)
    return np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels), half
