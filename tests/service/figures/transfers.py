"""A large upload and a large download: what they cost the service's process in memory."""

from __future__ import annotations

import hashlib
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import httpx
import psutil

from tests.service.figures.table import Say
from tests.service.figures.work import submit
from tests.service.running import Server, box_spec, wait_for

MEGABYTE = 1 << 20


def measure(folder: Path, megabytes: int, say: Say) -> None:
    """Send a file, and fetch it as a bundle."""
    server = Server(folder / "data")
    try:
        server.wait_ready()
        job = submit(server, box_spec())
        wait_for(lambda: httpx.get(f"{server.url}/v1/bakes/{job}").json()["state"] == "succeeded", 120)
        # What the first transfer of all leaves behind is not this one's.
        _upload(server, 8)
        _download(server, job)
        rise = _rise(server, lambda: _upload(server, megabytes))
        say(f"memory of the service during an upload of {megabytes} MB", rise, 64.0, "MB")
        digest = _digest(megabytes)
        with closing(sqlite3.connect(server.data / "octobake.sqlite", timeout=30)) as store:
            # No bake of a minute makes a bundle of this size.
            store.execute("UPDATE jobs SET result = json_set(result, '$.bundle', ?) WHERE id = ?", (digest, job))
            store.commit()
        rise = _rise(server, lambda: _download(server, job))
        say(f"memory of the service during a download of {megabytes} MB", rise, 64.0, "MB")
    finally:
        server.close()


def _parts(megabytes: int) -> Iterator[bytes]:
    # Every megabyte differs; the client keeps none.
    part = bytes(MEGABYTE - 8)
    return (number.to_bytes(8, "little") + part for number in range(megabytes))


def _digest(megabytes: int) -> str:
    digest = hashlib.sha256()
    for part in _parts(megabytes):
        digest.update(part)
    return f"sha256:{digest.hexdigest()}"


def _upload(server: Server, megabytes: int) -> None:
    headers = {"Content-Length": str(megabytes * MEGABYTE)}
    url = f"{server.url}/v1/blobs/{_digest(megabytes)}"
    httpx.put(url, content=_parts(megabytes), headers=headers, timeout=600).raise_for_status()


def _download(server: Server, job: str) -> None:
    with httpx.stream("GET", f"{server.url}/v1/bakes/{job}/bundle", timeout=600) as answer:
        answer.raise_for_status()
        digest = hashlib.sha256()
        for part in answer.iter_raw(MEGABYTE):
            digest.update(part)
    assert answer.headers["ETag"] == f'"sha256:{digest.hexdigest()}"'


def _rise(server: Server, work: Callable[[], None]) -> float:
    """Megabytes by which the service's own resident memory comes above what it was before `work`."""
    process = psutil.Process(server.process.pid)
    before = most = process.memory_info().rss
    done = threading.Event()

    def watch() -> None:
        nonlocal most
        while not done.wait(0.01):
            most = max(most, process.memory_info().rss)

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        work()
    finally:
        done.set()
        watching.join()
    return float(most - before) / MEGABYTE
