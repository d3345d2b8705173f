"""A real file system that is full: 507, nothing corrupt, and work again by itself once there is room."""

from __future__ import annotations

import hashlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.app import create_app
from service.parts import Service
from service.settings import Settings
from tests.service.leftovers import listing
from tests.service.running import InProcess

MEGABYTE = 1 << 20


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "octobake-test", folder], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("needs the right to mount a file system")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_full_disk(small_disk: Path) -> None:
    service = Service(Settings(data=str(small_disk / "data")))
    try:
        http = InProcess(create_app(service))

        def put(size: int) -> int:
            data = os.urandom(size)
            answer = http.put(f"/v1/blobs/sha256:{hashlib.sha256(data).hexdigest()}", content=data)
            if answer.status_code == 507:
                assert answer.json()["slug"] == "service.disk_full"
                assert answer.headers["Retry-After"]
            return answer.status_code

        assert put(MEGABYTE) == 201
        assert service.blobs.root
        before = listing(service.blobs.root)
        assert put(9 * MEGABYTE) == 507
        assert listing(service.blobs.root) == before
        # Not one byte is left, for the job store's log neither.
        filler = small_disk / "filler"
        # dd writes until it cannot.
        subprocess.run(["dd", "if=/dev/zero", f"of={filler}", "bs=4096"], capture_output=True, check=False)
        assert put(MEGABYTE) == 507
        assert http.get("/v1/bakes").status_code == 200
        filler.unlink()
        assert put(MEGABYTE) == 201
    finally:
        service.close()
