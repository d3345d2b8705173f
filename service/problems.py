"""Every error leaves the service as an RFC 9457 problem, with the slug and the place that the core gave it."""

from __future__ import annotations

import errno
import logging
import sqlite3
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from fastapi.routing import APIRoute, APIRouter
from obstore.exceptions import BaseError
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException

from bake_core.errors import InputError, OctobakeError

MEDIA_TYPE = "application/problem+json"
log = logging.getLogger("octobake.http")
# Disks are emptied by people, or by jobs that finish: neither takes less.
RETRY_SECONDS = "60"

# What the framework raises by itself (routing, chiefly) has no slug of the core's.
FRAMEWORK_SLUGS = {
    404: ("request.not_found", "there is nothing here; the API is described at /v1/openapi.json"),
    405: ("request.method_not_allowed", "this resource does not take this method; see the Allow header"),
}


class RequestError(InputError):
    """A request that is wrong as a request, whatever it asks for.

    Parameters
    ----------
    status : int
        HTTP status; 400 for what cannot even be read.
    headers : mapping
        To go with the answer.
    """

    def __init__(self, slug: str, message: str, where: str = "", status: int = 400, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(slug, message, where)
        self.http_status = status
        self.headers = dict(headers or {})


def problem(status: int, slug: str, detail: str, where: str = "", headers: Mapping[str, str] | None = None) -> Response:
    """A problem document. `title` depends on the status alone, so that it can be translated; `detail` is for this occurrence."""
    document = {
        "type": f"urn:octobake:problem:{slug}",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "slug": slug,
        "where": where,
    }
    return JSONResponse(document, status, headers=dict(headers or {}), media_type=MEDIA_TYPE)


def install(app: FastAPI, routers: Sequence[APIRouter]) -> None:
    """Give `app`, whose routes are those of `routers`, an answer of this form to every exception."""

    async def ours(_: Request, error: Exception) -> Response:
        assert isinstance(error, OctobakeError)
        # A RequestError is an answer; what else is a server's fault is news for whoever runs it.
        if error.http_status >= 500 and not isinstance(error, RequestError):
            log.error("%s: %s", error.slug, error)
        return problem(error.http_status, error.slug, error.message, error.where, getattr(error, "headers", None))

    async def framework(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        slug, detail = FRAMEWORK_SLUGS.get(error.status_code, ("request.refused", str(error.detail)))
        headers = dict(error.headers or {})
        if error.status_code == 405:
            # The framework names the methods of the first route of this path only.
            routes = [route for router in routers for route in router.routes if isinstance(route, APIRoute)]
            methods = {m for route in routes if route.path_regex.match(request.url.path) for m in route.methods or ()}
            headers["Allow"] = ", ".join(sorted(methods))
        return problem(error.status_code, slug, detail, headers=headers)

    async def validation(_: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        return problem(422, *_complaint(error.errors()))

    async def unexpected(_: Request, error: Exception) -> Response:
        # Starlette raises it again after this answer, and the server logs its traceback.
        return problem(500, "service.internal", "an error of the service itself; its log has the traceback")

    async def system(_: Request, error: Exception) -> Response:
        if _disk_full(error):
            log.error("the disk is full: %s", error)
            text = "the service's disk is full; nothing was kept of this request: send it again once there is room"
            return problem(507, "service.disk_full", text, headers={"Retry-After": RETRY_SECONDS, "Connection": "close"})
        log.error("unexpected", exc_info=error)
        return problem(500, "service.internal", "an error of the service itself; its log has the traceback")

    async def store(_: Request, error: Exception) -> Response:
        log.error("the blob store cannot be used: %s", error)
        text = "the blob store cannot be used at the moment; nothing was kept of this request: send it again"
        return problem(503, "service.store_unavailable", text, headers={"Retry-After": RETRY_SECONDS, "Connection": "close"})

    app.add_exception_handler(BaseError, store)
    app.add_exception_handler(OSError, system)
    app.add_exception_handler(OperationalError, system)
    app.add_exception_handler(OctobakeError, ours)
    app.add_exception_handler(HTTPException, framework)
    app.add_exception_handler(RequestValidationError, validation)
    app.add_exception_handler(Exception, unexpected)


def _disk_full(error: Exception) -> bool:
    if isinstance(error, OperationalError):
        # SQLite's code, and PostgreSQL's class of it (53100, disk_full).
        code = getattr(error.orig, "sqlite_errorcode", None)
        return code == sqlite3.SQLITE_FULL or getattr(error.orig, "sqlstate", None) == "53100"
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def _complaint(details: Any) -> tuple[str, str, str]:
    """The slug, text and place of a failed validation: an unknown key first, since it explains the missing one."""
    first = min(details, key=lambda d: d["type"] != "extra_forbidden")
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    place = ""
    for part in first["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}" if place else str(part)
    if first["type"] == "extra_forbidden":
        return "request.unknown_key", f"is not a key of this request{more}", place
    if first["type"] == "missing":
        return "request.missing_key", f"is required{more}", place
    return "request.invalid", first["msg"].removeprefix("Value error, ") + more, place
