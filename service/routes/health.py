"""What machines ask: is it alive, does it work, and how much."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import bake_core
from service.problems import RequestError
from service.routes.common import Here, failures

router = APIRouter(tags=["health"])
# Answers by status; this process's, like everything Prometheus counts.
_answers: Counter[int] = Counter()


class Requests:
    """Counts answers, and tells browsers not to guess at what they are given."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                _answers[message["status"]] += 1
                message["headers"] = [*message["headers"], (b"x-content-type-options", b"nosniff")]
            await send(message)

        await self.app(scope, receive, counted)


@router.get("/healthz", operation_id="getHealth", summary="Is the process alive?")
def get_health() -> dict[str, str]:
    """Answer as long as the process answers anything."""
    return {"status": "ok", "version": bake_core.__version__}


@router.get("/readyz", operation_id="getReadiness", summary="Would a job be run now?", responses=failures(503))
def get_readiness(service: Here) -> dict[str, str]:
    """Answer 200 when the store answers and there are workers to give jobs to."""
    service.store.count_jobs()
    if not service.scheduler.ready:
        raise RequestError("service.not_ready", "the workers are starting", "scheduler", 503, {"Retry-After": "1"})
    return {"status": "ok"}


@router.get("/metrics", operation_id="getMetrics", summary="Figures for Prometheus", response_class=PlainTextResponse)
def get_metrics(service: Here) -> Response:
    """Answer gauges and counters in Prometheus' text format."""
    lines: list[str] = []

    def metric(name: str, kind: str, text: str, values: dict[str, Any]) -> None:
        lines.extend([f"# HELP octobake_{name} {text}", f"# TYPE octobake_{name} {kind}"])
        lines.extend(f"octobake_{name}{labels} {value}" for labels, value in values.items())

    counts = {f'{{state="{state}"}}': n for state, n in service.store.count_jobs().items()}
    metric("info", "gauge", "Version.", {f'{{version="{bake_core.__version__}"}}': 1})
    metric("jobs", "gauge", "Jobs by state.", counts)
    metric("ready", "gauge", "Whether jobs would be run now.", {"": int(service.scheduler.ready)})
    metric("listeners", "gauge", "Clients that follow a job.", {"": service.hub.listeners()})
    metric("http_responses_total", "counter", "Answers by status.", {f'{{status="{s}"}}': n for s, n in sorted(_answers.items())})
    metric("memory_bytes", "gauge", "Resident memory of this process.", {"": _resident_bytes()})
    return PlainTextResponse("\n".join(lines) + "\n", media_type="text/plain; version=0.0.4; charset=utf-8")


def _resident_bytes() -> int:
    # Second figure of statm: resident pages.
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
