"""News inside this process: who waits for a job hears at once that there is something to read. The store stays the only truth."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Subscription:
    """One listener's mailbox. `rows` is set when the store has something new; the event wakes it for that or for progress."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self.event = asyncio.Event()
        self.rows = True


class Hub:
    """Progress of running jobs, and a bell for each; called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._progress: dict[str, dict[str, Any]] = {}
        self._listeners: dict[str, set[Subscription]] = {}

    def tell(self, job: str) -> None:
        """The store has something new about a job."""
        self._ring(job, rows=True)

    def report(self, job: str, progress: dict[str, Any]) -> None:
        """A running job's progress, newest first and only; it is not stored."""
        with self._lock:
            self._progress[job] = progress
        self._ring(job, rows=False)

    def forget(self, job: str) -> None:
        """A job runs no longer."""
        with self._lock:
            self._progress.pop(job, None)

    def progress(self, job: str) -> dict[str, Any] | None:
        """The last report of a running job."""
        with self._lock:
            return self._progress.get(job)

    @contextmanager
    def subscribe(self, job: str) -> Iterator[Subscription]:
        """Listen to a job, from the event loop of whoever calls."""
        mine = Subscription(asyncio.get_running_loop())
        with self._lock:
            self._listeners.setdefault(job, set()).add(mine)
        try:
            yield mine
        finally:
            with self._lock:
                self._listeners[job].discard(mine)
                if not self._listeners[job]:
                    del self._listeners[job]

    def listeners(self) -> int:
        """How many subscriptions there are."""
        with self._lock:
            return sum(map(len, self._listeners.values()))

    def _ring(self, job: str, rows: bool) -> None:
        with self._lock:
            for one in self._listeners.get(job, ()):
                one.rows = one.rows or rows
                # A loop that has closed since has nobody left to hear.
                if not one.loop.is_closed():
                    one.loop.call_soon_threadsafe(one.event.set)
