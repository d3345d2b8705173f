"""A stored file over HTTP as RFC 9110 has it: strong ETag, conditions, one range, HEAD, and RFC 9530's Repr-Digest."""

from __future__ import annotations

import base64
import re

from fastapi import Request
from fastapi.responses import Response, StreamingResponse

from service.blobs import Blobs
from service.problems import RequestError

# What GET and HEAD take, for the OpenAPI document.
_CONDITIONS = ("If-Match", "If-None-Match")
HEAD_HEADERS = {"parameters": [{"in": "header", "name": name, "schema": {"type": "string"}} for name in _CONDITIONS]}
GET_HEADERS = {"parameters": [{"in": "header", "name": name, "schema": {"type": "string"}} for name in (*_CONDITIONS, "Range", "If-Range")]}
_RANGE = re.compile(r"bytes=(\d*)-(\d*)\Z")
_TAG = re.compile(r'(W/)?("[^"]*")')


async def artefact(request: Request, blobs: Blobs, digest: str, size: int, media_type: str, name: str) -> Response:
    """Answer GET or HEAD for the blob `digest`, to be saved as `name`.

    Raises
    ------
    RequestError
        ``request.precondition_failed`` (412) or ``request.range_not_satisfiable`` (416).
    BaseError, OSError
        Where the blob store cannot give it: before the answer has begun, so that the client is told.
    """
    etag = f'"{digest}"'
    # A finished job's files never change, so whoever has them need never ask again.
    headers = {"ETag": etag, "Cache-Control": "private, max-age=31536000, immutable", "Accept-Ranges": "bytes"}
    wanted = request.headers.get("if-match")
    if wanted is not None and not _matches(wanted, etag, weak=False):
        raise RequestError("request.precondition_failed", "the resource has another ETag", "If-Match", 412, headers)
    known = request.headers.get("if-none-match")
    if known is not None and _matches(known, etag, weak=True):
        return Response(status_code=304, headers=headers)

    start, end, status = 0, size, 200
    span = _range(request, etag, size)
    if span is not None:
        start, end = span
        status = 206
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    hashed = base64.b64encode(bytes.fromhex(digest.removeprefix("sha256:"))).decode()
    headers |= {
        "Repr-Digest": f"sha-256=:{hashed}:",
        "Content-Length": str(end - start),
        "Content-Disposition": f'attachment; filename="{name}"',
    }
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=media_type)
    return StreamingResponse(await blobs.open(digest, start, end), status, headers, media_type)


def _matches(field: str, etag: str, weak: bool) -> bool:
    """Whether a list of entity tags has `etag`; weak comparison ignores the W/ (RFC 9110, 8.8.3.2)."""
    return field.strip() == "*" or any(tag == etag and (weak or not w) for w, tag in _TAG.findall(field))


def _range(request: Request, etag: str, size: int) -> tuple[int, int] | None:
    """The asked half-open range, or None for the whole: no range, one that is not understood, several, or of another version."""
    match = _RANGE.match(request.headers.get("range", ""))
    if request.method != "GET" or match is None or match.groups() == ("", ""):
        return None
    # A date can not prove that the bytes are the same, so only our own tag counts.
    if request.headers.get("if-range", etag) != etag:
        return None
    first, last = match.groups()
    if not first:
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(int(last) + 1, size) if last else size
        if last and int(last) < int(first):
            return None
    if start >= end:
        headers = {"Content-Range": f"bytes */{size}", "ETag": etag}
        raise RequestError("request.range_not_satisfiable", f"there are {size} bytes", "Range", 416, headers)
    return start, end
