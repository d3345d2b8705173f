"""Mixed jobs for a while: what the processes' memory and the write-ahead log come to."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import psutil
from octobake_client import Client, ServiceError

from bake_core.examples import closed_box
from tests.service.figures.table import Say
from tests.service.figures.work import ENDLESS
from tests.service.running import Server, box_spec

MEGABYTE = 1 << 20
# Memory is compared between the first and the last of so many parts of the time after the warm-up.
WARM_UP, SHARE = 0.2, 0.2
SAMPLE_SECONDS = 1.0


def measure(folder: Path, minutes: float, say: Say) -> None:
    """Upload, bake, verify, cancel, fail, follow and download, all at once."""
    server = Server(folder / "data")
    clients = _Clients(server, folder)
    resident: dict[str, list[float]] = {"service": [], "worker": []}
    log = 0
    try:
        server.wait_ready()
        clients.start()
        began = time.monotonic()
        while (passed := time.monotonic() - began) < 60 * minutes and not clients.faults:
            log = max(log, (server.data / "octobake.sqlite-wal").stat().st_size)
            if passed > 60 * minutes * WARM_UP:
                resident["service"].append(psutil.Process(server.process.pid).memory_info().rss / MEGABYTE)
                resident["worker"].append(_worker_memory(server))
            time.sleep(SAMPLE_SECONDS)
    finally:
        clients.join()
        server.close()
    assert not clients.faults, clients.faults
    print(", ".join(f"{count} {what}" for what, count in sorted(clients.done.items())), flush=True)
    for name, values in resident.items():
        part = max(1, int(len(values) * SHARE))
        first, last = float(np.median(values[:part])), float(np.median(values[-part:]))
        say(f"memory of the {name}, {first:.0f} -> {last:.0f} MB in {minutes:g} min", 100 * (last / first - 1), 5.0, "%")
    say("write-ahead log at its largest", log / MEGABYTE, 64.0, "MB")


def _worker_memory(server: Server) -> float:
    """Megabytes; nan where it is just being started again, as some cancels make it."""
    with suppress(psutil.Error):
        return float(server.bake_worker().memory_info().rss / MEGABYTE)
    return float("nan")


class _Clients:
    """Threads that each do one kind of thing again and again, and count it."""

    def __init__(self, server: Server, folder: Path) -> None:
        self.done: dict[str, int] = {}
        self.faults: list[str] = []
        self._server, self._folder = server, folder
        self._stopping = threading.Event()
        kinds = (self._bake, self._bake, self._cancel, self._fail, self._upload, self._refused)
        self._threads = [threading.Thread(target=self._live, args=(kind, i)) for i, kind in enumerate(kinds)]

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def join(self) -> None:
        """Let each finish what it does."""
        self._stopping.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()

    def _live(self, kind: Callable[[Client, random.Random], str], seed: int) -> None:
        chance = random.Random(seed)
        try:
            with self._server.client() as client:
                while not self._stopping.is_set():
                    what = kind(client, chance)
                    self.done[what] = self.done.get(what, 0) + 1
        except Exception as e:
            self.faults.append(f"{kind.__name__}: {type(e).__name__}: {e}")

    def _scene(self, client: Client, chance: random.Random) -> str:
        """One of a few, so that some are known and some are not."""
        path = self._folder / f"{chance.getrandbits(32)}.glb"
        path.write_bytes(closed_box(round(chance.uniform(0.1, 0.8), 2), 1.0)[0])
        digest = client.add_scene(path).digest
        path.unlink()
        return digest

    def _bake(self, client: Client, chance: random.Random) -> str:
        job = client.submit(self._scene(client, chance), box_spec(seed=chance.getrandbits(20)))
        # Following it holds an event stream.
        done = client.wait(job).check()
        client.fetch(done, self._folder / f"{job.id}.zip").unlink()
        if chance.random() < 0.2:
            client.wait(client.verify(done, width=64, height=64, samples=2))
            return "bakes verified"
        return "bakes"

    def _cancel(self, client: Client, chance: random.Random) -> str:
        job = client.submit(self._scene(client, chance), {**ENDLESS, "seed": chance.getrandbits(20)}, priority=1)
        time.sleep(chance.uniform(0, 3))
        client.cancel(job)
        return f"bakes {client.wait(job).state}"

    def _fail(self, client: Client, chance: random.Random) -> str:
        body = {"scene": self._scene(client, chance), "spec": box_spec(seed=chance.getrandbits(20)), "limits": {"memory_bytes": 1 << 20}}
        answer = httpx.post(f"{self._server.url}/v1/bakes", json=body, timeout=60).raise_for_status()
        state = client.wait(client.bake(answer.json()["id"])).state
        self._stopping.wait(1)
        return f"bakes {state}"

    def _upload(self, client: Client, chance: random.Random) -> str:
        path = self._folder / "upload"
        path.write_bytes(chance.randbytes(chance.randrange(1, 16 * MEGABYTE)))
        client.put_blob(path)
        self._stopping.wait(2)
        return "uploads"

    def _refused(self, client: Client, chance: random.Random) -> str:
        path = self._folder / "refused.glb"
        path.write_bytes(b"glTF" + chance.randbytes(1000))
        with suppress(ServiceError):
            client.add_scene(path)
            return "scenes accepted"
        self._stopping.wait(1)
        return "scenes refused"
