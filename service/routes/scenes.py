"""Scenes: what the reader accepts, by digest."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import ValidationError

from service import documents
from service.parts import Service
from service.problems import RequestError
from service.routes.bodies import media_type, read_json, receive
from service.routes.common import Here, failures, unknown
from service.routes.files import run_with_files

GLB_TYPES = ("model/gltf-binary", "application/octet-stream", "")
# What a GLB that is sent as a body is called; its digest does not depend on it.
GLB_NAME = "scene.glb"
ZIP_TYPE, ZIP_NAME = "application/zip", "scene.zip"

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])


@router.post(
    "",
    operation_id="createScene",
    summary="Add a scene",
    status_code=201,
    response_model=documents.Scene,
    responses={200: {"model": documents.Scene, "description": "It was here already."}, **failures(400, 413, 415, 422)},
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "model/gltf-binary": {"schema": {"type": "string", "format": "binary"}},
                ZIP_TYPE: {"schema": {"type": "string", "format": "binary"}},
                "application/json": {"schema": {"$ref": "#/components/schemas/SceneRequest"}},
            },
        }
    },
)
async def create_scene(request: Request, service: Here) -> Response:
    """Read a scene strictly, and keep it: a GLB or a zip of a glTF's folder as the body, or JSON that names blobs uploaded before."""
    kind = media_type(request)
    if kind == "application/json":
        body = await read_json(request, service.settings.max_json_bytes)
        return await run_with_files(_from_blobs, service, body)
    if kind not in (*GLB_TYPES, ZIP_TYPE):
        text = "send a GLB as model/gltf-binary, a zip as application/zip, or names of blobs as application/json"
        raise RequestError("request.unsupported_media_type", text, "Content-Type", 415)
    with service.blobs.upload() as upload:
        await receive(request, upload, service.settings.max_upload_bytes)
        name = ZIP_NAME if kind == ZIP_TYPE else GLB_NAME
        outline, contents = await run_with_files(service.outlines.read, name, {name: upload.path})
        await run_with_files(upload.keep)
        await run_in_threadpool(service.store.add_blob, upload.digest, upload.size)
        return await run_in_threadpool(_add, service, name, {name: upload.digest}, outline.digest, contents)


@router.get("/{digest}", operation_id="getScene", summary="What is in a scene", responses=failures(404))
def get_scene(digest: str, service: Here) -> documents.Scene:
    """Answer what the reader found in a scene that was added before."""
    scene = service.store.scene(digest)
    if scene is None:
        raise unknown("scene", digest)
    return documents.Scene(digest=digest, **scene["contents"])


def _from_blobs(service: Service, body: Any) -> Response:
    try:
        asked = documents.SceneRequest.model_validate(body)
    except ValidationError as e:
        raise RequestValidationError([{**d, "loc": ("body", *d["loc"])} for d in e.errors()]) from None
    paths: dict[str, Path] = {}
    for name, digest in asked.files.items():
        if service.store.blob_size(digest) is None:
            raise RequestError("blob.unknown", f"{digest} has not been uploaded", f"body.files.{name}", 422)
        paths[name] = service.blobs.local_path(digest)
    outline, contents = service.outlines.read(asked.root, paths)
    return _add(service, asked.root, asked.files, outline.digest, contents)


def _add(service: Service, root: str, files: Mapping[str, str], digest: str, contents: Mapping[str, Any]) -> Response:
    known = service.store.scene(digest) is not None
    service.store.add_scene(digest, root, files, contents)
    document = documents.Scene(digest=digest, **contents)
    headers = {"Location": f"/v1/scenes/{digest}"}
    return JSONResponse(document.model_dump(mode="json"), 200 if known else 201, headers)
