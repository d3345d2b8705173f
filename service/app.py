"""The service as an ASGI application: its parts, and the routes that speak for them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool

import bake_core
from bake_core.spec import Spec
from service import problems
from service.documents import Problem
from service.parts import Service
from service.routes import bakes, blobs, health, pages, scenes, verifications
from service.routes.health import Requests

DESCRIPTION = """Server-side global-illumination baking: a glTF scene and a grid of light probes go in, octahedral atlases with a
measured error come out. Upload (`PUT /v1/blobs`, `POST /v1/scenes`), bake (`POST /v1/bakes`), follow (`/events`), fetch (`/bundle`).
Errors are RFC 9457 problems with a stable `slug`."""


def create_app(service: Service) -> FastAPI:
    """The application; serving it starts the scheduler, and stopping to serve closes `service`."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await run_in_threadpool(service.scheduler.start)
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
    problems.install(app)
    for module in (blobs, scenes, bakes, verifications, health, pages):
        app.include_router(module.router)
    app.add_middleware(Requests)
    framework_openapi = app.openapi

    def openapi() -> dict[str, Any]:
        document = framework_openapi()
        schemas = document["components"]["schemas"]
        if "Spec" not in schemas:
            spec = Spec.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(spec.pop("$defs"))
            schemas["Spec"] = spec
            schemas["Problem"] = Problem.model_json_schema()
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
        return document

    app.openapi = openapi  # type: ignore[method-assign]  # the framework's documented way to extend it
    return app
