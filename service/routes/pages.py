"""The web pages: files beside this package, served as they are, and a bake's curve as it stands."""

from __future__ import annotations

from importlib.resources import files

from fastapi import APIRouter, Request
from fastapi.responses import Response
from pydantic import BaseModel

from bake_core.drawing import as_svg
from bake_core.error_plot import error_plot
from bake_core.rate import rate_by_samples
from service.jobs import Kind
from service.problems import RequestError
from service.routes.bodies import JsonRoute
from service.routes.common import Here
from service.routes.guard import COOKIE
from service.routes.jobs import find

router = APIRouter(include_in_schema=False, route_class=JsonRoute)

# Scripts, styles and data from here only: a label that is markup stays text even if a page should forget to escape it.
SECURITY = {"Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'"}
PAGES = {
    "/": ("index.html", "text/html"),
    # Whichever it is: its script looks at the address.
    "/web/bakes/{id}": ("bake.html", "text/html"),
    "/web/token.js": ("token.js", "text/javascript"),
    "/web/jobs.js": ("jobs.js", "text/javascript"),
    "/web/bake.js": ("bake.js", "text/javascript"),
    "/web/style.css": ("style.css", "text/css"),
}
HEADERS = {**SECURITY, "Cache-Control": "no-cache"}


class Session(BaseModel):
    """What the form on the first page sends. As JSON, which no other site's form can."""

    token: str


def _add(path: str, name: str, media_type: str) -> None:
    def page() -> Response:
        content = files("service").joinpath("web", name).read_bytes()
        return Response(content, headers=HEADERS, media_type=media_type)

    router.add_api_route(path, page, methods=["GET", "HEAD"], name=name)


for _path, (_name, _type) in PAGES.items():
    _add(_path, _name, _type)


@router.post("/web/session")
def open_session(body: Session, request: Request, service: Here) -> Response:
    """Keep a token for the pages, where no script can read it."""
    if service.tokens.find(body.token.strip()) is None:
        raise RequestError("request.bad_token", "this token is none of this service's", "body.token", 401)
    answer = Response(status_code=204)
    secure = request.url.scheme == "https"
    answer.set_cookie(COOKIE, body.token.strip(), httponly=True, samesite="strict", secure=secure)
    return answer


@router.get("/web/bakes/{id}/curve.svg")
def curve(id: str, service: Here) -> Response:
    """Plot a bake's error as it stands; its seconds are those since it began."""
    job = find(service, Kind.BAKE, id)
    points = [p.point for p in service.store.passes(id) if p.state is not None]
    plot = error_plot(points, job.request["spec"]["stop"]["target_error"], rate_by_samples(points), None, None)
    return Response(as_svg(plot), headers=HEADERS, media_type="image/svg+xml")
