"""One job through the service and through `octobake bake`, in turns: `octobake bench service`, held to a goal."""

from __future__ import annotations

import statistics

from service.cli import bench_service
from tests.service.figures.table import Say


def measure(seconds: float, rounds: int, say: Say) -> None:
    """Ratio of the wall times from the command, or the request, to the bundle in a file."""
    found = bench_service.measure(seconds, rounds, lambda line: print(line, flush=True))
    say(f"service over octobake bake of {statistics.median(found.alone):.1f} s, median of {rounds} pairs", 100 * found.overhead, 3.0, "%")
