"""Content-addressed uploads: asked for first, sent once."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response

from service.blobs import DIGEST
from service.problems import RequestError
from service.routes.bodies import limited, receive
from service.routes.common import Here, failures, unknown
from service.routes.files import run_with_files

router = APIRouter(prefix="/v1/blobs", tags=["blobs"])
# In the document the pattern only: a name that is no digest is a blob that cannot exist, which the handlers say in their own way.
Name = Annotated[
    str, Path(description="`sha256:` and 64 hexadecimal digits, lower case.", json_schema_extra={"pattern": f"^{DIGEST.pattern}$"})
]


@router.head("/{digest}", operation_id="headBlob", summary="Is this blob here?", responses=failures(404, 422))
def head_blob(digest: Name, service: Here) -> Response:
    """Answer 200 with the size where the blob is here, 404 where it must be uploaded."""
    size = service.store.use_blob(_checked(digest))
    if size is None:
        raise unknown("blob", digest)
    return Response(headers={"Content-Length": str(size), "ETag": f'"{digest}"'}, media_type="application/octet-stream")


@router.put(
    "/{digest}",
    operation_id="putBlob",
    summary="Upload a blob",
    status_code=201,
    responses={204: {"description": "It was here already."}, **failures(413, 422)},
    openapi_extra={
        "requestBody": {"required": True, "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}
    },
)
async def put_blob(digest: Name, request: Request, service: Here) -> Response:
    """Stream a file to disk; it is kept if its digest is the one in the path. Sending it again changes nothing.

    With ``Expect: 100-continue`` a known one is answered before its bytes are sent.
    """
    _checked(digest)
    if await run_in_threadpool(service.store.use_blob, digest) is not None:
        if request.headers.get("expect", "").lower() != "100-continue":
            # It is on its way already, and an answer in the middle of it is an error to many clients.
            async for _ in limited(request, service.settings.max_upload_bytes):
                pass
        return Response(status_code=204)
    with service.blobs.upload() as upload:
        await receive(request, upload, service.settings.max_upload_bytes)
        if upload.digest != digest:
            raise RequestError("blob.digest_mismatch", f"the bytes that arrived have {upload.digest}; send them again", "body", 422)
        await run_with_files(upload.keep)
        await run_in_threadpool(service.store.add_blob, digest, upload.size)
    return Response(status_code=201)


def _checked(digest: str) -> str:
    if not DIGEST.fullmatch(digest):
        raise RequestError("blob.bad_digest", "a blob is named sha256: and 64 hexadecimal digits in lower case", "digest", 422)
    return digest
