"""The one module of the service that talks to Dask: a cluster started here, or somebody's scheduler by URL.

Embedded, it is one worker process with one task slot; the kernels bring their own threads. Nothing listens but on loopback.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias
from uuid import uuid4

from distributed import Client, Future, LocalCluster
from distributed.core import Status
from distributed.scheduler import DEFAULT_EXTENSIONS

from bake_core.errors import MachineError
from service import worker
from service.dask_configuration import configure, kept
from service.settings import Settings

log = logging.getLogger("octobake.compute")

# An idle scheduler closes in a third of this; a shutdown shall take less than two seconds in all.
CLOSE_SECONDS = 0.5
# Workers come and go; how many there are may be known this late.
SLOTS_SECONDS = 0.5
# A worker that ends sooner than this cannot even start: do not try again at once.
QUICK_DEATH_SECONDS = 1.0
# A worker has begun its work by then, and is not held up while another is started beside it.
SPARE_SECONDS = 4.0
# What a worker tells: {"key", "address", "began": true} … {"key", "done": 0.3} … {"key", "ended": true}.
Message: TypeAlias = dict[str, Any]


class Compute:
    """Runs the functions of :mod:`service.worker` somewhere else.

    Parameters
    ----------
    settings : Settings
    hear : callable
        Called with each worker's message, in a thread of Dask's; must not block.
    """

    def __init__(self, settings: Settings, hear: Callable[[Message], None]) -> None:
        self._cluster: LocalCluster | None = None
        self._worker: _EmbeddedWorker | None = None
        self._known_slots, self._asked_slots_at = 0, float("-inf")
        configure()
        try:
            if not settings.dask:
                # Both addresses are given because the defaults are every interface, and port 8787 of it.
                self._cluster = LocalCluster(
                    n_workers=0,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.ERROR,
                    scheduler_kwargs={"extensions": kept(DEFAULT_EXTENSIONS)},
                )
                self._worker = _EmbeddedWorker(self._cluster.scheduler_address, settings.temporary_folder / "worker")
            self._client = Client(self._cluster or settings.dask, set_as_default=False, timeout="10s")
        except (OSError, ValueError) as e:
            self.close()
            raise MachineError("compute.unreachable", f"no Dask scheduler: {e}", settings.dask or "embedded") from None
        self._client.register_plugin(worker.CancelFlags())
        self._client.subscribe_topic(worker.TOPIC, lambda event: hear(event[1]))

    @property
    def slots(self) -> int:
        """How many pieces of work can run at once; never 0, so that work queues while a worker is started again."""
        return max(1, self._slots())

    @property
    def ready(self) -> bool:
        """Whether there is a worker to submit to."""
        return bool(self._client.status == "running") and self._slots() > 0

    def _slots(self) -> int:
        # Asked between any two pieces of work, and a round trip each time would show.
        if time.monotonic() - self._asked_slots_at > SLOTS_SECONDS:
            self._known_slots = self._client.scheduler_info(n_workers=0)["total_threads"]
            self._asked_slots_at = time.monotonic()
        return self._known_slots

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run a function on a worker; every call is its own task, even with the same arguments."""
        return self._client.submit(function, *arguments, key=f"{function.__name__}-{uuid4().hex}", pure=False)

    def places(self, keys: list[str]) -> dict[str, str]:
        """Which worker the scheduler has given each of these tasks to; those that wait in its queue are left out."""
        found = self._client.processing()
        return {key: address for address, tasks in found.items() for key in map(str, tasks) if key in keys}

    def cancel(self, futures: list[Future[Any]]) -> None:
        """Drop tasks that wait, and raise the cancel flag of those that run."""
        self._client.cancel(futures, force=True)

    def release(self, future: Future[Any]) -> None:
        """Forget what came of a task.

        Left to the garbage collector, an error would stay for good: Dask's client holds it as long as there is the future, its traceback
        the frames it went through, and those the future.
        """
        # The client may have closed under its caller.
        with suppress(RuntimeError):
            future.release()

    def restart(self, address: str) -> None:
        """Kill a worker that does not hear; another is started in its place."""
        log.warning("restarting the worker at %s, which does not stop", address)
        if self._worker:
            self._worker.kill()
            # Until the scheduler, asked again, knows of the next one.
            self._known_slots, self._asked_slots_at = 0, time.monotonic()
        else:
            # Where it has no nanny, the task runs on, and the worker is free when it ends.
            with suppress(ValueError):
                self._client.restart_workers([address], raise_for_error=False)

    def close(self) -> None:
        """Stop what was started here; what runs on somebody else's cluster is released."""
        if self._worker:
            self._worker.close()
        client = getattr(self, "_client", None)
        if client is not None and client.status != Status.closed:
            client.close(timeout=CLOSE_SECONDS)
        if self._cluster is not None:
            with suppress(TimeoutError):
                self._cluster.close(timeout=CLOSE_SECONDS)


class _EmbeddedWorker:
    """A worker process, replaced whenever it ends; while it works another waits with everything imported, for that takes seconds.

    Not Dask's nanny, which gives up on a worker that dies while it starts.
    """

    def __init__(self, scheduler: str, folder: Path) -> None:
        self._command = [sys.executable, "-m", "service.worker_process", scheduler]
        self._folder = folder
        self._closing = threading.Event()
        self._spare: subprocess.Popen[bytes] | None = None
        self._process = self._take()
        self._thread = threading.Thread(target=self._watch, name="octobake-worker", daemon=True)
        self._thread.start()

    def kill(self) -> None:
        """End the process at once; it holds nothing that is not stored."""
        self._process.kill()

    def close(self) -> None:
        """End the processes for good."""
        self._closing.set()
        self.kill()
        self._thread.join(CLOSE_SECONDS)

    def _start(self) -> subprocess.Popen[bytes]:
        self._folder.mkdir(parents=True, exist_ok=True)
        folder = tempfile.mkdtemp(dir=self._folder)
        # Its standard input is how it learns that it is to work, and that this process has gone.
        return subprocess.Popen([*self._command, folder], stdin=subprocess.PIPE, env={**os.environ, "TMPDIR": folder})

    def _take(self) -> subprocess.Popen[bytes]:
        """Let the one that waits work, or a new one where none does."""
        process, self._spare = self._spare or self._start(), None
        assert process.stdin is not None
        # One that has died while it waited is seen to be dead by whoever waits for its end.
        with suppress(BrokenPipeError):
            process.stdin.write(b"work\n")
            process.stdin.flush()
        return process

    def _watch(self) -> None:
        while not self._closing.is_set():
            began = time.monotonic()
            code = self._end_of_process()
            if self._closing.is_set():
                break
            log.warning("the worker has ended (%d); starting another", code)
            if time.monotonic() - began < QUICK_DEATH_SECONDS:
                self._closing.wait(QUICK_DEATH_SECONDS)
            _discard(self._process)
            self._process = self._take()
        for process in (self._process, self._spare):
            if process is not None:
                process.kill()
                _discard(process)

    def _end_of_process(self) -> int:
        try:
            return self._process.wait(SPARE_SECONDS)
        except subprocess.TimeoutExpired:
            self._spare = self._start()
            # This may have been closed in between.
            return self._process.wait()


def _discard(process: subprocess.Popen[bytes]) -> None:
    """Close our end of an ended process's standard input, and remove what it was making when it died."""
    with suppress(BrokenPipeError), process:
        pass
    shutil.rmtree(str(process.args[-1]), ignore_errors=True)  # type: ignore[index]
