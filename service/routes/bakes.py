"""Bakes."""

from __future__ import annotations

from dataclasses import asdict

from fastapi import APIRouter, Request, Response

from bake_core.placement import place
from bake_core.spec import parse_spec
from service import documents
from service.jobs import Job, Kind, State
from service.parts import Service
from service.problems import RequestError
from service.routes.artefacts import GET_HEADERS, HEAD_HEADERS, artefact
from service.routes.bodies import JsonRoute
from service.routes.common import Here, failures
from service.routes.jobs import accepted, add_job_routes, find, not_there
from service.scenes import check_sky

PATH = "/v1/bakes"
router = APIRouter(prefix=PATH, tags=["bakes"], route_class=JsonRoute)


def _document(service: Service, job: Job, brief: bool) -> documents.Bake:
    made = ("bundle", "report") if job.state == State.SUCCEEDED else ()
    passes = [] if brief else [p for p in service.store.passes(job.id) if p.state is not None]
    return documents.Bake(
        **documents.common(job, service.hub.progress(job.id), PATH, *made),
        scene=job.request["scene"],
        spec=job.request["spec"],
        curve=[documents.Point(**asdict(p.point)) for p in passes],
        result=job.result,
    )


@router.post("", operation_id="createBake", summary="Queue a bake", status_code=202, responses=failures(400, 413, 415, 422))
def create_bake(body: documents.BakeRequest, service: Here, response: Response) -> documents.Bake:
    """Accept a bake. Once this has answered, the job survives whatever happens to the service."""
    spec = parse_spec(body.spec)
    scene = service.store.scene(body.scene)
    if scene is None:
        raise RequestError("scene.unknown", f"there is no scene {body.scene}; add it with POST /v1/scenes", "body.scene", 422)
    # Volumes that do not fit this scene, and skies that cannot be read, are refused now, not after a wait in the queue.
    place(service.outlines.get(body.scene, scene), spec)
    check_sky(service.sandbox, service.blobs, spec.environment)
    job = service.store.add_job(Kind.BAKE, {"scene": body.scene, "spec": spec.canonical()}, body.labels, body.priority)
    accepted(service, response, job, PATH)
    return _document(service, job, False)


add_job_routes(router, Kind.BAKE, documents.Bake, _document)


@router.get(
    "/{id}/bundle",
    openapi_extra=GET_HEADERS,
    operation_id="getBundle",
    summary="Download a bake's bundle",
    response_class=Response,
    responses={
        200: {"description": "A zip.", "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}}},
        206: {"description": "The range that was asked for."},
        304: {"description": "It is what If-None-Match says."},
        **failures(404, 409, 412, 416),
    },
)
@router.head(
    "/{id}/bundle",
    openapi_extra=HEAD_HEADERS,
    operation_id="headBundle",
    summary="Size and digest of a bake's bundle",
    response_class=Response,
    responses=failures(404, 409, 412),
)
def get_bundle(id: str, request: Request, service: Here) -> Response:
    """Answer the bundle, whole or a range of it; `ETag` and `Repr-Digest` are its sha256."""
    return _file(service, request, id, "bundle", "application/zip", "zip")


@router.get(
    "/{id}/report",
    openapi_extra=GET_HEADERS,
    operation_id="getReport",
    summary="A bake's report",
    response_class=Response,
    responses={200: {"description": "report.json.", "content": {"application/json": {}}}, **failures(404, 409, 412, 416)},
)
def get_report(id: str, request: Request, service: Here) -> Response:
    """Answer report.json: what was done, how long it took, and the error against time."""
    return _file(service, request, id, "report", "application/json", "json")


def _file(service: Service, request: Request, id: str, what: str, media_type: str, suffix: str) -> Response:
    job = find(service, Kind.BAKE, id)
    if job.state != State.SUCCEEDED or job.result is None:
        raise not_there(job, what)
    digest = job.result[what]
    size = service.store.blob_size(digest)
    assert size is not None, "a result names blobs that were recorded before it"
    return artefact(request, service.blobs, digest, size, media_type, f"{id}.{suffix}")
