"""The jobs that figures are taken of."""

from __future__ import annotations

from typing import Any

import httpx

from tests.service.running import BOX, Server, box_spec, wait_for

# Never done by itself.
ENDLESS = box_spec(samples=1_000_000, probes=(8, 8, 8))


def add_box(server: Server) -> str:
    """Upload the box; answers the scene's digest."""
    headers = {"Content-Type": "model/gltf-binary"}
    digest: str = httpx.post(f"{server.url}/v1/scenes", content=BOX, headers=headers, timeout=60).json()["digest"]
    return digest


def submit(server: Server, spec: dict[str, Any]) -> str:
    """Queue a bake of the box; answers its id."""
    answer = httpx.post(f"{server.url}/v1/bakes", json={"scene": add_box(server), "spec": spec}, timeout=60)
    job: str = answer.json()["id"]
    return job


def until_running(server: Server, job: str) -> None:
    """Wait until a job is traced."""
    wait_for(lambda: httpx.get(f"{server.url}/v1/bakes/{job}").json()["state"] == "running", 120)
