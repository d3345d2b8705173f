"""Jobs' events as listeners are told of them; hundreds who wait for the same job share one look into the store."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from datetime import UTC, datetime

from fastapi.concurrency import run_in_threadpool
from sse_starlette import ServerSentEvent

from service.jobs import FINISHED, Event
from service.store import Store

# Events in one look: a listener's memory is bounded by it.
PAGE = 1000
LINE_END = "\n"


@dataclass(frozen=True)
class Page:
    """Some of a job's events: each one's id, and it as it goes over the wire. `over`: there are none, and none will come."""

    events: tuple[tuple[int, bytes], ...]
    over: bool


class Feed:
    """Pages of events, each read once for all who ask for it at the same time. Called from event loops."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._asked: dict[tuple[asyncio.AbstractEventLoop, str, int, int], asyncio.Task[Page]] = {}

    async def after(self, job: str, last: int, rung: int) -> Page:
        """The first page after event `last`; `rung` of the caller's subscription, so that nobody is given what was read before it rang."""
        key = (asyncio.get_running_loop(), job, last, rung)
        task = self._asked.get(key)
        if task is None:
            task = self._asked[key] = asyncio.create_task(run_in_threadpool(self._read, job, last))
            task.add_done_callback(lambda _: self._asked.pop(key))
        # One listener who leaves takes nothing from the others.
        return await asyncio.shield(task)

    def _read(self, job: str, last: int) -> Page:
        # The state first: what it was reached by is then among the events. A job that is queued again goes on.
        now = self._store.job(job)
        events = tuple((event.id, _encode(event)) for event in self._store.events(job, last, PAGE))
        return Page(events, not events and now is not None and now.state in FINISHED)


def _encode(event: Event) -> bytes:
    data = {"at": datetime.fromtimestamp(event.at, UTC).isoformat(), **event.data}
    return ServerSentEvent(json.dumps(data), event=event.type, id=str(event.id), sep=LINE_END).encode()
