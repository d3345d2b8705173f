"""The web pages: files beside this package, served as they are, and a bake's curve as it stands."""

from __future__ import annotations

from importlib.resources import files

from fastapi import APIRouter
from fastapi.responses import Response

from bake_core.drawing import as_svg
from bake_core.error_plot import error_plot
from bake_core.rate import rate_by_samples
from service.jobs import Kind
from service.routes.common import Here
from service.routes.jobs import find

router = APIRouter(include_in_schema=False)

# Scripts, styles and data from here only: a label that is markup stays text even if a page should forget to escape it.
SECURITY = {"Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'"}
PAGES = {
    "/": ("index.html", "text/html"),
    # Whichever it is: its script looks at the address.
    "/web/bakes/{id}": ("bake.html", "text/html"),
    "/web/jobs.js": ("jobs.js", "text/javascript"),
    "/web/bake.js": ("bake.js", "text/javascript"),
    "/web/style.css": ("style.css", "text/css"),
}
HEADERS = {**SECURITY, "Cache-Control": "no-cache"}


def _add(path: str, name: str, media_type: str) -> None:
    def page() -> Response:
        content = files("service").joinpath("web", name).read_bytes()
        return Response(content, headers=HEADERS, media_type=media_type)

    router.add_api_route(path, page, methods=["GET", "HEAD"], name=name)


for _path, (_name, _type) in PAGES.items():
    _add(_path, _name, _type)


@router.get("/web/bakes/{id}/curve.svg")
def curve(id: str, service: Here) -> Response:
    """Plot a bake's error as it stands; its seconds are those since it began."""
    job = find(service, Kind.BAKE, id)
    points = [p.point for p in service.store.passes(id) if p.state is not None]
    plot = error_plot(points, job.request["spec"]["stop"]["target_error"], rate_by_samples(points), None, None)
    return Response(as_svg(plot), headers=HEADERS, media_type="image/svg+xml")
