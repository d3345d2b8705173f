"""Verifications: a bake's bundle rendered on software Vulkan and compared with a path-traced twin."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from bake_core.cameras import parse_cameras
from bake_core.thresholds import parse_thresholds
from service import documents
from service.jobs import Job, Kind, State
from service.parts import Service
from service.problems import RequestError
from service.routes.artefacts import GET_HEADERS, HEAD_HEADERS, artefact
from service.routes.bodies import JsonRoute
from service.routes.common import Here, failures, unknown
from service.routes.jobs import accepted, add_job_routes, find, not_there

PATH = "/v1/verifications"
MEDIA_TYPES = {"json": "application/json", "png": "image/png", "exr": "image/x-exr", "html": "text/html", "txt": "text/plain"}
router = APIRouter(prefix=PATH, tags=["verifications"], route_class=JsonRoute)


def _document(service: Service, job: Job, brief: bool) -> documents.Verification:
    names = sorted(job.result["files"]) if job.result else []
    return documents.Verification(
        **documents.common(job, service.hub.progress(job.id), PATH, *(f"files/{name}" for name in names)),
        bake=job.request["bake"],
        result=job.result,
    )


@router.post("", operation_id="createVerification", summary="Queue a verification", status_code=202, responses=failures(400, 413, 415, 422))
def create_verification(body: documents.VerificationRequest, service: Here, response: Response) -> documents.Verification:
    """Accept a verification of a bake that has succeeded."""
    bake = service.store.job(body.bake, Kind.BAKE)
    if bake is None:
        raise RequestError("bake.unknown", f"there is no bake {body.bake}", "body.bake", 422)
    if bake.state != State.SUCCEEDED:
        raise RequestError("bake.no_bundle", f"the bake is {bake.state}; only one that has succeeded can be verified", "body.bake", 422)
    if body.cameras is not None:
        parse_cameras(body.cameras, "body.cameras")
    if body.thresholds is not None:
        parse_thresholds(body.thresholds, "body.thresholds")
    request = body.model_dump(exclude={"labels", "priority"}, exclude_none=True)
    job = service.store.add_job(Kind.VERIFICATION, request, body.labels, body.priority)
    accepted(service, response, job, PATH)
    return _document(service, job, False)


add_job_routes(router, Kind.VERIFICATION, documents.Verification, _document)


@router.get(
    "/{id}/files/{name:path}",
    openapi_extra=GET_HEADERS,
    operation_id="getVerificationFile",
    summary="A picture or a report of a verification",
    response_class=Response,
    responses={
        200: {"description": "The file.", "content": {t: {} for t in sorted(set(MEDIA_TYPES.values()))}},
        **failures(404, 409, 412, 416),
    },
)
@router.head(
    "/{id}/files/{name:path}",
    openapi_extra=HEAD_HEADERS,
    operation_id="headVerificationFile",
    summary="Size and digest of such a file",
    response_class=Response,
    responses=failures(404, 409, 412),
)
def get_file(id: str, name: str, request: Request, service: Here) -> Response:
    """Answer one of the files that the result lists."""
    job = find(service, Kind.VERIFICATION, id)
    if job.state != State.SUCCEEDED or job.result is None:
        raise not_there(job, name)
    stored = job.result["files"].get(name)
    if stored is None:
        raise unknown("file", name)
    kind = MEDIA_TYPES.get(name.rpartition(".")[2], "application/octet-stream")
    return artefact(request, service.blobs, stored["digest"], stored["bytes"], kind, name.rpartition("/")[2])
