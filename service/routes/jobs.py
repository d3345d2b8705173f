"""What bakes and verifications have in common: to be listed, looked at, cancelled and followed."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.convertors import StringConvertor, register_url_convertor

from service.documents import LABEL_KEY, PLAIN, Page
from service.joblog import log_lines
from service.jobs import FINISHED, Job, Kind, State
from service.parts import Service
from service.problems import RequestError
from service.routes.accept import RETRY_AFTER, WAIT_HEADER, wait_as_asked
from service.routes.common import Here, failures, unknown
from service.routes.events import event_stream
from service.routes.files import run_with_files


class _JobConvertor(StringConvertor):
    """An id has no colon: what follows one is a verb, which takes another method."""

    regex = "[^/:]+"


register_url_convertor("job", _JobConvertor())
Document = TypeVar("Document", bound=BaseModel)


# A key, a colon, a value.
Label = Annotated[str, Field(pattern=f"{LABEL_KEY[:-1]}:{PLAIN[1:]}", max_length=320)]


class Filter(BaseModel):
    """Which jobs to list."""

    model_config = ConfigDict(extra="forbid")

    state: State | None = None
    label: list[Label] = Field([], max_length=8, description="`key:value`; several must all hold.", examples=[["level:rooms"]])
    limit: int = Field(50, ge=1, le=500)
    cursor: str | None = Field(None, pattern="^[1-9][0-9]{0,17}$", description="`next` of the page before.")


def find(service: Service, kind: Kind, job: str) -> Job:
    """The job, or 404."""
    found = service.store.job(job, kind)
    if found is None:
        raise unknown(kind, job)
    return found


def not_there(job: Job, what: str) -> RequestError:
    """409: a file of a job that has not finished yet, or that never made one."""
    where = f"{job.kind} {job.id}"
    if job.state == State.EXPIRED:
        return RequestError("job.expired", f"the {job.kind}'s time is up, and its files are gone; requeue it, or pin the next", where, 410)
    if job.state in FINISHED:
        return RequestError("job.no_result", f"the {job.kind} has {job.state}, so there is no {what}", where, 409)
    headers = {"Retry-After": RETRY_AFTER}
    return RequestError("job.not_finished", f"the {job.kind} is {job.state}; its {what} comes when it has succeeded", where, 409, headers)


def add_job_routes(
    router: APIRouter,
    kind: Kind,
    model: type[Document],
    document: Callable[[Service, Job, bool], Document],
    needs: Callable[[Service, Job], Collection[str]],
) -> None:
    """Add the routes that do not depend on what a job does.

    `document` makes a job's JSON; its third argument says whether it stands in a list, where long parts are left out. `needs` names the
    files that a job is to be repeated with, and raises where one of them is gone.
    """
    name, noun = kind.capitalize(), str(kind)

    def list_jobs(service: Here, asked: Annotated[Filter, Query()]) -> Page[Document]:
        labels = dict(label.split(":", 1) for label in asked.label)
        before = None if asked.cursor is None else int(asked.cursor)
        jobs = service.store.list_jobs(kind, state=asked.state, labels=labels, before=before, limit=asked.limit + 1)
        more = len(jobs) > asked.limit
        jobs = jobs[: asked.limit]
        following = str(jobs[-1].sequence) if more else None
        return Page(items=[document(service, job, True) for job in jobs], next=following)

    async def get_job(id: str, request: Request, service: Here, response: Response) -> Document:
        job = await run_in_threadpool(find, service, kind, id)
        job = await wait_as_asked(service, request, response, job)
        if job.state not in FINISHED:
            response.headers["Retry-After"] = RETRY_AFTER
        return await run_in_threadpool(document, service, job, False)

    def cancel(service: Service, id: str) -> Job:
        find(service, kind, id)
        job = service.store.cancel(id)
        service.hub.tell(id)
        service.scheduler.cancel(id)
        return job

    async def cancel_job(id: str, service: Here) -> Document:
        job = await run_in_threadpool(cancel, service, id)
        if job.state == State.CANCELLED and job.started is not None:
            # It was queued by a restart, with a part of its work done.
            await run_with_files(service.blobs.remove_work, id)
        return await run_in_threadpool(document, service, job, False)

    def requeue_job(id: str, service: Here) -> Document:
        job = find(service, kind, id)
        if service.scheduler.drives(id):
            # Its sums are being swept away; a new try must not begin under the broom.
            headers = {"Retry-After": RETRY_AFTER}
            raise RequestError("job.not_finished", f"the {kind} is still being tidied up", f"{kind} {id}", 409, headers)
        job = service.store.requeue(id, needs(service, job))
        service.hub.tell(id)
        service.scheduler.wake()
        return document(service, job, False)

    def pin_job(id: str, service: Here) -> Document:
        find(service, kind, id)
        return document(service, service.store.pin(id, True), False)

    def unpin_job(id: str, service: Here) -> Document:
        find(service, kind, id)
        return document(service, service.store.pin(id, False), False)

    def job_log(id: str, service: Here) -> Response:
        find(service, kind, id)
        return PlainTextResponse("".join(f"{line}\n" for line in log_lines(service.store, id)))

    async def job_events(id: str, request: Request, service: Here) -> Response:
        await run_in_threadpool(find, service, kind, id)
        return event_stream(request, service, id)

    sse: dict[int | str, dict[str, Any]] = {
        200: {
            "description": "`state`, `plan`, `pass`, `stop` and `retry` events with ids; `progress` without.",
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
    for verb, call, summary, text, statuses in (
        (
            "requeue",
            requeue_job,
            "Try again a",
            "One that has failed, was cancelled or has expired begins anew, under its own id.",
            (404, 409, 422),
        ),
        ("pin", pin_job, "Keep the files of a", "No clean-up takes the files of a pinned one.", (404,)),
        ("unpin", unpin_job, "Let go of the files of a", "Its time counts again.", (404,)),
    ):
        add(
            f"/{{id}}:{verb}",
            call,
            methods=["POST"],
            operation_id=f"{verb}{name}",
            summary=f"{summary} {noun}",
            description=text,
            response_model=model,
            responses=failures(*statuses),
        )
    add(
        "/{id:job}",
        get_job,
        operation_id=f"get{name}",
        summary=f"A {noun}",
        response_model=model,
        openapi_extra={"parameters": [WAIT_HEADER]},
        responses=failures(404),
    )
    add(
        "/{id}/log",
        job_log,
        operation_id=f"get{name}Log",
        summary=f"What happened to a {noun}, a line each",
        response_class=PlainTextResponse,
        responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **failures(404)},
    )
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
