"""How fast paths are traced, and how much of that is Embree: the same rays, written down and asked again with nothing in between."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import FIRST_SAMPLES, uniform
from bake_core.bench.outcome import Series, curves
from bake_core.bench.targets import Subject
from bake_core.capture import Capture, capture_radiance
from bake_core.drawing import Drawing
from bake_core.environment import beside
from bake_core.prepared import Prepared, prepare
from bake_core.ray_log import ANY, NEAREST, RayLog, coherent_order, new_log, replay
from bake_core.scene_files import load_scene
from bake_core.tracer import Tracer

I64 = NDArray[np.int64]

# Of each probe: a bake's first pass, so that a path costs what it costs in one.
SAMPLES = FIRST_SAMPLES
# What is written down: some 160 MB, and a second or two of tracing.
_MOST_RAYS = 4_000_000
# A ray's share of them is guessed from so many probes.
_FIRST_PROBES = 4


@dataclass(frozen=True)
class Speed:
    """One scene on so many threads.

    Attributes
    ----------
    probes, paths : int
        Traced, with all that a bake does of them: sampling, shading, sums.
    nearest, any : float
        Rays a path, of both kinds of query.
    seconds : float
        Median over the runs.
    alone : float
        Median seconds of Embree alone, asked for the same rays in the same packets, in the order in which one thread traced them.
    ordered : float
        The same one by one, nearest hits first and then occlusions, each by octant and Morton code: about the best that sorting could do.
    """

    scene: str
    threads: int
    probes: int
    paths: int
    nearest: float
    any: float
    seconds: float
    alone: float
    ordered: float

    @property
    def rays(self) -> float:
        return self.paths * (self.nearest + self.any)


@dataclass(frozen=True)
class Throughput:
    """What :func:`measure` found."""

    speeds: tuple[Speed, ...]
    runs: int

    def document(self) -> dict[str, Any]:
        return asdict(self)

    def rows(self) -> list[dict[str, Any]]:
        return [
            {
                **asdict(s),
                "paths_per_second": s.paths / s.seconds,
                "rays_per_second": s.rays / s.seconds,
                "share_inside_embree": s.alone / s.seconds,
            }
            for s in self.speeds
        ]

    def table(self) -> list[tuple[str, ...]]:
        """Head and rows as people read them."""
        alone = ("Embree alone, M rays/s", "share of the time", "sorted, M rays/s")
        rows: list[tuple[str, ...]] = [("scene", "threads", "M paths/s", "M rays/s", "rays a path", *alone)]
        rows += [
            (
                s.scene,
                str(s.threads),
                f"{s.paths / s.seconds / 1e6:.2f}",
                f"{s.rays / s.seconds / 1e6:.1f}",
                f"{s.nearest:.2f} + {s.any:.2f}",
                f"{s.rays / s.alone / 1e6:.1f}",
                f"{100 * s.alone / s.seconds:.0f} %",
                f"{s.rays / s.ordered / 1e6:.1f}",
            )
            for s in self.speeds
        ]
        return rows

    def notes(self) -> list[str]:
        return [
            f"Medians of {self.runs} runs in turns. Rays a path: nearest hits + occlusions. Embree alone is asked for the rays of these "
            "paths, in the same order and the same packets; the share of the time is its seconds over ours, filling in the ray included. "
            "Sorted: the same rays one by one, by octant and Morton code, the seconds of sorting not counted."
        ]

    def plot(self) -> Drawing:
        """Rays a second by threads."""
        series = []
        for scene in dict.fromkeys(s.scene for s in self.speeds):
            some = [s for s in self.speeds if s.scene == scene]
            series.append(Series(f"{scene}, traced", [(s.threads, s.rays / s.seconds / 1e6) for s in some]))
            series.append(Series(f"{scene}, Embree alone", [(s.threads, s.rays / s.alone / 1e6) for s in some]))
        return curves(series, "Millions of rays a second", "threads")


def measure(subjects: Sequence[Subject], *, threads: int, runs: int, say: Callable[[str], None]) -> Throughput:
    """Trace and ask again, on one thread and on all.

    Parameters
    ----------
    threads : int
        All of them.
    runs : int
        Of each; they alternate.
    say : callable
        Told a line after each scene.
    """
    speeds: list[Speed] = []
    for subject in subjects:
        prepared = prepare(load_scene(subject.scene), subject.spec, beside(subject.images))
        chosen, log = _record(prepared)
        any_hit = log.kinds == ANY
        order = np.concatenate([at[coherent_order(log.rays[at])] for at in (np.flatnonzero(~any_hit), np.flatnonzero(any_hit))])
        rays, kinds = log.rays[order], np.where(any_hit[order], ANY, NEAREST).astype(np.uint8)
        handle = prepared.tracer.tables.handle
        # Kernels compile, or come from the disk, before any clock runs.
        trace_once(prepared, prepared.tracer, chosen[:1], 1)
        replay(handle, rays[:1], kinds[:1])
        counts = sorted({1, threads})
        seconds: dict[tuple[int, str], list[float]] = {(n, way): [] for n in counts for way in ("traced", "alone", "ordered")}
        for _ in range(runs):
            for n in counts:
                seconds[n, "traced"].append(seconds_of(trace_once, prepared, prepared.tracer, chosen, n))
                seconds[n, "alone"].append(seconds_of(replay, handle, log.rays, log.kinds, threads=n))
                seconds[n, "ordered"].append(seconds_of(replay, handle, rays, kinds, threads=n))
        paths = len(chosen) * prepared.selection.capture**2 * SAMPLES
        share = [float(some.sum()) / paths for some in (~any_hit, any_hit)]
        for n in counts:
            traced, alone, sorted_ = (statistics.median(seconds[n, way]) for way in ("traced", "alone", "ordered"))
            speeds.append(Speed(subject.name, n, len(chosen), paths, share[0], share[1], traced, alone, sorted_))
            say(f"{subject.name}, {n} threads: {paths / traced / 1e6:.2f} M paths/s, {100 * alone / traced:.0f} % of the time in Embree")
    return Throughput(tuple(speeds), runs)


def seconds_of(call: Callable[..., object], *arguments: Any, **more: Any) -> float:
    """Of wall time that a call takes."""
    began = time.perf_counter()
    call(*arguments, **more)
    return time.perf_counter() - began


def _record(prepared: Prepared) -> tuple[I64, RayLog]:
    """Probes that are needed, evenly spread, as many as there is room for the rays of; and those rays, in order."""
    needed = np.flatnonzero(prepared.needed)
    few = needed[:: -(-len(needed) // _FIRST_PROBES)]
    counted = new_log(0)
    trace_once(prepared, logging_tracer(prepared.tracer, counted), few, 1)
    wanted = max(1, min(len(needed), int(_MOST_RAYS * len(few) / max(int(counted.asked[0]), 1))))
    chosen = needed[np.linspace(0, len(needed) - 1, wanted).round().astype(np.int64)]
    # First counted, then kept: there are as many as there are, and the guess is one.
    counted = new_log(0)
    trace_once(prepared, logging_tracer(prepared.tracer, counted), chosen, 1)
    log = new_log(int(counted.asked[0]))
    trace_once(prepared, logging_tracer(prepared.tracer, log), chosen, 1)
    return chosen, log


def logging_tracer(tracer: Tracer, log: RayLog) -> Tracer:
    """The same scene, every query of which is written down; for one thread."""
    return replace(tracer, tables=tracer.tables._replace(log=log))


def trace_once(prepared: Prepared, tracer: Tracer, probes: I64, threads: int) -> None:
    """A bake's first pass: its paths through every capture texel of some probes (n,)."""
    selection, spec = prepared.selection, prepared.spec
    capture_radiance(
        tracer,
        prepared.positions[probes],
        probes.astype(np.uint64),
        uniform(len(probes), (0, SAMPLES)),
        Capture(selection.capture, selection.irradiance, spec.seed, selection.keeps("radiance")),
        threads=threads,
        cancelled=np.zeros(1, np.uint8),
        advance=lambda _: None,
    )
