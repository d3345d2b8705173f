"""Request bodies from strangers: counted while they arrive, JSON parsed strictly, uploads written to disk as they come."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Coroutine
from email.message import Message
from typing import Any

from fastapi import Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute

from bake_core import strict_json
from bake_core.errors import InputError
from service.blobs import Upload
from service.problems import RequestError

# Chunks arrive as the network cuts them; writing this much at a time keeps the thread hops few.
WRITE_BYTES = 1 << 20


def media_type(request: Request) -> str:
    """The request's media type, without parameters, in lower case; empty where it states none."""
    message = Message()
    message["content-type"] = request.headers.get("content-type", "")
    return message.get_content_type() if request.headers.get("content-type") else ""


async def limited(request: Request, limit: int) -> AsyncIterator[bytes]:
    """The body's chunks.

    Raises
    ------
    RequestError
        ``request.too_large``, before a byte is read where the length is declared.
    """
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > limit:
        raise _too_large(limit)
    size = 0
    async for chunk in request.stream():
        size += len(chunk)
        if size > limit:
            raise _too_large(limit)
        yield chunk


async def receive(request: Request, upload: Upload, limit: int) -> None:
    """Stream the body into `upload`."""
    pending: list[bytes] = []
    held = 0
    async for chunk in limited(request, limit):
        pending.append(chunk)
        held += len(chunk)
        if held >= WRITE_BYTES:
            await run_in_threadpool(upload.write, b"".join(pending))
            pending, held = [], 0
    await run_in_threadpool(upload.write, b"".join(pending))
    await run_in_threadpool(upload.close)


async def read_json(request: Request, limit: int) -> Any:
    """The body as JSON, strictly: see :mod:`bake_core.strict_json`."""
    if media_type(request) != "application/json":
        raise RequestError("request.unsupported_media_type", "send this with Content-Type: application/json", "Content-Type", 415)
    data = b"".join([chunk async for chunk in limited(request, limit)])
    return strict_json.parse(data, RequestError, "request", "body")


class JsonRoute(APIRoute):
    """A route whose JSON body is read by :func:`read_json`; the framework validates and documents it as ever."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Wrap the framework's handler."""
        handler = super().get_route_handler()

        async def strict(request: Request) -> Response:
            if self.body_field is None:
                return await handler(request)
            document = await read_json(request, request.app.state.service.settings.max_json_bytes)
            return await handler(_Parsed(request.scope, document))

        return strict


class _Parsed(Request):
    """A request whose body has been read; what the framework's handler gets instead of the raw bytes."""

    def __init__(self, scope: Any, document: Any) -> None:
        super().__init__(scope)
        self._document = document

    async def body(self) -> bytes:
        """Not empty, so that the framework asks for the JSON."""
        return b"{}"

    async def json(self) -> Any:
        """The document that the strict parser made."""
        return self._document


def _too_large(limit: int) -> InputError:
    # The rest of the body is not read, so this connection cannot carry another request.
    return RequestError("request.too_large", f"the body is larger than {limit} bytes", "body", 413, {"Connection": "close"})
