"""The web pages: files beside this package, served as they are."""

from __future__ import annotations

from importlib.resources import files

from fastapi import APIRouter
from fastapi.responses import Response

router = APIRouter(include_in_schema=False)

# Scripts, styles and data from here only: a label that is markup stays text even if a page should forget to escape it.
SECURITY = {"Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'"}
PAGES = {"/": ("index.html", "text/html"), "/web/jobs.js": ("jobs.js", "text/javascript"), "/web/style.css": ("style.css", "text/css")}


def _add(path: str, name: str, media_type: str) -> None:
    def page() -> Response:
        content = files("service").joinpath("web", name).read_bytes()
        return Response(content, headers={**SECURITY, "Cache-Control": "no-cache"}, media_type=media_type)

    router.add_api_route(path, page, methods=["GET", "HEAD"], name=name)


for _path, (_name, _type) in PAGES.items():
    _add(_path, _name, _type)
