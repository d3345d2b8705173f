"""The blob store on a file system of its own."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from service.blobs import Blobs

MEMORY = Path("/dev/shm")


def test_a_blob_made_on_another_file_system_is_moved_in_whole(tmp_path: Path) -> None:
    """As a bundle is that a worker made in a /tmp that is memory: a rename alone would fail."""
    if not MEMORY.is_dir() or MEMORY.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("no second file system at /dev/shm")
    blobs = Blobs((tmp_path / "blobs").as_uri(), tmp_path / "scratch")
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        made = Path(folder) / "bundle.zip"
        made.write_bytes(b"a bundle")
        digest, size = blobs.put_blob(made)
        assert size == 8 and not made.exists()
    assert blobs.local_path(digest).read_bytes() == b"a bundle"
    assert [p.name for p in (tmp_path / "blobs").rglob("*") if p.is_file()] == [digest.removeprefix("sha256:")]
