"""Error against run time of our integrator and of installed peers: the same scene, texels and machine, in one run.

The work is radiance in octahedral texels of the spec's probes, and their irradiance maps, which a peer's texels are convolved to. Runs of
all contestants alternate, each with a seed of its own; of each count of samples the median run counts. The error is against a reference of
ours, in two independent halves.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.bake import bake
from bake_core.bench.outcome import Series, error_against_seconds
from bake_core.bench.peers import Peer, cannot_render, find_peers, running, work
from bake_core.bench.reference import EPSILON, Maps, Reference, convolved_maps, read_reference, relative_mse, stored_maps
from bake_core.bundle import read_bundle
from bake_core.drawing import Drawing
from bake_core.environment import Find
from bake_core.errors import BakeError
from bake_core.prepared import prepare
from bake_core.rate import Rate, in_words, rate_of_runs
from bake_core.scene_files import load_scene
from bake_core.spec import Spec, parse_spec

F64 = NDArray[np.float64]

# Probes that the reference is baked for: as many volumes of one probe as a spec may have.
REFERENCE_PROBES = 64


@dataclass(frozen=True)
class Measured:
    """One contestant at one count of samples.

    Attributes
    ----------
    seconds : float
        Median over the runs, of the bake alone: scene and kernels were ready.
    relative_mse, irradiance_mse : float
        Median over the runs; of radiance, and of irradiance maps.
    paths_per_second : float
    systematic : float or None
        √ of the part of it that no samples take away: mean((x₁ - A)(x₂ - B) / (r² + ε)) over independent runs x and halves A, B of the
        reference, each a mean of independent noise (negative where only noise is left: then 0). None with one run.
    bias, bias_error : float
        Mean of x - r over the mean of r, and its standard error from both sides' runs.
    """

    contestant: str
    samples: int
    seconds: float
    relative_mse: float
    irradiance_mse: float
    paths_per_second: float
    systematic: float | None
    bias: float
    bias_error: float | None

    @property
    def efficiency(self) -> float:
        """RelMSE × seconds: what does not change with the samples where independent ones are all there is. Less is better."""
        return self.relative_mse * self.seconds

    @property
    def irradiance_efficiency(self) -> float:
        """The same of irradiance maps."""
        return self.irradiance_mse * self.seconds


@dataclass(frozen=True)
class Contestant:
    """What was raced, and the seconds that it took to be ready."""

    name: str
    load: float
    compile: float


@dataclass(frozen=True)
class Convergence:
    """What :func:`measure` found."""

    contestants: tuple[Contestant, ...]
    left_out: tuple[tuple[str, str], ...]
    runs: int
    probes: int
    side: int
    irradiance_side: int
    reference: str
    reference_noise: float | None
    measured: tuple[Measured, ...]

    def of(self, name: str) -> list[Measured]:
        return [m for m in self.measured if m.contestant == name]

    def rate(self, name: str) -> Rate:
        """Of √relMSE against seconds."""
        points = [(m.seconds, m.relative_mse**0.5) for m in self.of(name)]
        return rate_of_runs([s for s, _ in points], [e for _, e in points])

    def document(self) -> dict[str, Any]:
        return {**asdict(self), "rates": {c.name: asdict(self.rate(c.name)) for c in self.contestants}}

    def rows(self) -> list[dict[str, Any]]:
        return [{**asdict(m), "efficiency": m.efficiency, "irradiance_efficiency": m.irradiance_efficiency} for m in self.measured]

    def table(self) -> list[tuple[str, ...]]:
        """Head and rows as people read them."""
        head: tuple[str, ...] = ("integrator", "samples", "seconds", "M paths/s", "relMSE", "relMSE × s")
        head += ("of irradiance", "× s", "bias", "systematic", "rate")
        lines = [head]
        for m in self.measured:
            bias = f"{100 * m.bias:+.3f} %" + ("" if m.bias_error is None else f" ± {100 * m.bias_error:.3f}")
            last = m is self.of(m.contestant)[-1]
            lines.append(
                (
                    m.contestant,
                    str(m.samples),
                    f"{m.seconds:.3g}",
                    f"{m.paths_per_second / 1e6:.2f}",
                    f"{m.relative_mse:.2e}",
                    f"{m.efficiency:.2e}",
                    f"{m.irradiance_mse:.2e}",
                    f"{m.irradiance_efficiency:.2e}",
                    bias,
                    "–" if m.systematic is None else f"{100 * m.systematic:.2f} %",
                    in_words(self.rate(m.contestant)) if last else "",
                )
            )
        return lines

    def notes(self) -> list[str]:
        noise = "" if self.reference_noise is None else f", its own relMSE {self.reference_noise:.1e}"
        told = [
            f"{self.probes} probes of {self.side}² texels of radiance, medians of {self.runs} alternating runs; relMSE, ε = {EPSILON:g}. "
            f"Of irradiance: maps of {self.irradiance_side}², over π; peers' are their texels convolved, which costs them no seconds. "
            "Ours makes both and finds solids in its seconds, and is read back as stored.",
            f"Reference: {self.reference}{noise}.",
        ]
        told += [f"{c.name}: {c.load:.1f} s to load the scene, {c.compile:.1f} s to compile, not counted." for c in self.contestants]
        told += [f"{name} was left out: {why}." for name, why in self.left_out]
        return told

    def plot(self) -> Drawing:
        races = [(c.name, [(m.seconds, m.relative_mse**0.5) for m in self.of(c.name)]) for c in self.contestants]
        return error_against_seconds([Series(name, points, self.rate(name)) for name, points in races])


class _Ours:
    """Bakes with exactly so many samples; the seconds are those of tracing."""

    def __init__(self, scene: Path, spec: Spec, find: Find, threads: int, folder: Path, integrator: str = "path") -> None:
        self._scene, self._find, self._threads, self._folder = scene, find, threads, folder
        self._spec = spec.model_copy(update={"integrator": integrator})
        self.name = f"octobake, {integrator}"
        self._stages: dict[str, float] = {}
        self.render(1, 0)
        self.load, self.compile = self._stages["reading"] + self._stages["building"], self._stages["compiling"]

    def render(self, samples: int, seed: int) -> tuple[Maps, float]:
        stop = self._spec.stop.model_copy(update={"target_error": None, "max_seconds": None, "max_samples": samples})
        # None of the scrambles of one run is that of another: a seed is hashed with all that picks one.
        spec = self._spec.model_copy(update={"stop": stop, "seed": self._spec.seed + seed})
        out = self._folder / "bundle"
        result = bake(self._scene, spec, out, threads=self._threads, find=self._find)
        self._stages = result.run.stages
        return stored_maps(read_bundle(out)), self._stages["tracing"]


class _Theirs:
    """A peer, whose texels of radiance are all that it says of irradiance in m × m directions."""

    def __init__(self, peer: Peer, m: int) -> None:
        self._peer, self._m = peer, m
        self.name, self.load, self.compile = peer.name, peer.load, peer.compile

    def render(self, samples: int, seed: int) -> tuple[Maps, float]:
        tiles, seconds = self._peer.render(samples, seed)
        return convolved_maps(tiles.astype(np.float64), self._m), seconds


def measure(
    scene_path: Path,
    spec: Spec,
    *,
    find: Find,
    threads: int,
    samples: Sequence[int],
    runs: int,
    reference_samples: int,
    reference: Path | None,
    peers: Path | None,
    say: Callable[[str], None],
) -> Convergence:
    """Race.

    Parameters
    ----------
    samples : sequence of int
        Each a race of its own.
    reference_samples : int
        Of either half of the reference.
    reference : Path or None
        An .npz to take it from, or, where there is none, to keep it in: :meth:`bake_core.bench.reference.Reference.keep`.
    peers : Path or None
        Where the peers' environments are; see :func:`bake_core.bench.peers.find_peers`.
    say : callable
        Told a line after each run.

    Raises
    ------
    OctobakeError
        As bakes do; ``bench.peer_failed``; ``bench.bad_reference``.
    """
    # What tells open space from solids takes as much as one more sample.
    selection = prepare(load_scene(scene_path), spec, find).selection
    side, m = selection.capture, selection.irradiance
    resolution = spec.resolution.model_copy(update={"radiance": side, "irradiance": m, "distance": side})
    spec = spec.model_copy(update={"outputs": ("irradiance", "radiance"), "resolution": resolution})
    prepared = prepare(load_scene(scene_path), spec.model_copy(update={"integrator": "cache"}), find)
    with tempfile.TemporaryDirectory(prefix="octobake-bench-") as folder, ExitStack() as stack:
        if reference is not None and reference.exists():
            truth = read_reference(reference, prepared.probe_count, side, m)
        else:
            truth = _reference(scene_path, spec, prepared.volumes, find, threads, reference_samples, Path(folder), say)
            if reference is not None:
                truth.keep(reference)
        integrators = ("path",) if prepared.light is None else ("path", "cache")
        racing: list[_Ours | _Theirs] = [_Ours(scene_path, spec, find, threads, Path(folder), i) for i in integrators]
        left_out = []
        given: dict[str, Any] | None = None
        found = find_peers(peers)
        for peer in found:
            why = cannot_render(prepared, peer.name)
            if why:
                left_out.append((peer.name, why))
                continue
            given = given or work(prepared, threads)
            try:
                racing.append(_Theirs(stack.enter_context(running(peer, given, Path(folder))), m))
            except BakeError as e:
                left_out.append((peer.name, e.message))
        if not found:
            say("no peer is installed: ours alone is measured")
        taken: dict[tuple[int, int], list[tuple[Maps, float]]] = {}
        for run in range(runs):
            for j, count in enumerate(samples):
                for i, contestant in enumerate(racing):
                    # Far from the reference's seeds, and each its own.
                    maps, seconds = contestant.render(count, 1_000_003 * (1 + run) + 101 * j)
                    taken.setdefault((i, count), []).append((maps.of(truth.chosen), seconds))
                    say(f"run {run + 1}/{runs}: {contestant.name}, {count} samples: {seconds:.2f} s")
        measured = tuple(
            _measured(c.name, count, taken[i, count], truth, prepared.probe_count * side**2)
            for i, c in enumerate(racing)
            for count in samples
        )
        return Convergence(
            tuple(Contestant(c.name, c.load, c.compile) for c in racing),
            tuple(left_out),
            runs,
            prepared.probe_count,
            side,
            m,
            truth.words,
            truth.noise(),
            measured,
        )


def _measured(name: str, samples: int, runs: list[tuple[Maps, float]], truth: Reference, texels: int) -> Measured:
    mean = truth.mean
    of_radiance, of_irradiance = ([relative_mse(maps[i], mean[i]) for maps, _ in runs] for i in range(2))
    seconds = float(np.median([s for _, s in runs]))
    level = float(mean.radiance.mean())
    means = [float(maps.radiance.mean()) / level - 1 for maps, _ in runs]
    systematic = bias_error = None
    if len(runs) > 1 and len(truth.halves.radiance) > 1:
        a, b = truth.halves.radiance
        found, weight = [maps.radiance for maps, _ in runs], 1 / (mean.radiance**2 + EPSILON)
        products = [((x - a) * (y - b) * weight).mean() for i, x in enumerate(found) for j, y in enumerate(found) if i != j]
        systematic = max(float(np.mean(products)), 0.0) ** 0.5
        halves = float(np.ptp([h.mean() for h in truth.halves.radiance])) / 2 / level
        bias_error = float(np.hypot(np.std(means, ddof=1) / len(runs) ** 0.5, halves))
    return Measured(
        name,
        samples,
        seconds,
        float(np.median(of_radiance)),
        float(np.median(of_irradiance)),
        texels * samples / seconds,
        systematic,
        float(np.mean(means)),
        bias_error,
    )


def _reference(
    scene: Path,
    spec: Spec,
    volumes: Sequence[Any],
    find: Find,
    threads: int,
    samples: int,
    folder: Path,
    say: Callable[[str], None],
) -> Reference:
    everywhere = np.concatenate([v.positions() for v in volumes])
    cells = np.concatenate([np.tile(v.spacing, (v.probe_count, 1)) for v in volumes])
    chosen = np.unique(np.linspace(0, len(everywhere) - 1, min(REFERENCE_PROBES, len(everywhere))).round().astype(np.int64))
    # Each a volume of its own: the same places, and the same texels.
    single = [
        {"name": f"p{i}", "origin": everywhere[i].tolist(), "spacing": cells[i].tolist(), "counts": [1, 1, 1]} for i in chosen.tolist()
    ]
    few = parse_spec({**spec.canonical(), "volumes": single})
    renderer = _Ours(scene, few, find, threads, folder)
    halves = []
    for half in range(2):
        maps, seconds = renderer.render(samples, 500_009 * (half + 1))
        halves.append(maps)
        say(f"reference {half + 1}/2: {len(chosen)} probes, {samples} samples: {seconds:.1f} s")
    # A probe inside a solid has no light to be wrong about.
    active = np.concatenate([v.states for v in read_bundle(folder / "bundle").volumes]) == 1
    both = Maps(*(np.stack(maps)[:, active] for maps in zip(*halves, strict=True)))
    return Reference(chosen[active], both, f"ours, path traced, two of {samples} samples at {active.sum()} probes")
