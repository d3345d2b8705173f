"""The command and the service as processes of their own, and the work that tests give them."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import psutil
from fastapi import FastAPI
from octobake_client import Bake, Client

from bake_core.examples import closed_box

ROOT = Path(__file__).resolve().parents[2]
# The command as it is installed, from this checkout.
OCTOBAKE = [sys.executable, "-m", "service.cli"]
START_SECONDS = 60.0
BOX, _ = closed_box(0.5, 1.0)


def environment(**more: str) -> dict[str, str]:
    """This process's environment, with the checkout importable; bytecode is kept, as it is where the command is installed."""
    paths = [str(ROOT), str(ROOT / "clients" / "python"), os.environ.get("PYTHONPATH", "")]
    ours = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**ours, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **more}


def octobake(*arguments: str | Path, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
    command = [*OCTOBAKE, *map(str, arguments)]
    return subprocess.run(command, env=environment(), cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False)


def free_port() -> int:
    """A port that was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


class InProcess:
    """Requests to an application in this process."""

    def __init__(self, app: FastAPI) -> None:
        self.app = app

    def request(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """One request and its whole answer; an error that the application lets through is the server's 500."""

        async def send() -> httpx.Response:
            transport = httpx.ASGITransport(self.app, raise_app_exceptions=False)
            async with httpx.AsyncClient(transport=transport, base_url="http://octobake") as client:
                return await client.request(method, path, **arguments)

        return asyncio.run(send())

    def get(self, path: str, **arguments: Any) -> httpx.Response:
        """GET."""
        return self.request("GET", path, **arguments)

    def head(self, path: str, **arguments: Any) -> httpx.Response:
        """HEAD."""
        return self.request("HEAD", path, **arguments)

    def post(self, path: str, **arguments: Any) -> httpx.Response:
        """POST."""
        return self.request("POST", path, **arguments)

    def put(self, path: str, **arguments: Any) -> httpx.Response:
        """PUT."""
        return self.request("PUT", path, **arguments)


class Server:
    """`octobake serve` as a process."""

    def __init__(self, data: Path, *options: str) -> None:
        self.data = data
        self._options = options
        self._ready = data.with_name(data.name + ".ready")
        self._log = data.with_name(data.name + ".log")
        self.start()

    def start(self, wait: bool = True) -> None:
        """Start, or start again, and if asked wait until it answers."""
        self._ready.unlink(missing_ok=True)
        with open(self._log, "a") as log:
            command = [*OCTOBAKE, "serve", "--port", "0", "--data", str(self.data), "--ready-file", str(self._ready), *self._options]
            self.process = subprocess.Popen(command, env=environment(), cwd=ROOT, stdout=log, stderr=log)
        self.family: list[psutil.Process] = []
        if not wait:
            return
        wait_for(lambda: self._ready.exists() or self.process.poll() is not None, START_SECONDS)
        assert self.process.poll() is None, self.log()
        self.url = self._ready.read_text().strip()
        self.family = self.workers()

    def log(self) -> str:
        """What it has printed."""
        return self._log.read_text()

    def client(self) -> Client:
        """A client of it."""
        return Client(self.url)

    def wait_ready(self) -> None:
        """Wait until it would run a job."""
        with self.client() as client:
            wait_for(lambda: client._http.get("/readyz").status_code == 200, START_SECONDS)
        self.family = self.workers()

    def workers(self) -> list[psutil.Process]:
        """Its child processes."""
        children: list[psutil.Process] = psutil.Process(self.process.pid).children(recursive=True)
        return children

    def bake_worker(self) -> psutil.Process:
        """The process that bakes; waits for it where it is just being started again. A younger one waits for its end."""

        def oldest() -> psutil.Process | None:
            return min(filter(_bakes, self.workers()), key=lambda process: process.create_time(), default=None)

        worker: psutil.Process = wait_for(oldest, START_SECONDS)
        return worker

    def kill(self) -> None:
        """SIGKILL."""
        self.family = self.workers()
        self.process.kill()
        self.process.wait()

    def stop(self) -> float:
        """SIGTERM; answers the seconds it took."""
        self.family = self.workers()
        began = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(timeout=30)
        return time.monotonic() - began

    def close(self) -> None:
        """Whatever happened, nothing is left."""
        if self.process.poll() is None:
            self.kill()
        left = living(self.family, 5)
        for process in left:
            process.kill()
        assert not left, f"left running: {left}"


def _bakes(process: psutil.Process) -> bool:
    try:
        return "service.worker_process" in process.cmdline()
    except psutil.Error:
        return False


def _runs(process: psutil.Process) -> bool:
    # It may go between two questions.
    try:
        running: bool = process.is_running() and process.status() != psutil.STATUS_ZOMBIE
        return running
    except psutil.NoSuchProcess:
        return False


def living(processes: list[psutil.Process], seconds: float) -> list[psutil.Process]:
    """Those that still run after so many seconds; returns as soon as none does. A zombie waits for its parent and runs no more."""
    deadline = time.monotonic() + seconds
    while True:
        left = [p for p in processes if _runs(p)]
        if not left or time.monotonic() > deadline:
            return left
        time.sleep(0.005)


def busy(processes: list[psutil.Process], seconds: float) -> float:
    """CPU seconds that processes use in so many seconds."""

    def used() -> float:
        return sum(sum(p.cpu_times()[:2]) for p in processes if p.is_running())

    before = used()
    time.sleep(seconds)
    return used() - before


def cancel_to_idle(server: Server, client: Client, job: Bake) -> float:
    """Seconds from asking until no process that worked uses a CPU any more; the job is cancelled then, and its work swept away."""
    workers = server.workers()
    began = time.monotonic()
    assert client.cancel(job).state in ("cancelling", "cancelled")
    idle = time.monotonic()
    while time.monotonic() - idle < 0.3:
        if busy(workers, 0.05) > 0.02:
            idle = time.monotonic()
    assert client.wait(job).state == "cancelled"
    assert not (server.data / "blobs" / "work" / job.id).exists()
    return idle - began


def wait_for(condition: Callable[[], Any], seconds: float) -> Any:
    """Poll until `condition` is true; answers what it answered."""
    deadline = time.monotonic() + seconds
    while not (answer := condition()):
        assert time.monotonic() < deadline, f"waited {seconds} s in vain"
        time.sleep(0.01)
    return answer


def box_spec(samples: int = 16, probes: tuple[int, int, int] = (2, 2, 2), **more: Any) -> dict[str, Any]:
    """Work of a known size: exactly so many samples at so many probes, all of them inside the box."""
    spacing = [1.7 / (n - 1) for n in probes]
    grid = {"origin": [-0.86, -0.85, -0.84], "spacing": spacing, "counts": list(probes)}
    return {"volumes": [grid], "stop": {"target_error": None, "max_samples": samples}, **more}
