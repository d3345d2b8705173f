"""Bakes."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field

import bake_core
from bake_core.placement import Volume, place
from bake_core.spec import Spec, parse_spec
from service import documents
from service.eta import eta_range
from service.jobs import ACTIVE, Job, Kind, State
from service.parts import Service
from service.problems import RequestError
from service.routes.accept import KEY_HEADER, RETRY_AFTER, WAIT_HEADER, Key, accepted, once, wait_as_asked
from service.routes.artefacts import GET_HEADERS, HEAD_HEADERS, artefact
from service.routes.bodies import JsonRoute
from service.routes.common import Here, failures
from service.routes.files import run_with_files
from service.routes.jobs import add_job_routes, find, not_there
from service.scenes import check_sky
from service.webhooks import check_url
from service.worker import PREVIEW

PATH = "/v1/bakes"
router = APIRouter(prefix=PATH, tags=["bakes"], route_class=JsonRoute)


class Asked(BaseModel):
    """How a bake is asked for."""

    model_config = ConfigDict(extra="forbid")

    validate_only: bool = Field(False, description="Only say whether this could be baked, and with which probes.")


def _document(service: Service, job: Job, brief: bool) -> documents.Bake:
    made = tuple(name for name in ("bundle", "report", "preview") if job.state == State.SUCCEEDED and name in (job.result or {}))
    passes = [] if brief else [p for p in service.store.passes(job.id) if p.state is not None]
    points = [p.point for p in passes]
    progress = service.hub.progress(job.id) if job.state in ACTIVE else None
    if progress is not None and not brief:
        progress = {**progress, "eta_range": eta_range(parse_spec(job.request["spec"]).stop, progress, points)}
    return documents.Bake(
        **documents.common(
            job,
            progress,
            PATH,
            [] if brief else service.store.attempts(job.id),
            [] if brief or job.webhook is None else service.outbox.of_job(job.id),
            *made,
        ),
        scene=job.request["scene"],
        spec=job.request["spec"],
        plan=job.plan,
        curve=[documents.Point(**asdict(point)) for point in points],
        result=job.result,
    )


@router.post(
    "",
    operation_id="createBake",
    summary="Queue a bake",
    status_code=202,
    response_model=documents.Bake,
    openapi_extra={
        "parameters": [
            KEY_HEADER,
            WAIT_HEADER,
            {
                "in": "header",
                "name": "Cache-Control",
                "description": "`no-cache`: bake again what has been baked before.",
                "schema": {"type": "string"},
                "example": "no-cache",
            },
        ]
    },
    responses={
        200: {
            "model": documents.Bake | documents.Validation,
            "description": "A finished bake: of the same scene, spec and version, and `Cache-Status` says so; or this one, after a wait. "
            "With validate_only: what it would be.",
        },
        **failures(400, 409, 413, 415, 422),
    },
)
async def create_bake(
    body: documents.BakeRequest, asked: Annotated[Asked, Query()], request: Request, service: Here, response: Response
) -> Any:
    """Accept a bake. Once this has answered, the job survives whatever happens to the service."""
    if asked.validate_only:
        spec, volumes = await run_with_files(_validate, service, body)
        answer = documents.Validation(
            valid=True,
            scene=body.scene,
            spec=spec.canonical(),
            volumes=[
                documents.Volume(name=v.name, origin=tuple(v.origin.tolist()), spacing=tuple(v.spacing.tolist()), counts=v.counts)
                for v in volumes
            ],
            probes=sum(v.probe_count for v in volumes),
        )
        return JSONResponse(answer.model_dump(mode="json"))
    fresh = "no-cache" in request.headers.get("cache-control", "").lower()
    hit = False

    def add(key: Key) -> Job:
        nonlocal hit
        spec, _ = _validate(service, body)
        canonical = spec.canonical()
        fingerprint = _fingerprint(body.scene, canonical)
        if not fresh and (known := service.store.finished_like(fingerprint)) is not None:
            hit = True
            if key is not None:
                service.store.give_key(*key, known.id)
            return known
        return service.store.add_job(
            Kind.BAKE,
            {"scene": body.scene, "spec": canonical},
            body.labels,
            body.priority,
            fingerprint=fingerprint,
            memory_bytes=body.limits.memory_bytes,
            webhook=None if body.webhook is None else check_url(body.webhook, bool(service.settings.webhook_private)),
            pinned=body.pinned,
            ttl=body.keep_seconds,
            uses=_digests(service, body.scene, canonical),
            key=key,
        )

    job = await run_with_files(once, service, request, body.model_dump(mode="json"), add)
    if hit:
        # RFC 9211.
        response.headers["Cache-Status"] = "octobake; hit"
    service.scheduler.wake()
    job = await wait_as_asked(service, request, response, job)
    accepted(response, job, PATH)
    return await run_in_threadpool(_document, service, job, False)


def _validate(service: Service, body: documents.BakeRequest) -> tuple[Spec, tuple[Volume, ...]]:
    """The spec, narrowed by the limits, and its volumes in the scene; what does not fit is refused now, not after a wait in the queue."""
    spec = parse_spec(body.spec)
    limits = {"max_seconds": body.limits.seconds, "max_samples": body.limits.samples}
    narrower = {k: v for k, v in limits.items() if v is not None and v < (getattr(spec.stop, k) or math.inf)}
    spec = spec.model_copy(update={"stop": spec.stop.model_copy(update=narrower)})
    if body.webhook is not None:
        check_url(body.webhook, bool(service.settings.webhook_private))
    scene = service.store.scene(body.scene)
    if scene is None:
        raise RequestError("scene.unknown", f"there is no scene {body.scene}; add it with POST /v1/scenes", "body.scene", 422)
    volumes = place(service.outlines.get(body.scene, scene), spec)
    check_sky(service.sandbox, service.blobs, spec.environment)
    return spec, volumes


def _fingerprint(scene: str, spec: dict[str, Any]) -> str:
    """What decides a bundle's bytes, and its format."""
    return hashlib.sha256(json.dumps([bake_core.__version__, scene, spec], sort_keys=True).encode()).hexdigest()


def _digests(service: Service, scene: str, spec: dict[str, Any]) -> list[str]:
    """The scene and every blob that a bake reads."""
    row = service.store.scene(scene)
    if row is None:
        raise RequestError("scene.unknown", f"there is no scene {scene} any more; add it with POST /v1/scenes", "scene", 422)
    image = spec["environment"].get("image")
    return [scene, *row["files"].values(), *([image] if image else [])]


def _needs(service: Service, job: Job) -> list[str]:
    check_sky(service.sandbox, service.blobs, parse_spec(job.request["spec"]).environment)
    return _digests(service, job.request["scene"], job.request["spec"])


add_job_routes(router, Kind.BAKE, documents.Bake, _document, _needs)


@router.post(
    "/{id}:stop",
    operation_id="stopBake",
    summary="End a bake with what it has",
    response_model=documents.Bake,
    responses=failures(404, 409),
)
def stop_bake(id: str, service: Here) -> documents.Bake:
    """End a running bake with its whole passes: it succeeds, `stopped` is interrupt and `exit_code` 4."""
    job = find(service, Kind.BAKE, id)
    stopping = service.store.ask_stop(id)
    if stopping is None:
        where = f"bake {id}"
        if job.state != State.RUNNING:
            raise RequestError("job.not_running", f"the bake is {job.state}; only a running one can be stopped", where, 409)
        headers = {"Retry-After": RETRY_AFTER}
        raise RequestError(
            "job.no_pass", "its first pass is not whole, so there is nothing to keep yet; cancel it, or wait", where, 409, headers
        )
    service.hub.tell(id)
    service.scheduler.finish(id)
    return _document(service, stopping, False)


@router.get(
    "/{id}/plan",
    operation_id="getPlan",
    summary="What a bake does and leaves out",
    responses=failures(404, 409),
)
def get_plan(id: str, service: Here) -> documents.Plan:
    """Answer what is baked, what is left out and why, and what it takes; known once the scene was prepared."""
    job = find(service, Kind.BAKE, id)
    if job.plan is None:
        raise not_there(job, "plan")
    return documents.Plan(**job.plan)


@router.get(
    "/{id}/preview",
    operation_id="getPreview",
    summary="A first look at a bake",
    response_class=Response,
    responses={
        200: {
            "description": "Irradiance maps of some of the probes.",
            "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
        },
        304: {"description": "It is what If-None-Match says."},
        **failures(404, 409, 410, 412, 416),
    },
    openapi_extra=GET_HEADERS,
)
async def get_preview(id: str, request: Request, service: Here) -> Response:
    """Answer a picture of the last whole pass; while the bake runs it changes, and is not to be kept."""
    job = await run_in_threadpool(find, service, Kind.BAKE, id)
    if job.state in ACTIVE and (picture := await run_with_files(service.blobs.peek_work, id, PREVIEW)) is not None:
        return Response(picture, headers={"Cache-Control": "no-store"}, media_type="image/png")
    return await _file(service, request, id, "preview", "image/png", "png")


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
        **failures(404, 409, 410, 412, 416),
    },
)
@router.head(
    "/{id}/bundle",
    openapi_extra=HEAD_HEADERS,
    operation_id="headBundle",
    summary="Size and digest of a bake's bundle",
    response_class=Response,
    responses=failures(404, 409, 410, 412),
)
async def get_bundle(id: str, request: Request, service: Here) -> Response:
    """Answer the bundle, whole or a range of it; `ETag` and `Repr-Digest` are its sha256."""
    return await _file(service, request, id, "bundle", "application/zip", "zip")


@router.get(
    "/{id}/report",
    openapi_extra=GET_HEADERS,
    operation_id="getReport",
    summary="A bake's report",
    response_class=Response,
    responses={200: {"description": "report.json.", "content": {"application/json": {}}}, **failures(404, 409, 410, 412, 416)},
)
async def get_report(id: str, request: Request, service: Here) -> Response:
    """Answer report.json: what was done, how long it took, and the error against time."""
    return await _file(service, request, id, "report", "application/json", "json")


async def _file(service: Service, request: Request, id: str, what: str, media_type: str, suffix: str) -> Response:
    job = await run_in_threadpool(find, service, Kind.BAKE, id)
    if job.state != State.SUCCEEDED or job.result is None or what not in job.result:
        raise not_there(job, what)
    digest = job.result[what]
    size = await run_in_threadpool(service.store.blob_size, digest)
    assert size is not None, "a result names blobs that were recorded before it"
    return await artefact(request, service.blobs, digest, size, media_type, f"{id}.{suffix}")
