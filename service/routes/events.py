"""A job's events as they happen (SSE): what is stored has an id and is replayed, progress is only ever the latest."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import suppress

from fastapi import Request
from fastapi.responses import Response
from sse_starlette import EventSourceResponse, ServerSentEvent

from service.feed import LINE_END
from service.parts import Service
from service.problems import RequestError

# The hub rings for what this process does; this is how late news of another process's doing may come.
POLL_SECONDS = 5.0
# Proxies close a silent connection after a minute, often after thirty seconds.
PING_SECONDS = 15


def event_stream(request: Request, service: Service, job: str) -> Response:
    """Replay a job's events after ``Last-Event-ID``, then follow it until it has finished.

    Raises
    ------
    RequestError
        ``request.invalid``, where Last-Event-ID is none of ours.
    """
    given = request.headers.get("last-event-id", "0")
    if not given.isdecimal() or len(given) > 18:
        raise RequestError("request.invalid", "is not an id that this service gave an event", "Last-Event-ID")
    return EventSourceResponse(_follow(service, job, int(given)), ping=PING_SECONDS, sep=LINE_END)


async def _follow(service: Service, job: str, last: int) -> AsyncIterator[ServerSentEvent | bytes]:
    shown = read = None
    with service.hub.subscribe(job) as news:
        while True:
            news.event.clear()
            if news.rung != read:
                # Noted before the store is asked: what is rung in the meantime is asked for again.
                read = news.rung
                page = await service.feed.after(job, last, read)
                for number, event in page.events:
                    last = number
                    yield event
                if page.over:
                    return
                if page.events:
                    read = None
                    continue
            progress = service.hub.progress(job)
            if progress is not None and progress != shown:
                shown = progress
                yield ServerSentEvent(json.dumps(progress), event="progress")
            with suppress(TimeoutError):
                await asyncio.wait_for(news.event.wait(), POLL_SECONDS)
                continue
            read = None
