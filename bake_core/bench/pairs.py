"""Two ways to bake the same, in turns: adaptive sampling against uniform, leaving out against not, the light cache against paths."""

from __future__ import annotations

import math
import statistics
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from bake_core.bench.outcome import Series, error_against_seconds
from bake_core.bench.targets import Baked, Subject, bake_to, warm_up
from bake_core.drawing import Drawing
from bake_core.report import percent
from bake_core.spec import OUTPUTS, Stop

Question = Literal["adaptive", "leaving-out", "integrators"]


@dataclass(frozen=True)
class Way:
    """One of the two: what of the spec it changes, and how it is baked."""

    name: str
    changes: dict[str, Any]
    options: dict[str, Any]


WAYS: dict[Question, tuple[Way, Way]] = {
    "adaptive": (Way("adaptive", {}, {}), Way("uniform", {}, {"adaptive": False})),
    "leaving-out": (Way("left out", {}, {}), Way("all five outputs", {"outputs": OUTPUTS}, {})),
    "integrators": (Way("auto", {}, {}), Way("path", {"integrator": "path"}, {})),
}


@dataclass(frozen=True)
class Side:
    """Medians over the runs of one way."""

    way: str
    tracing: float
    seconds: float
    rays: int
    bytes: int
    error: float | None
    seconds_at_equal_error: float | None
    rays_at_equal_error: float | None


@dataclass(frozen=True)
class Pair:
    """Both sides on one scene; `equal_error` is the least error that both have reached."""

    scene: str
    equal_error: float | None
    sides: tuple[Side, Side]
    curves: tuple[list[tuple[float, float]], list[tuple[float, float]]]

    def ratio(self, what: str) -> float | None:
        """The second over the first: above 1, the first is better."""
        first, second = (getattr(s, what) for s in self.sides)
        return float(second / first) if first and second else None


@dataclass(frozen=True)
class Pairs:
    """What :func:`measure` found."""

    question: Question
    runs: int
    pairs: tuple[Pair, ...]

    def document(self) -> dict[str, Any]:
        return asdict(self)

    def rows(self) -> list[dict[str, Any]]:
        return [{"scene": p.scene, "equal_error": p.equal_error, **asdict(s)} for p in self.pairs for s in p.sides]

    def table(self) -> list[tuple[str, ...]]:
        equal = "seconds at equal error"
        rows: list[tuple[str, ...]] = [("scene", "way", "seconds", "tracing", "M rays", "MB", "error", equal)]
        for p in self.pairs:
            for s in p.sides:
                at = "–" if s.seconds_at_equal_error is None else f"{s.seconds_at_equal_error:.2f}"
                size = f"{s.bytes / 1e6:.2f}"
                rows.append((p.scene, s.way, f"{s.seconds:.2f}", f"{s.tracing:.2f}", f"{s.rays / 1e6:.1f}", size, percent(s.error), at))
            told = [p.ratio(k) for k in ("seconds", "tracing", "rays", "bytes", "error", "seconds_at_equal_error")]
            rows.append((p.scene, "ratio", *("–" if r is None else f"{r:.2f}×" for r in told)))
        return rows

    def notes(self) -> list[str]:
        return [
            f"Medians of {self.runs} alternating runs; a ratio is {self.pairs[0].sides[1].way} over {self.pairs[0].sides[0].way}."
            " Equal error is the least that both have reached; when, is read off each curve between its passes, straight in logarithms."
            if self.pairs
            else "Nothing was measured."
        ]

    def plot(self) -> Drawing:
        told = [(f"{p.scene}, {s.way}", c) for p in self.pairs for s, c in zip(p.sides, p.curves, strict=True)]
        return error_against_seconds([Series(name, points) for name, points in told])


def when(curve: Sequence[tuple[float, float]], error: float) -> float | None:
    """At which x a falling curve of (x, error) first gets down to an error, straight in logarithms between its points.

    None where it never does; its first point's where that is there already.
    """
    if curve and curve[0][1] <= error:
        return curve[0][0]
    for (x0, e0), (x1, e1) in pairwise(curve):
        if e1 <= error < e0:
            if e1 <= 0:
                return x1
            share = math.log(e0 / error) / math.log(e0 / e1)
            return x0 * math.exp(share * math.log(x1 / x0))
    return None


def measure(
    question: Question,
    subjects: Sequence[Subject],
    *,
    threads: int,
    stop: Stop,
    runs: int,
    say: Callable[[str], None],
) -> Pairs:
    """Bake every scene both ways, in turns.

    Parameters
    ----------
    stop : Stop
        When either side ends.
    runs : int
        Of each way; where one answer is wanted, it is the median's.
    say : callable
        Told a line after each bake.
    """
    pairs = []
    with tempfile.TemporaryDirectory(prefix="octobake-bench-") as folder:
        for subject in subjects:
            baked: tuple[list[Baked], list[Baked]] = ([], [])
            for way in WAYS[question]:
                warm_up(subject, threads, Path(folder), way.changes, **way.options)
            for run in range(runs):
                turns = list(zip(WAYS[question], baked, strict=True))
                # Whoever goes first in one run goes second in the next: neither always finds what the other has left in caches.
                for way, done in turns if run % 2 == 0 else reversed(turns):
                    done.append(bake_to(subject, stop, threads, Path(folder), way.changes, **way.options))
                    b = done[-1]
                    told = f"{b.samples} samples, error {percent(b.stated)}, {b.tracing:.2f} s of tracing"
                    say(f"{subject.name}, run {run + 1}/{runs}, {way.name}: {told}")
            pairs.append(_pair(question, subject.name, baked))
    return Pairs(question, runs, tuple(pairs))


def _pair(question: Question, name: str, baked: tuple[list[Baked], list[Baked]]) -> Pair:
    # The same spec gives the same samples: runs differ in time only.
    ends = [b[0].curve[-1][1] for b in baked if b[0].curve]
    equal = max(ends) if len(ends) == 2 and min(ends) > 0 else None
    sides = []
    for way, runs in zip(WAYS[question], baked, strict=True):
        first = runs[0]
        at = [None if equal is None else when(b.curve, equal) for b in runs]
        known = [a for a in at if a is not None]
        sides.append(
            Side(
                way.name,
                statistics.median(b.tracing for b in runs),
                statistics.median(b.seconds for b in runs),
                first.rays,
                first.bytes,
                first.stated,
                statistics.median(known) if known else None,
                None if equal is None else when(first.rays_curve, equal),
            )
        )
    return Pair(name, equal, (sides[0], sides[1]), (baked[0][0].curve, baked[1][0].curve))
