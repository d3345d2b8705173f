"""What tracing costs as a scene, its lamps, the grid or the machine grow: the exponent of cost against size."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bake_core.bake import bake
from bake_core.bench.outcome import Series, curves
from bake_core.bench.throughput import SAMPLES, seconds_of, trace_once
from bake_core.drawing import Drawing
from bake_core.examples import many_lamps, rough_floor
from bake_core.prepared import prepare
from bake_core.rate import Rate, in_words, rate_of_runs
from bake_core.scene_files import load_scene
from bake_core.spec import Spec, parse_spec

AXES = ("threads", "probes", "triangles", "emitters")
# Probes of the scenes whose size changes.
_GRID = 4
# What a cost is, by axis.
_COSTS = {
    "threads": "s of tracing",
    "probes": "s of a bake",
    "triangles": "µs a path",
    "emitters": "µs a path",
}


@dataclass(frozen=True)
class Cost:
    """What one size costs: the median over the runs, in the units of its axis."""

    axis: str
    size: int
    cost: float


@dataclass(frozen=True)
class Scale:
    """What :func:`measure` found."""

    costs: tuple[Cost, ...]
    runs: int

    def axes(self) -> list[str]:
        """Those that were measured."""
        return list(dict.fromkeys(c.axis for c in self.costs))

    def of(self, axis: str) -> list[Cost]:
        return [c for c in self.costs if c.axis == axis]

    def exponent(self, axis: str) -> Rate:
        """The slope of log cost against log size."""
        some = self.of(axis)
        return rate_of_runs([float(c.size) for c in some], [c.cost for c in some])

    def document(self) -> dict[str, Any]:
        return {**asdict(self), "exponents": {axis: asdict(self.exponent(axis)) for axis in self.axes()}}

    def rows(self) -> list[dict[str, Any]]:
        return [asdict(c) | {"unit": _COSTS[c.axis]} for c in self.costs]

    def table(self) -> list[tuple[str, ...]]:
        """Head and rows as people read them."""
        rows: list[tuple[str, ...]] = [("what grows", "size", "cost", "times the first", "exponent")]
        for c in self.costs:
            some = self.of(c.axis)
            slope = in_words(self.exponent(c.axis)) if c is some[-1] else ""
            rows.append((c.axis, f"{c.size:,}", f"{c.cost:.3g} {_COSTS[c.axis]}", f"{c.cost / some[0].cost:.2f}", slope))
        return rows

    def notes(self) -> list[str]:
        return [
            f"Medians of {self.runs} runs. Threads: the room of 1,000 triangles. Probes: whole bakes with {SAMPLES} samples, from "
            "reading to the bundle. Triangles: a room with a bumpy floor of so many. Emitters: a room with so many lamps, of the same "
            "light in all. The exponent is the slope of log cost against log size, with its standard error."
        ]

    def plot(self) -> Drawing:
        """Cost over that of the first size."""
        series = []
        for axis in self.axes():
            some = self.of(axis)
            series.append(Series(axis, [(c.size, c.cost / some[0].cost) for c in some]))
        return curves(series, "Cost against size", "size", "×")


def measure(sizes: dict[str, Sequence[int]], *, threads: int, runs: int, say: Callable[[str], None]) -> Scale:
    """Grow one thing at a time.

    Parameters
    ----------
    sizes : dict of str to sequence of int
        By axis (:data:`AXES`), the smallest first; an axis that is left out is not measured.
    threads : int
        Of all but the axis of that name.
    runs : int
        Of each; sizes of one axis alternate.
    say : callable
        Told a line after each size.
    """
    costs: list[Cost] = []
    with tempfile.TemporaryDirectory(prefix="octobake-bench-") as name:
        for axis in sizes:
            ready = {size: _ready(axis, size, threads, Path(name)) for size in sizes[axis]}
            taken: dict[int, list[float]] = {size: [] for size in ready}
            for call in ready.values():
                call()
            for _ in range(runs):
                for size, call in ready.items():
                    taken[size].append(call())
            for size, seconds in taken.items():
                costs.append(Cost(axis, size, statistics.median(seconds)))
                say(f"{axis}, {size:,}: {costs[-1].cost:.3g} {_COSTS[axis]}")
    return Scale(tuple(costs), runs)


def _ready(axis: str, size: int, threads: int, folder: Path) -> Callable[[], float]:
    """What measures one size, and answers its cost."""
    path = folder / f"{axis}-{size}.glb"
    glb, document = many_lamps(size) if axis == "emitters" else rough_floor(size if axis == "triangles" else 1000)
    path.write_bytes(glb)
    if axis == "probes":
        side = round(size ** (1 / 3))
        spec = _with_grid(document, (side, side, max(1, size // (side * side))))
        stop = spec.stop.model_copy(update={"target_error": None, "max_samples": SAMPLES})
        spec = spec.model_copy(update={"stop": stop})
        return lambda: seconds_of(bake, path, spec, folder / "bundle", threads=threads, audit_seconds=0)
    prepared = prepare(load_scene(path), _with_grid(document, (_GRID,) * 3))
    probes = np.arange(prepared.probe_count)
    if axis == "threads":
        return lambda: seconds_of(trace_once, prepared, prepared.tracer, probes, size)
    paths = len(probes) * prepared.selection.capture**2 * SAMPLES
    return lambda: 1e6 * seconds_of(trace_once, prepared, prepared.tracer, probes, threads) / paths


def _with_grid(document: dict[str, Any], counts: tuple[int, int, int]) -> Spec:
    """The room's spec with so many probes, half a spacing from its walls."""
    spacing = [2 / n for n in counts]
    grid = {
        "name": "room",
        "origin": [-1 + spacing[0] / 2, spacing[1] / 2, -1 + spacing[2] / 2],
        "spacing": spacing,
        "counts": list(counts),
    }
    return parse_spec({**document, "volumes": [grid]})
