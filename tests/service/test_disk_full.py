"""A real file system that is full: 507, nothing corrupt, and work again by itself once there is room."""

from __future__ import annotations

import hashlib
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from octobake_client.jobs import FINISHED

from service.app import create_app
from service.parts import Service
from service.settings import Settings
from tests.service.chaos import contents
from tests.service.leftovers import listing
from tests.service.running import InProcess, Server, box_spec, wait_for

MEGABYTE = 1 << 20


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 MB."""
    with mounted(tmp_path / "small", 8) as folder:
        yield folder


@contextmanager
def mounted(folder: Path, megabytes: int) -> Iterator[Path]:
    """A file system of its own in memory."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "octobake-test", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def fill(folder: Path) -> Path:
    """A file that takes all the room there is."""
    filler = folder / "filler"
    # dd writes until it cannot.
    subprocess.run(["dd", "if=/dev/zero", f"of={filler}", "bs=4096"], capture_output=True, check=False)
    return filler


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
        filler = fill(small_disk)
        assert put(MEGABYTE) == 507
        assert http.get("/v1/bakes").status_code == 200
        filler.unlink()
        assert put(MEGABYTE) == 201
    finally:
        service.close()


@pytest.mark.slow
def test_a_bake_waits_for_room_and_makes_the_same_bytes(box: Path, tmp_path: Path) -> None:
    """The disk fills while shards are committed; the job is not failed, and goes on by itself once there is room."""
    spec = box_spec(samples=512, probes=(4, 4, 4))
    # Its log is beside it, and on another disk.
    with mounted(tmp_path / "data", 32) as folder:
        server = Server(folder, "--shard-seconds", "0.1")
        try:
            server.wait_ready()
            with server.client() as client:
                scene = client.add_scene(box).digest
                undisturbed = client.wait(client.submit(scene, spec)).check()
                job = client.submit(scene, spec, fresh=True)
                next(e for e in client.events(job) if e.type == "pass")
                filler = fill(folder)
                wait_for(lambda: "trying again" in server.log() or "lost its driver" in server.log(), 30)
                assert client.bake(job.id).state not in FINISHED
                assert httpx.get(f"{server.url}/healthz").status_code == 200
                filler.unlink()
                done = client.wait(job).check()
                assert done.attempts == 0
                made = [contents(client.fetch(one, tmp_path / "bundle.zip").read_bytes()) for one in (undisturbed, done)]
                assert made[0] == made[1]
        finally:
            server.close()
