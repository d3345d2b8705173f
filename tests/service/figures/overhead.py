"""One job through the service and through `octobake bake`, in turns."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from octobake_client import Client

from tests.service.figures.table import Say
from tests.service.running import BOX, Server, box_spec, octobake

# A bake this long says how many samples make one of the length that is asked for.
FIRST_SAMPLES = 1024
PROBES = (6, 6, 6)


def measure(folder: Path, seconds: float, rounds: int, say: Say) -> None:
    """Medians of the wall time from the command, or the request, to the bundle in a file."""
    (folder / "box.glb").write_bytes(BOX)
    # Once for the caches, once for the figure.
    _bake(folder, box_spec(FIRST_SAMPLES, PROBES))
    _, first = _bake(folder, box_spec(FIRST_SAMPLES, PROBES))
    spec = box_spec(max(FIRST_SAMPLES, round(FIRST_SAMPLES * seconds / first)), PROBES)
    alone, served = [], []
    server = Server(folder / "data")
    try:
        server.wait_ready()
        with server.client() as client:
            _serve(client, folder, box_spec(16, PROBES))
            for _ in range(rounds):
                alone.append(_bake(folder, spec)[0])
                served.append(_serve(client, folder, spec))
    finally:
        server.close()
    command, service = float(np.median(alone)), float(np.median(served))
    say(f"service over octobake bake of {command:.1f} s, medians of {rounds}", 100 * (service / command - 1), 3.0, "%")


def _bake(folder: Path, spec: dict[str, Any]) -> tuple[float, float]:
    """Wall time of the command, and the seconds that it says it has baked."""
    (folder / "spec.json").write_text(json.dumps(spec))
    began = time.monotonic()
    done = octobake("bake", folder / "box.glb", "--spec", folder / "spec.json", "-o", folder / "out.zip", "--json", timeout=3600)
    assert done.returncode == 0, done.stderr
    return time.monotonic() - began, json.loads(done.stdout)["seconds"]


def _serve(client: Client, folder: Path, spec: dict[str, Any]) -> float:
    began = time.monotonic()
    job = client.submit(client.add_scene(folder / "box.glb").digest, spec, fresh=True)
    client.fetch(client.wait(job).check(), folder / "served.zip")
    return time.monotonic() - began
