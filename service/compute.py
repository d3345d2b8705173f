"""The one module of the service that touches Dask: a cluster started here, or somebody's scheduler by URL.

Embedded, it is one worker process with one task slot; the kernels bring their own threads. Nothing listens but on loopback, and nothing
on HTTP.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias
from uuid import uuid4

import dask
from distributed import Client, Future, LocalCluster
from distributed.core import Status

from bake_core.errors import MachineError
from service import worker
from service.settings import Settings

log = logging.getLogger("octobake.compute")

CONFIGURATION = {
    # A lost worker is counted in our store, per piece of work; Dask would blame the tasks that were merely queued behind it.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # Its sampling profiler walks the stacks of our kernels' threads for pages that nobody serves.
    "distributed.worker.profile.enabled": False,
    "distributed.comm.timeouts.connect": "10s",
    "distributed.logging.distributed": "warning",
}
# An idle worker closes in a third of this; a shutdown shall take less than two seconds in all.
CLOSE_SECONDS = 0.5
# What a worker tells: {"key", "address", "began": true} … {"key", "progress": {…}} … {"key", "ended": true}.
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
        dask.config.set(CONFIGURATION)
        try:
            if not settings.dask:
                self._cluster = LocalCluster(
                    n_workers=1,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address=None,
                    memory_limit=0,
                    preload=["service.worker"],
                    local_directory=str(settings.data_folder / "scratch"),
                    silence_logs=logging.ERROR,
                )
            self._client = Client(self._cluster or settings.dask, set_as_default=False, timeout="10s")
        except (OSError, ValueError) as e:
            self.close()
            raise MachineError("compute.unreachable", f"no Dask scheduler: {e}", settings.dask or "embedded") from None
        self._client.register_plugin(worker.CancelFlags())
        self._client.subscribe_topic(worker.TOPIC, lambda event: hear(event[1]))

    @property
    def slots(self) -> int:
        """How many pieces of work can run at once; never 0, so that work queues while a worker is restarted."""
        slots: int = self._client.scheduler_info(n_workers=0)["total_threads"]
        return max(1, slots)

    @property
    def ready(self) -> bool:
        """Whether there is a scheduler to submit to."""
        return bool(self._client.status == "running")

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run a function on a worker; every call is its own task, even with the same arguments."""
        return self._client.submit(function, *arguments, key=f"{function.__name__}-{uuid4().hex}", pure=False)

    def cancel(self, futures: list[Future[Any]]) -> None:
        """Drop tasks that wait, and raise the cancel flag of those that run."""
        self._client.cancel(futures, force=True)

    def restart(self, address: str) -> None:
        """Kill a worker that does not hear; its nanny starts another."""
        log.warning("restarting the worker at %s, which does not stop", address)
        self._client.restart_workers([address], raise_for_error=False)

    def close(self) -> None:
        """Stop what was started here; what runs on somebody else's cluster is released."""
        client = getattr(self, "_client", None)
        if client is not None and client.status != Status.closed:
            client.close(timeout=CLOSE_SECONDS)
        if self._cluster is not None:
            # A worker in native code does not hear; it ends with this process, whose death it watches.
            with suppress(TimeoutError):
                self._cluster.close(timeout=CLOSE_SECONDS)
