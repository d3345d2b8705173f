"""How long a bake will go on, at the least and at the most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from bake_core.clock import expected_samples
from bake_core.convergence import Point
from bake_core.spec import Stop


def eta_range(stop: Stop, progress: Mapping[str, Any], points: Sequence[Point]) -> tuple[float, float] | None:
    """Seconds to go.

    The estimate that there is takes the error to fall as 1/√N, which is Monte Carlo's rate and the slowest; the least time takes it to fall
    as 1/N, which is what scrambled Sobol' points reach on integrands without edges. A sample takes as long as in the fastest, or in the
    slowest, of the passes so far.

    Parameters
    ----------
    stop : Stop
        The bake's.
    progress : mapping
        A running bake's :class:`bake_core.progress.Progress`.
    points : sequence of Point
        One for each merged pass.
    """
    eta, seconds = progress["eta"], progress["seconds"]
    if eta is None:
        return None
    least, most = (eta if stop.target_error is None else 0.0), eta
    speeds = [(b.seconds - a.seconds) / (b.samples - a.samples) for a, b in pairwise([Point(0, 0, 0.0, None), *points])]
    if speeds and min(speeds) > 0:
        last = points[-1]
        left = eta / speeds[-1]
        spared = expected_samples(stop, last.samples, last.error) - _fewest_samples(stop, last.samples, last.error)
        least, most = max(0.0, left - spared) * min(speeds), left * max(speeds)
    if stop.max_seconds is not None:
        most = min(most, max(0.0, stop.max_seconds - seconds))
    return min(least, most), most


def _fewest_samples(stop: Stop, samples: int, error: float | None) -> int:
    if stop.target_error is None or error is None:
        return stop.max_samples
    total = samples
    # Passes double, so only after a doubling can a bake stop.
    while error > stop.target_error and total < stop.max_samples:
        total, error = total * 2, error / 2
    return min(total, stop.max_samples)
