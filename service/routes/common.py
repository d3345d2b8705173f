"""What all routes say the same way."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Request

from service.parts import Service
from service.problems import MEDIA_TYPE, RequestError

_TEXTS = {
    400: "What was sent cannot be read.",
    401: "No token, or none of ours.",
    403: "The token is not good for this; `detail` says which scope is.",
    404: "There is no such thing.",
    409: "It is not there yet, or never will be; `slug` says which.",
    410: "Its time is up, and a clean-up has taken its files.",
    412: "A condition of the request does not hold.",
    413: "The body is too large.",
    415: "The body's media type is not one that is taken here.",
    416: "The range lies outside the file.",
    422: "What was sent is wrong; `slug`, `where` and `detail` say what.",
    429: "Too many requests from this address; `Retry-After` says when the next may come.",
    500: "A fault of the service itself.",
    503: "The service lacks something at the moment.",
}


def failures(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The problems that a route answers with, for the OpenAPI document."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": _TEXTS[status], "content": content} for status in statuses}


async def the_service(request: Request) -> Service:
    """The service that this application speaks for."""
    # A coroutine although it waits for nothing: the framework would call a function in another thread, for every request.
    service: Service = request.app.state.service
    return service


Here = Annotated[Service, Depends(the_service)]


def unknown(what: str, name: str) -> RequestError:
    """404: `what` (scene, bake, …) called `name` does not exist."""
    return RequestError(f"{what}.unknown", f"there is no {what} {name}", what, 404)
