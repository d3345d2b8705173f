"""EXR files come back bit by bit, are the same bytes each time, and say what is wrong with them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from bake_core.errors import BakeError, BundleError
from bake_core.images import read_exr, write_exr, write_png


@pytest.mark.parametrize("channels", [("R", "G", "B"), ("R", "G", "B", "A"), ("mean", "square"), ("x", "y", "z"), ("distance",)])
@pytest.mark.parametrize("half", [False, True])
def test_values_come_back_in_their_channels(tmp_path: Path, channels: tuple[str, ...], half: bool) -> None:
    pixels = np.random.default_rng(0).random((7, 5, len(channels))).astype(np.float32) * 100
    if half:
        pixels = pixels.astype(np.float16).astype(np.float32)
    path = tmp_path / "a.exr"
    write_exr(path, pixels, channels, half=half)
    back, was_half = read_exr(path, BundleError, "bundle.damaged")
    np.testing.assert_array_equal(back, pixels)
    assert was_half == half and back.dtype == np.float32


def test_extreme_values_come_back(tmp_path: Path) -> None:
    pixels = np.array([0.0, 1e-45, 1e-38, 65504, 3.4e38, -1.0], np.float32).reshape(1, 2, 3)
    write_exr(tmp_path / "a.exr", pixels, ("x", "y", "z"))
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr", BundleError, "bundle.damaged")[0], pixels)


def test_the_same_pixels_are_the_same_bytes(tmp_path: Path) -> None:
    pixels = np.linspace(0, 1, 300, dtype=np.float32).reshape(10, 10, 3)
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, pixels, ("R", "G", "B"), half=True)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_what_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(BakeError) as caught:
        write_exr(tmp_path / "missing" / "a.exr", np.zeros((1, 1, 3), np.float32), ("R", "G", "B"))
    assert caught.value.slug == "bake.cannot_write" and "a.exr" in caught.value.where


def test_what_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, np.random.default_rng(0).random((64, 64, 3)).astype(np.float32), ("R", "G", "B"))
    whole = path.read_bytes()
    for data in (None, b"", b"not an EXR", whole[:200], whole[: len(whole) // 2]):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(BundleError) as caught:
            read_exr(path, BundleError, "bundle.damaged")
        assert caught.value.slug == "bundle.damaged" and caught.value.where == "a.exr"


def test_png(tmp_path: Path) -> None:
    """Decoded by hand: zlib and no filter or the simple ones are all that a PNG of one colour needs."""
    write_png(tmp_path / "a.png", np.full((3, 4, 3), (10, 20, 30), np.uint8))
    data = (tmp_path / "a.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">IIBB", data[16:26]) == (4, 3, 8, 2)
    at = data.index(b"IDAT")
    (length,) = struct.unpack(">I", data[at - 4 : at])
    assert len(zlib.decompress(data[at + 4 : at + 4 + length])) == 3 * (1 + 4 * 3)
