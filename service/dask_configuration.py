"""How Dask is set up, in the service and in the worker that it starts."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import dask

_CONFIGURATION: dict[str, Any] = {
    # A lost worker is counted in our store, per piece of work; Dask would blame the tasks that were merely queued behind it.
    "distributed.scheduler.allowed-failures": 0,
    # Counted by the wall clock, which jumps: a machine that wakes would lose its worker. We watch the process itself.
    "distributed.scheduler.worker-ttl": None,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # Its sampling profiler walks the stacks of our kernels' threads for pages that nobody serves.
    "distributed.worker.profile.enabled": False,
    # What it remembers for pages and post-mortems: messages, transitions, graphs and errors of the last thousand tasks, measurements of an
    # hour. Filling that up takes a service half an hour, and looks like a leak; nobody reads it.
    "distributed.admin.low-level-log-length": 50,
    "distributed.admin.log-length": 200,
    "distributed.admin.system-monitor.log-length": 10,
    "distributed.diagnostics.computations.max-history": 1,
    "distributed.diagnostics.erred-tasks.max-history": 1,
    # How late its event loops are it would measure fifty times a second in each of three, and how busy the process is twice: more than half
    # of what an idle service takes of a core.
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.comm.timeouts.connect": "10s",
}


def kept(extensions: Mapping[str, type]) -> dict[str, type]:
    """Of Dask's own extensions, those that we run with.

    Spans are not among them: a task that finds no other running opens one, and all of them are kept as long as the scheduler lives, some
    10 kB each. Our tasks run one at a time.
    """
    return {name: extension for name, extension in extensions.items() if name != "spans"}


def _is_news(record: logging.LogRecord) -> bool:
    """Not what a task raised: that comes back with its future, and is told to whoever owns the job, or logged there."""
    return not record.getMessage().startswith("Compute Failed")


def configure() -> None:
    """Set Dask up in this process, before anything of it starts."""
    dask.config.set(_CONFIGURATION)
    # It reads its own logging settings when it is imported, which is over. Lost workers, the news it warns of, are ours to tell.
    logging.getLogger("distributed").setLevel(logging.ERROR)
    logging.getLogger("distributed.worker").addFilter(_is_news)
