"""How often the error that a bake states is right: `python -m tests.closed_form.coverage_table` prints the table of docs/method.md.

Bakes with every seed stop at their target by themselves, with adaptive sampling on. Each probe's 95 % interval either holds the truth or
does not; the truth is a uniform bake of 64 times the samples, whose own noise is at most an eighth of theirs and widens no interval. The
error that each bake states is held against the error that it has, and the mean of all seeds against the truth.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.bake import compile_kernels, gather
from bake_core.clock import Clock
from bake_core.convergence import DARK_FRACTION
from bake_core.environment import beside
from bake_core.examples import cornell, two_rooms
from bake_core.prepared import Prepared, prepare
from bake_core.report import Run
from bake_core.scene_files import load_scene
from bake_core.spec import Stop, parse_spec
from bake_core.tally import State
from tests.pavilion import pavilion_spec, write_pavilion

THREADS = len(os.sched_getaffinity(0))
PAIRS = 1000
TIMES = 64
# Of the Cornell box: every second probe of the example's own.
GRID = {"origin": [-0.75, 0.25, -0.75], "spacing": [0.5, 0.5, 0.5], "counts": [4, 4, 4]}


@dataclass(frozen=True)
class Coverage:
    """Of one scene.

    Attributes
    ----------
    pairs : int
        Of a probe and a seed.
    probes, texels : float
        Share of them whose interval holds the truth; the same of single texels.
    seeds, bounded : int
        Bakes, and those whose error is no larger than the 95 % bound that they state.
    bias, within : float
        How far irradiance, all probes and seeds together, is from the truth, and the standard error of that; shares of it.
    samples, allotted : float
        At the stop, and what an average probe had of them.
    """

    name: str
    pairs: int
    probes: float
    texels: float
    seeds: int
    bounded: int
    bias: float
    within: float
    samples: float
    allotted: float

    def row(self) -> str:
        """A row of the Markdown table."""
        cells = (
            self.name,
            f"{self.pairs:,}",
            f"{100 * self.probes:.1f} %",
            f"{100 * self.texels:.1f} %",
            f"{self.bounded} of {self.seeds}",
            f"{100 * self.bias:+.3f} ± {100 * self.within:.3f} %",
            f"{self.samples:.0f}",
            f"{100 * self.allotted:.0f} %",
        )
        return "| " + " | ".join(cells) + " |"


HEAD = (
    "| scene | (probe, seed) pairs | probes held | texels held | stated error held | bias | samples at the stop | of a uniform bake's |\n"
    "|---|---|---|---|---|---|---|---|"
)


def _example(folder: Path, glb: bytes, spec: dict[str, Any]) -> Prepared:
    (folder / "scene.glb").write_bytes(glb)
    return prepare(load_scene(folder / "scene.glb"), parse_spec(spec))


def _cornell(folder: Path) -> Prepared:
    glb, spec = cornell()
    return _example(folder, glb, {**spec, "volumes": [GRID], "integrator": "path"})


def _cached(folder: Path) -> Prepared:
    """The same by the light cache, which smooths: a bias that no interval knows of."""
    glb, spec = cornell()
    return _example(folder, glb, {**spec, "volumes": [GRID], "integrator": "cache"})


def _rooms(folder: Path) -> Prepared:
    """Half of the probes stand in the room that no light reaches, and get the least that any probe gets: a target beyond the pilot."""
    glb, spec = two_rooms()
    grid = {"origin": [-3.5, 0.5, -1.5], "spacing": [2.0, 1.0, 3.0], "counts": [4, 3, 2]}
    return _example(folder, glb, {**spec, "volumes": [grid]})


def _pavilion(folder: Path) -> Prepared:
    """Textures, gloss, cut-outs; a sun and a sky."""
    write_pavilion(folder)
    return prepare(load_scene(folder / "pavilion.glb"), parse_spec(pavilion_spec()), beside(folder))


def _courtyard(folder: Path) -> Prepared:
    """A room whose only light comes in through the roof that it lacks: an even sky."""
    glb, _ = cornell()
    environment = {"kind": "constant", "radiance": [1.0, 0.9, 0.8]}
    return _example(folder, glb, {"volumes": [GRID], "environment": environment, "max_bounces": 3, "integrator": "path"})


# Name, scene, target.
SCENES: tuple[tuple[str, Callable[[Path], Prepared], float], ...] = (
    ("a Cornell box", _cornell, 0.015),
    ("a Cornell box, light cache", _cached, 0.007),
    ("two rooms, one of them dark", _rooms, 0.003),
    ("a pavilion: textures, gloss, cut-outs, sun and sky", _pavilion, 0.016),
    ("a Cornell box under a sky, three bounces", _courtyard, 0.008),
)


def _baked(prepared: Prepared, seed: int, stop: Stop) -> State:
    spec = prepared.spec.model_copy(update={"seed": seed, "stop": stop})
    light = prepared.light and replace(prepared.light, seed=seed)
    return gather(replace(prepared, spec=spec, light=light), Run(THREADS, 1), Clock(spec, None))


def coverage(name: str, make: Callable[[Path], Prepared], target: float, pairs: int = PAIRS, times: int = TIMES) -> Coverage:
    """Bake with many seeds, and hold all intervals against one truth; at least so many pairs."""
    with tempfile.TemporaryDirectory() as folder:
        prepared = make(Path(folder))
    for kernels in (prepared, replace(prepared, light=None)):
        compile_kernels(kernels, audited=False)
    stop = Stop(target_error=target, max_samples=4096)
    first = _baked(prepared, 1, stop)
    truth = _baked(replace(prepared, light=None), 0, Stop(target_error=None, max_samples=times * first.samples)).mean()
    # A black probe's interval is a point and holds a truth that is exactly 0, which says nothing.
    lit = first.active() & truth.any((1, 2))
    whole = truth[lit].mean()
    seeds = -(-pairs // int(lit.sum()))
    held_probes, held_texels, bounded, deviations, samples, allotted = [], [], [], [], [], []
    for seed in range(1, 1 + seeds):
        state = first if seed == 1 else _baked(prepared, seed, stop)
        middle, half = (x[lit] for x in state.mean_interval())
        held_probes.append(np.abs(middle - truth[lit].mean((1, 2))) <= half)
        deviations.append(middle.mean() / whole - 1)
        middle, half = (x[lit] for x in state.texel_interval())
        held_texels.append((np.abs(middle - truth[lit]) <= half).mean())
        bounded.append(_error(state, truth) <= (state.error() or 0.0))
        samples.append(state.samples)
        allotted.append(state.taken[first.active()].sum(1).mean() / state.samples)
    held = np.concatenate(held_probes)
    return Coverage(
        name,
        len(held),
        held.mean(),
        float(np.mean(held_texels)),
        seeds,
        sum(bounded),
        float(np.mean(deviations)),
        # The truth has noise of its own, that of so many times the samples.
        float(np.std(deviations, ddof=1)) * math.sqrt(1 / seeds + 1 / times),
        float(np.mean(samples)),
        float(np.mean(allotted)),
    )


def _error(state: State, truth: NDArray[np.float64]) -> float:
    """DESIGN's figure where the truth is known."""
    active = state.active()
    square = (truth[active] ** 2).sum(-1)
    floor = (DARK_FRACTION * np.sqrt(square).mean()) ** 2
    return float(np.sqrt((((state.mean() - truth)[active] ** 2).sum(-1) / (square + floor)).mean()))


if __name__ == "__main__":
    print(HEAD)
    for scene in SCENES:
        print(coverage(*scene).row())
        sys.stdout.flush()
