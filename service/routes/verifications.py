"""Verifications: a bake's bundle rendered on software Vulkan and compared with a path-traced twin."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from bake_core.cameras import parse_cameras
from bake_core.thresholds import parse_thresholds
from service import documents
from service.jobs import ACTIVE, Job, Kind, State
from service.parts import Service
from service.problems import RequestError
from service.routes.accept import KEY_HEADER, WAIT_HEADER, Key, accepted, once, wait_as_asked
from service.routes.artefacts import GET_HEADERS, HEAD_HEADERS, artefact
from service.routes.bodies import JsonRoute
from service.routes.common import Here, failures, unknown
from service.routes.jobs import add_job_routes, find, not_there
from service.webhooks import check_url

PATH = "/v1/verifications"
MEDIA_TYPES = {"json": "application/json", "png": "image/png", "exr": "image/x-exr", "html": "text/html", "txt": "text/plain"}
router = APIRouter(prefix=PATH, tags=["verifications"], route_class=JsonRoute)


def _document(service: Service, job: Job, brief: bool) -> documents.Verification:
    names = sorted(job.result["files"]) if job.result and job.state == State.SUCCEEDED else []
    return documents.Verification(
        **documents.common(
            job,
            service.hub.progress(job.id) if job.state in ACTIVE else None,
            PATH,
            [] if brief else service.store.attempts(job.id),
            [] if brief or job.webhook is None else service.outbox.of_job(job.id),
            *(f"files/{name}" for name in names),
        ),
        bake=job.request["bake"],
        result=job.result,
    )


@router.post(
    "",
    operation_id="createVerification",
    summary="Queue a verification",
    status_code=202,
    response_model=documents.Verification,
    openapi_extra={"parameters": [KEY_HEADER, WAIT_HEADER]},
    responses={
        200: {"model": documents.Verification, "description": "It has finished within the wait."},
        **failures(400, 409, 413, 415, 422),
    },
)
async def create_verification(
    body: documents.VerificationRequest, request: Request, service: Here, response: Response
) -> documents.Verification:
    """Accept a verification of a bake that has succeeded."""

    def add(key: Key) -> Job:
        if body.cameras is not None:
            parse_cameras(body.cameras, "body.cameras")
        if body.thresholds is not None:
            parse_thresholds(body.thresholds, "body.thresholds")
        if body.webhook is not None:
            check_url(body.webhook, bool(service.settings.webhook_private))
        uses = _digests(service, body.bake)
        no_part_of_it = {"labels", "priority", "limits", "webhook", "keep_seconds", "pinned"}
        return service.store.add_job(
            Kind.VERIFICATION,
            body.model_dump(exclude=no_part_of_it, exclude_none=True),
            body.labels,
            body.priority,
            memory_bytes=body.limits.memory_bytes,
            webhook=body.webhook,
            pinned=body.pinned,
            ttl=body.keep_seconds,
            uses=uses,
            key=key,
        )

    job = await run_in_threadpool(once, service, request, body.model_dump(mode="json"), add)
    service.scheduler.wake()
    job = await wait_as_asked(service, request, response, job)
    accepted(response, job, PATH)
    return await run_in_threadpool(_document, service, job, False)


def _digests(service: Service, bake: str) -> list[str]:
    """The scene and the bundle that a verification reads."""
    found = service.store.job(bake, Kind.BAKE)
    if found is None:
        raise RequestError("bake.unknown", f"there is no bake {bake}", "body.bake", 422)
    if found.state != State.SUCCEEDED or found.result is None:
        raise RequestError("bake.no_bundle", f"the bake is {found.state}; only one that has succeeded can be verified", "body.bake", 422)
    return [found.request["scene"], found.result["bundle"]]


def _needs(service: Service, job: Job) -> list[str]:
    return _digests(service, job.request["bake"])


add_job_routes(router, Kind.VERIFICATION, documents.Verification, _document, _needs)


@router.get(
    "/{id}/files/{name:path}",
    openapi_extra=GET_HEADERS,
    operation_id="getVerificationFile",
    summary="A picture or a report of a verification",
    response_class=Response,
    responses={
        200: {"description": "The file.", "content": {t: {} for t in sorted(set(MEDIA_TYPES.values()))}},
        **failures(404, 409, 410, 412, 416),
    },
)
@router.head(
    "/{id}/files/{name:path}",
    openapi_extra=HEAD_HEADERS,
    operation_id="headVerificationFile",
    summary="Size and digest of such a file",
    response_class=Response,
    responses=failures(404, 409, 410, 412),
)
async def get_file(id: str, name: str, request: Request, service: Here) -> Response:
    """Answer one of the files that the result lists."""
    job = await run_in_threadpool(find, service, Kind.VERIFICATION, id)
    if job.state != State.SUCCEEDED or job.result is None:
        raise not_there(job, name)
    stored = job.result["files"].get(name)
    if stored is None:
        raise unknown("file", name)
    kind = MEDIA_TYPES.get(name.rpartition(".")[2], "application/octet-stream")
    return await artefact(request, service.blobs, stored["digest"], stored["bytes"], kind, name.rpartition("/")[2])
