"""What the service adds to a bake: the same job through it and by `octobake bake`, in turns; and how soon it answers."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from octobake_client import Client

from bake_core.bench.outcome import Series, curves
from bake_core.drawing import Drawing
from bake_core.errors import BakeError
from bake_core.examples import closed_box, cornell
from service.cli.alone import service_alone

# Bakes of so many samples, and then of this part of the length that is asked for, say how many samples make one of that length: of a short
# bake most is what it learns of the light.
_FIRST_SAMPLES = 64
_SECOND = 0.25
# Small jobs, one after the other, by which latencies are measured.
_LATENCY_JOBS = 50


@dataclass(frozen=True)
class ServiceCost:
    """What :func:`measure` found, in seconds.

    Attributes
    ----------
    alone, served : tuple of float
        From the command, or the request, to the bundle in a file; run by run.
    accepted, begun, done : tuple of float
        Of small jobs: until POST was answered, until the first news of it running, until its end was told.
    """

    alone: tuple[float, ...]
    served: tuple[float, ...]
    accepted: tuple[float, ...]
    begun: tuple[float, ...]
    done: tuple[float, ...]

    @property
    def overhead(self) -> float:
        """Median over the runs, as a part of the command's: the machine is not as fast in one run as in the next."""
        return statistics.median(served / alone for alone, served in zip(self.alone, self.served, strict=True)) - 1

    def document(self) -> dict[str, Any]:
        return {**asdict(self), "overhead": self.overhead}

    def rows(self) -> list[dict[str, Any]]:
        told = {"octobake bake": self.alone, "through the service": self.served}
        told |= {"POST to 202": self.accepted, "POST to running": self.begun, "POST to done": self.done}
        return [{"what": what, "runs": len(s), "p50": statistics.median(s), "p99": float(np.quantile(s, 0.99))} for what, s in told.items()]

    def table(self) -> list[tuple[str, ...]]:
        """Head and rows as people read them."""
        head: list[tuple[str, ...]] = [("what", "runs", "median, s", "99th percentile, s")]
        return head + [(r["what"], str(r["runs"]), f"{r['p50']:.3f}", f"{r['p99']:.3f}") for r in self.rows()]

    def notes(self) -> list[str]:
        return [
            f"The service adds {100 * self.overhead:+.1f} % to the Cornell box's bake, from command or upload to the bundle in a file "
            "(median of the runs' ratios). Latencies are of bakes of one probe with 16 samples, one after the other."
        ]

    def plot(self) -> Drawing:
        """Run by run."""
        ways = {"octobake bake": self.alone, "through the service": self.served}
        return curves(
            [Series(name, [(i + 1, s) for i, s in enumerate(way)]) for name, way in ways.items()], "Seconds of a bake", "run", " s"
        )


def measure(seconds: float, runs: int, say: Callable[[str], None]) -> ServiceCost:
    """Measure on a service of its own.

    Parameters
    ----------
    seconds : float
        How long the job is, about.
    runs : int
        Of the job, each way.
    say : callable
        Told a line after each.

    Raises
    ------
    BakeError
        ``bench.bake_failed``, with the command's own words.
    """
    glb, document = cornell()
    alone, served = [], []
    with tempfile.TemporaryDirectory(prefix="octobake-bench-") as name:
        folder = Path(name)
        scene = folder / "cornell.glb"
        scene.write_bytes(glb)
        spec = _stopped(document, _FIRST_SAMPLES)
        # Once for the caches, once for the figure.
        _bake(scene, spec)
        _, took = _bake(scene, spec)
        samples = max(_FIRST_SAMPLES, round(_FIRST_SAMPLES * _SECOND * seconds / took))
        _, took = _bake(scene, _stopped(document, samples))
        spec = _stopped(document, max(_FIRST_SAMPLES, round(samples * seconds / took)))
        with service_alone(folder) as url, Client(url) as client:
            small = folder / "box.glb"
            small.write_bytes(closed_box(0.5, 1.0)[0])
            latencies = _latencies(client, client.add_scene(small).digest)
            say(f"{len(latencies)} small jobs: POST answered after {1e3 * statistics.median(a for a, _, _ in latencies):.1f} ms")
        for run in range(runs):
            alone.append(_bake(scene, spec)[0])
            # A process of its own each, as the command has: one is several per cent faster than the next for as long as it lives. It has
            # baked before, as a service that runs has.
            with service_alone(folder) as url, Client(url) as client:
                _serve(client, small, _small(0))
                served.append(_serve(client, scene, spec))
            say(f"run {run + 1}/{runs}: octobake bake {alone[-1]:.2f} s, through the service {served[-1]:.2f} s")
    accepted, begun, done = zip(*latencies, strict=True)
    return ServiceCost(tuple(alone), tuple(served), accepted, begun, done)


def _stopped(document: dict[str, Any], samples: int) -> dict[str, Any]:
    return {**document, "stop": {"target_error": None, "max_samples": samples}}


def _small(seed: int) -> dict[str, Any]:
    """One probe."""
    grid = {"name": "one", "origin": [0.1, 0.1, 0.1], "spacing": [1, 1, 1], "counts": [1, 1, 1]}
    return {**_stopped({"version": 1, "volumes": [grid]}, 16), "seed": seed}


def _bake(scene: Path, spec: dict[str, Any]) -> tuple[float, float]:
    """Wall time of the command, and the seconds that it says it has baked."""
    path = scene.with_suffix(".json")
    path.write_text(json.dumps(spec))
    command = [sys.executable, "-m", "service.cli", "bake", str(scene), "--spec", str(path), "-o", str(scene.with_suffix(".zip")), "--json"]
    began = time.monotonic()
    ran = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise BakeError("bench.bake_failed", ran.stderr.strip().splitlines()[-1] if ran.stderr.strip() else "ended without a word")
    return time.monotonic() - began, json.loads(ran.stdout)["seconds"]


def _serve(client: Client, scene: Path, spec: dict[str, Any]) -> float:
    """From the upload to the bundle in a file."""
    began = time.monotonic()
    job = client.submit(client.add_scene(scene).digest, spec, fresh=True)
    client.fetch(client.wait(job).check(), scene.with_name("served.zip"))
    return time.monotonic() - began


def _latencies(client: Client, scene: str) -> Sequence[tuple[float, float, float]]:
    """Seconds until a small job was accepted, was under way and had ended; the first job, which loads kernels, is not among them."""
    taken = []
    for number in range(_LATENCY_JOBS + 1):
        spec = _small(number)
        began = time.monotonic()
        job = client.submit(scene, spec, fresh=True)
        accepted = time.monotonic() - began
        begun = 0.0
        for event in client.events(job):
            if not begun and event.type == "state" and event.document["state"] == "running":
                begun = time.monotonic() - began
        taken.append((accepted, begun, time.monotonic() - began))
    return taken[1:]
