"""News inside this process: who waits for a job hears at once that there is something to read. The store stays the only truth."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Subscription:
    """One listener's mailbox: the event wakes it. `rung` is another number when the store has something new."""

    def __init__(self, loop: asyncio.AbstractEventLoop, rung: int) -> None:
        self.loop = loop
        self.event = asyncio.Event()
        self.rung = rung


class Hub:
    """Progress of running jobs, and a bell for each; called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._progress: dict[str, dict[str, Any]] = {}
        self._listeners: dict[str, set[Subscription]] = {}
        self._rings = 0

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
        with self._lock:
            mine = Subscription(asyncio.get_running_loop(), self._rings)
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
            self._rings += 1
            listeners = self._listeners.get(job, ())
            if rows:
                for one in listeners:
                    one.rung = self._rings
            # One call a loop: each is a system call, and hundreds may listen.
            for loop in {one.loop for one in listeners}:
                # A loop that has closed since has nobody left to hear.
                if not loop.is_closed():
                    loop.call_soon_threadsafe(self._wake, job, loop)

    def _wake(self, job: str, loop: asyncio.AbstractEventLoop) -> None:
        with self._lock:
            for one in self._listeners.get(job, ()):
                if one.loop is loop:
                    one.event.set()
