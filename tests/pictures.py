"""PNG files put together byte by byte, so that no decoder's author is also the encoder's."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

_COLOR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_header(width: int, height: int, depth: int = 8, color: int = 6) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))


def png(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """A PNG of (h, w, 1 to 4) uint8 or uint16."""
    height, width, channels = pixels.shape
    size = pixels.dtype.itemsize
    rows = pixels.astype(f">u{size}").tobytes()
    stride = width * channels * size
    lines = b"".join(b"\0" + rows[y * stride : (y + 1) * stride] for y in range(height))
    body = chunk(b"IDAT", zlib.compress(lines, 6)) + chunk(b"IEND", b"")
    return png_header(width, height, 8 * size, _COLOR_TYPES[channels]) + body
