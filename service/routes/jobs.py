"""What bakes and verifications have in common: to be listed, looked at, cancelled and followed."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field

from service.documents import Page
from service.jobs import FINISHED, Job, Kind, State
from service.parts import Service
from service.problems import RequestError
from service.routes.common import Here, failures, unknown
from service.routes.events import event_stream

Document = TypeVar("Document", bound=BaseModel)
# Seconds after which a client that polls does well to ask again.
RETRY_AFTER = "1"


class Filter(BaseModel):
    """Which jobs to list."""

    model_config = ConfigDict(extra="forbid")

    state: State | None = None
    label: list[str] = Field([], max_length=8, description="`key:value`; several must all hold.", examples=[["level:rooms"]])
    limit: int = Field(50, ge=1, le=500)
    cursor: str | None = Field(None, max_length=64, description="`next` of the page before.")


def find(service: Service, kind: Kind, job: str) -> Job:
    """The job, or 404."""
    found = service.store.job(job, kind)
    if found is None:
        raise unknown(kind, job)
    return found


def not_there(job: Job, what: str) -> RequestError:
    """409: a file of a job that has not finished yet, or that never made one."""
    where = f"{job.kind} {job.id}"
    if job.state in FINISHED:
        return RequestError("job.no_result", f"the {job.kind} has {job.state}, so there is no {what}", where, 409)
    headers = {"Retry-After": RETRY_AFTER}
    return RequestError("job.not_finished", f"the {job.kind} is {job.state}; its {what} comes when it has succeeded", where, 409, headers)


def accepted(service: Service, response: Response, job: Job, path: str) -> None:
    """202's headers; and the scheduler hears of the job."""
    response.headers["Location"] = f"{path}/{job.id}"
    response.headers["Retry-After"] = RETRY_AFTER
    service.scheduler.wake()


def add_job_routes(router: APIRouter, kind: Kind, model: type[Document], document: Callable[[Service, Job, bool], Document]) -> None:
    """Add the routes that do not depend on what a job does.

    `document` makes a job's JSON; its third argument says whether it stands in a list, where long parts are left out.
    """
    name, noun = kind.capitalize(), str(kind)

    def list_jobs(service: Here, asked: Annotated[Filter, Query()]) -> Page[Document]:
        labels = {}
        for label in asked.label:
            key, colon, value = label.partition(":")
            if not colon:
                raise RequestError("request.invalid", "a label filter is key:value", "label", 422)
            labels[key] = value
        before = None if asked.cursor is None else _cursor(asked.cursor)
        jobs = service.store.list_jobs(kind, state=asked.state, labels=labels, before=before, limit=asked.limit + 1)
        more = len(jobs) > asked.limit
        jobs = jobs[: asked.limit]
        following = base64.urlsafe_b64encode(str(jobs[-1].sequence).encode()).decode() if more else None
        return Page(items=[document(service, job, True) for job in jobs], next=following)

    def get_job(id: str, service: Here, response: Response) -> Document:
        job = find(service, kind, id)
        if job.state not in FINISHED:
            response.headers["Retry-After"] = RETRY_AFTER
        return document(service, job, False)

    def cancel_job(id: str, service: Here) -> Document:
        find(service, kind, id)
        job = service.store.cancel(id)
        if job.state == State.CANCELLED:
            # It was queued; a restart may have put it there with a part of its work done.
            service.blobs.remove_work(id)
        service.hub.tell(id)
        service.scheduler.cancel(id)
        return document(service, job, False)

    async def job_events(id: str, request: Request, service: Here) -> Response:
        await run_in_threadpool(find, service, kind, id)
        return event_stream(request, service, id)

    sse: dict[int | str, dict[str, Any]] = {
        200: {
            "description": "`state`, `pass` and `retry` events with ids; `progress` without.",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        }
    }
    add = router.add_api_route
    add("", list_jobs, operation_id=f"list{name}s", summary=f"List {noun}s", response_model=Page[model], responses=failures(422))  # type: ignore[valid-type]
    add(
        "/{id}:cancel",
        cancel_job,
        methods=["POST"],
        operation_id=f"cancel{name}",
        summary=f"Cancel a {noun}",
        description="A queued job is cancelled at once, a running one within a second; a finished one stays as it is.",
        response_model=model,
        responses=failures(404),
    )
    add("/{id}", get_job, operation_id=f"get{name}", summary=f"A {noun}", response_model=model, responses=failures(404))
    add(
        "/{id}/events",
        job_events,
        operation_id=f"follow{name}",
        summary=f"Follow a {noun}",
        description="Server-sent events; those with an id are replayed after `Last-Event-ID`. The stream ends when the job has finished.",
        openapi_extra={"parameters": [{"in": "header", "name": "Last-Event-ID", "schema": {"type": "integer"}}]},
        responses={**sse, **failures(400, 404)},
        response_class=Response,
    )


def _cursor(text: str) -> int:
    try:
        sequence = int(base64.urlsafe_b64decode(text.encode("ascii")))
    except (ValueError, binascii.Error):
        sequence = 0
    # Beyond 63 bits no database has an integer.
    if not 0 < sequence < 2**63:
        raise RequestError("request.invalid", "is not a cursor that this service gave", "cursor", 422)
    return sequence
