"""The service as an ASGI application: its parts, and the routes that speak for them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool

import bake_core
from bake_core.cameras import GivenCamera
from bake_core.spec import Spec
from bake_core.thresholds import Thresholds
from service import documents, problems
from service.parts import Service
from service.routes import bakes, blobs, cleanup, health, pages, scenes, verifications
from service.routes.common import failures
from service.routes.guard import Guard, needed_scope
from service.routes.health import Requests

DESCRIPTION = """Server-side global-illumination baking: a glTF scene and a grid of light probes go in, octahedral atlases with a
measured error come out. Upload (`PUT /v1/blobs`, `POST /v1/scenes`), bake (`POST /v1/bakes`), follow (`/events`), fetch (`/bundle`).
Errors are RFC 9457 problems with a stable `slug`."""
TOKENS = "Made by `octobake token create`, for one or several of the scopes submit, read and admin. None is needed on loopback."
REFERENCE = "#/components/schemas/{model}"


def create_app(service: Service) -> FastAPI:
    """The application; serving it starts the scheduler, and stopping to serve closes `service`."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await run_in_threadpool(service.start)
        yield
        await run_in_threadpool(service.close)

    app = describe()
    app.router.lifespan_context = lifespan
    app.state.service = service
    return app


def describe() -> FastAPI:
    """The application without a service behind it: enough to write its OpenAPI document."""
    app = FastAPI(
        title="octobake",
        version=bake_core.__version__,
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        openapi_url="/v1/openapi.json",
        docs_url=None,  # they load their scripts from elsewhere
        redoc_url=None,
        redirect_slashes=False,
    )
    routers = [module.router for module in (blobs, scenes, bakes, verifications, cleanup, health, pages)]
    for router in routers:
        app.include_router(router)
    problems.install(app, routers)
    app.add_middleware(Guard)
    app.add_middleware(Requests)
    framework_openapi = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            _complete(framework_openapi())
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # the framework's documented way to extend it
    return app


def _complete(document: dict[str, Any]) -> None:
    """Add what the framework cannot know to its OpenAPI document: the core's own schemas, and that errors are problems."""
    schemas = document["components"]["schemas"]
    for model in (Spec, GivenCamera, Thresholds, documents.Problem, documents.SceneRequest):
        schema = model.model_json_schema(ref_template=REFERENCE)
        schemas |= schema.pop("$defs", {}) | {model.__name__: schema}
    _replace_marks(schemas)
    # The framework says 422 of everything that takes a parameter; where a route can answer it, the route says so itself.
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer", "description": TOKENS}}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            scope = needed_scope(method.upper(), path)
            operation["security"] = [{"token": [scope]}, {}] if scope else []
            common = (401, 403, 429, 500, 503) if scope else (429, 500, 503)
            operation["responses"] |= {str(status): answer for status, answer in failures(*common).items()}
            if method == "post" and path in ("/v1/bakes", "/v1/verifications"):
                operation["responses"]["202"]["links"] = _links(document, f"{path}/{{id}}")
            if "HTTPValidationError" in str(operation["responses"].get("422")):
                del operation["responses"]["422"]


def _links(document: dict[str, Any], below: str) -> dict[str, Any]:
    """What can be asked of a job that was just accepted."""
    return {
        operation["operationId"]: {"operationId": operation["operationId"], "parameters": {"id": "$response.body#/id"}}
        for path, operations in document["paths"].items()
        for operation in operations.values()
        if path.startswith(below) and "{name}" not in path
    }


def _replace_marks(value: Any) -> None:
    """Put references where documents.MARK names a model, however deep."""
    if isinstance(value, dict):
        if model := value.pop(documents.MARK, None):
            del value["type"]
            value["$ref"] = REFERENCE.format(model=model)
        for part in value.values():
            _replace_marks(part)
    elif isinstance(value, list):
        for part in value:
            _replace_marks(part)
