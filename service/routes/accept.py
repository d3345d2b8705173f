"""A job is asked for: once however often the request comes, and with as much patience as the client has."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from fastapi import Request, Response
from fastapi.concurrency import run_in_threadpool

from service.jobs import FINISHED, Job
from service.parts import Service
from service.problems import RequestError

# Seconds after which a client that polls does well to ask again.
RETRY_AFTER = "1"
# Proxies give up on an answer after a minute.
MOST_WAIT = 50
# How late news of another process's doing may come.
POLL_SECONDS = 2.0
Key = tuple[str, str] | None
KEY_HEADER = {
    "in": "header",
    "name": "Idempotency-Key",
    "description": "Chosen by you. The same request with the same key is answered with the same job, for a day.",
    "schema": {"type": "string", "minLength": 1, "maxLength": 255, "pattern": "^[!-~]+$"},
    "example": "8e03978e-40d5-43dd-bc93-6894a57f9324",
}
WAIT_HEADER = {
    "in": "header",
    "name": "Prefer",
    "description": f"`wait=N`: the answer comes when the job has finished, or after N seconds (at most {MOST_WAIT}). RFC 7240.",
    "schema": {"type": "string"},
    "example": "wait=30",
}
_WAIT = re.compile(r"(?:^|[,;])\s*wait\s*=\s*\"?(\d{1,6})\"?\s*(?=$|[,;])", re.IGNORECASE)
_KEY = re.compile(r"[!-~]{1,255}")


def once(service: Service, request: Request, body: Mapping[str, Any], add: Callable[[Key], Job]) -> Job:
    """The job that `add` makes, or the one that this Idempotency-Key has led to before.

    `add` gives the key to the job in the transaction that adds it, so that a crash leaves both or neither.

    Raises
    ------
    RequestError
        ``request.key_in_flight`` (409) or ``request.key_reused`` (422).
    """
    name = request.headers.get("idempotency-key")
    if name is None:
        return add(None)
    if not _KEY.fullmatch(name):
        raise RequestError("request.invalid", "a key is 1 to 255 printable ASCII characters without spaces", "Idempotency-Key")
    key = request.scope["octobake.owner"], name
    content = json.dumps([request.url.path, request.url.query, body], sort_keys=True).encode()
    digest = hashlib.sha256(content).hexdigest()
    holder, job = service.store.take_key(*key, digest)
    if holder == "":
        try:
            return add(key)
        except BaseException:
            service.store.give_key(*key)
            raise
    if holder != digest:
        raise RequestError("request.key_reused", "this key came with another request before; choose a new one", "Idempotency-Key", 422)
    if job is None:
        headers = {"Retry-After": RETRY_AFTER}
        raise RequestError(
            "request.key_in_flight", "the first request with this key is still being answered", "Idempotency-Key", 409, headers
        )
    found = service.store.job(job)
    assert found is not None, "a key names a job that was added with it"
    return found


async def wait_as_asked(service: Service, request: Request, response: Response, job: Job) -> Job:
    """The job when it has finished, or when the client's ``Prefer: wait=N`` has run out."""
    match = _WAIT.search(request.headers.get("prefer", ""))
    if match is None:
        return job
    seconds = min(int(match[1]), MOST_WAIT)
    response.headers["Preference-Applied"] = f"wait={seconds}"
    deadline = time.monotonic() + seconds
    read: int | None = None
    with service.hub.subscribe(job.id) as news:
        while job.state not in FINISHED and (left := deadline - time.monotonic()) > 0:
            news.event.clear()
            if news.rung != read:
                read = news.rung
                job = await run_in_threadpool(_now, service, job)
                continue
            with suppress(TimeoutError):
                await asyncio.wait_for(news.event.wait(), min(left, POLL_SECONDS))
                continue
            read = None
    return await run_in_threadpool(_now, service, job)


def _now(service: Service, job: Job) -> Job:
    return service.store.job(job.id) or job


def accepted(response: Response, job: Job, path: str) -> None:
    """Where the job is, and when to ask again: 202, or 200 where there is nothing to wait for any more."""
    response.headers["Location"] = f"{path}/{job.id}"
    if job.state in FINISHED:
        response.status_code = 200
    else:
        response.headers["Retry-After"] = RETRY_AFTER
