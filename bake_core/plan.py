"""What a bake will keep, leave out and cost, before it is run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import FIRST_SAMPLES, PILOT_SAMPLES, SCRAMBLES, Allocation
from bake_core.bake import check_finite, compile_kernels, empty_state
from bake_core.convergence import decide, error_bound, f95, next_pass
from bake_core.environment import Find, no_images
from bake_core.prepared import Prepared, needed_probes, prepare
from bake_core.scene import Scene
from bake_core.selection import LeftOut
from bake_core.shards import lit, trace_shard
from bake_core.spec import Spec, Stop

F64 = NDArray[np.float64]
T = TypeVar("T")

# Probes that are traced to learn a scene's speed and noise; each gets the samples of a bake's own pilot.
_PILOT_PROBES = 32
# Probes that the light cache learns from for them: of a large bake all would take as long as a pass of the bake itself.
_LEARNING_PROBES = 1024
# An Embree 4 acceleration structure of triangles, of medium quality and robust, with its share of construction: bytes a triangle.
_BVH_BYTES = 150
# The interpreter with numba, Embree and OpenImageIO loaded.
_BASE_BYTES = 300e6
# Squared errors of scrambled Sobol' points fall as 1/n at the least, and for smooth integrands, as n goes on, up to 1/n³ (Owen 1997).
_STEEPEST = 3.0


@dataclass(frozen=True)
class PlannedVolume:
    name: str
    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    counts: tuple[int, ...]


@dataclass(frozen=True)
class Contents:
    """What a bake will hold: known before a ray is traced.

    Attributes
    ----------
    unneeded_probes, unneeded_bytes : int
        Probes that no query on a surface asks, and what their texels take before compression: left out where the spec's receivers are
        surfaces, and could be where they are not.
    memory_bytes, atlas_bytes : int
        Resident memory at the end; texels before compression.
    """

    volumes: tuple[PlannedVolume, ...]
    probes: int
    outputs: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    unneeded_probes: int
    unneeded_bytes: int
    memory_bytes: int
    atlas_bytes: int


@dataclass(frozen=True)
class Plan(Contents):
    """A prediction.

    Attributes
    ----------
    paths_per_second : float
        As the pilot had them.
    pilot_error : float or None
        What the error figure of all probes would be after the pilot's samples, judged by the pilot's probes.
    samples, seconds : int, float
        Of a texel of the hardest probes, and of tracing, until the target error is reached; to the last sample where there is no target.
    least_seconds, greatest_seconds : float
        Between which `seconds` may well lie, given how few probes the pilot had and how little it knows of the rate.
    most_seconds : float
        If the bake goes to its last sample.
    """

    paths_per_second: float
    pilot_error: float | None
    samples: int
    seconds: float
    least_seconds: float
    greatest_seconds: float
    most_seconds: float


@dataclass(frozen=True)
class Pilot:
    """A few probes traced.

    Attributes
    ----------
    seconds : (p,) float64
        What a sample of every texel of each takes; nothing inside a solid.
    distance_seconds : float
        What the distances of one take.
    active : (p,) bool
    variance : (a,) float64
        Of those that are active: relative, as the error figure has it, after the pilot's samples.
    degrees, doubt : int, float
        Of freedom, of each; and by how much more all may be (:class:`bake_core.convergence.Spread`).
    fall : float
        The power of 1/n with which variances fell from the pilot's first half to its end, within what is possible.
    allocation : Allocation
        What active ones have had, and what they are to have.
    times : float
        How many times as many probes the bake traces.
    learning_seconds : float
        What the light cache takes for a sample of the whole bake.
    """

    seconds: F64
    distance_seconds: float
    active: NDArray[np.bool_]
    variance: F64
    degrees: int
    doubt: float
    fall: float
    allocation: Allocation
    times: float
    learning_seconds: float

    def cost(self, taken: F64) -> F64:
        """(p,) float64: seconds for each probe, where active ones take so many samples, (a,)."""
        out = np.full(len(self.seconds), self.distance_seconds)
        out[self.active] += taken * self.seconds[self.active]
        return out


def plan(scene: Scene, spec: Spec, *, threads: int, find: Find = no_images) -> Plan:
    """Predict a bake by tracing a few of its probes.

    Raises
    ------
    SpecError, SceneError
        As the bake would.
    """
    prepared = prepare(scene, spec, find, threads=threads)
    compile_kernels(prepared, audited=False)
    check_finite(prepared, threads=threads)
    pilot = trace_pilot(prepared, threads)
    samples, taken = samples_needed(spec.stop, pilot)
    noise, pace = doubt(pilot.variance, pilot.times), doubt(pilot.cost(taken), pilot.times)
    _, least = samples_needed(spec.stop, replace(pilot, variance=pilot.variance / noise))
    _, greatest = samples_needed(spec.stop, replace(pilot, variance=pilot.variance * noise, fall=1.0))
    _, most = samples_needed(spec.stop.model_copy(update={"target_error": None}), pilot)
    traced = int(prepared.needed.sum())

    def seconds(taken: F64) -> float:
        if not traced:
            return 0.0
        return traced * float(pilot.cost(taken).mean()) + pilot.learning_seconds * float(taken.max(initial=0.0))

    per_sample = float(pilot.seconds.mean()) if traced else 0.0
    return Plan(
        **vars(contents(prepared)),
        paths_per_second=float(pilot.active.mean()) * prepared.selection.capture**2 / per_sample if per_sample else 0.0,
        pilot_error=error_bound(pilot.variance, pilot.degrees, pilot.doubt, pilot.times),
        samples=samples,
        seconds=seconds(taken),
        least_seconds=seconds(least) / pace,
        greatest_seconds=seconds(greatest) * pace,
        most_seconds=seconds(most),
    )


def contents(prepared: Prepared) -> Contents:
    """Tell what a prepared bake will hold."""
    scene, spec, n, s = prepared.scene, prepared.spec, prepared.probe_count, prepared.selection
    one = empty_state(replace(prepared, positions=prepared.positions[:1], needed=prepared.needed[:1]))
    state_bytes = n * sum(a.nbytes for a in vars(one).values() if isinstance(a, np.ndarray))
    asked = prepared.needed if spec.receivers == "surfaces" else needed_probes(scene, prepared.volumes)
    edges = np.cumsum([0] + [v.probe_count for v in prepared.volumes])
    sizes = [sum(s.map_bytes(o) for o in s.of(i)) for i in range(len(prepared.volumes))]
    stored = sum(size * int(prepared.needed[a:b].sum()) for size, a, b in zip(sizes, edges[:-1], edges[1:], strict=True))
    cache = 0 if prepared.light is None else prepared.light.bytes(spec.stop.max_samples)
    return Contents(
        volumes=tuple(PlannedVolume(v.name, tuple(v.origin.tolist()), tuple(v.spacing.tolist()), v.counts) for v in prepared.volumes),
        probes=n,
        outputs=s.outputs,
        left_out=prepared.left_out,
        unneeded_probes=n - int(asked.sum()),
        unneeded_bytes=sum(size * int((~asked[a:b]).sum()) for size, a, b in zip(sizes, edges[:-1], edges[1:], strict=True)),
        memory_bytes=int(_BASE_BYTES + scene.triangle_count * _BVH_BYTES + scene.positions.nbytes * 3 + 2 * (state_bytes + stored) + cache),
        atlas_bytes=stored,
    )


def samples_needed(stop: Stop, pilot: Pilot) -> tuple[int, F64]:
    """How many samples the hardest probes will have had, and each active one of the pilot, (a,), when the bake stops.

    The bake's own passes and its own decisions, about errors that fall from the pilot's as its rate says.
    """
    given = pilot.allocation
    if stop.target_error is None:
        return stop.max_samples, np.full(len(given.taken), float(stop.max_samples))
    samples, error = 0, None
    while True:
        samples = next_pass(stop, samples, error)[1]
        taken = np.full(len(given.taken), float(samples))
        if samples > PILOT_SAMPLES:
            taken = given.spans((0, samples))[..., 1].sum(1).astype(np.float64)
        if samples >= SCRAMBLES:
            then = pilot.variance * (PILOT_SAMPLES / taken) ** pilot.fall
            error = error_bound(then, pilot.degrees, pilot.doubt, pilot.times)
        if decide(stop, samples, error, 0.0) != "continue":
            return samples, taken


def doubt(values: F64, times: float) -> float:
    """By what factor the mean of a few probes' values may differ from that of all: half a 95 % interval of its logarithm.

    Parameters
    ----------
    values : (p,) float64
        Not negative.
    times : float
        How many times as many there are: of all of them, the mean is no sample's.
    """
    n, mean = len(values), float(values.mean()) if len(values) else 0.0
    if n < 2 or mean <= 0:
        return 1.0
    return math.exp(math.sqrt(float(f95(1.0, float(n - 1))) * (1 - 1 / times) / n) * float(values.std(ddof=1)) / mean)


def trace_pilot(prepared: Prepared, threads: int) -> Pilot:
    """Trace probes drawn at random, one from each of as many parts of the bake."""
    wanted = np.flatnonzero(prepared.needed)
    count = min(_PILOT_PROBES, len(wanted))
    if not count:
        nothing = np.zeros(0)
        return Pilot(nothing, 0.0, np.zeros(0, np.bool_), nothing, 1, 1.0, 1.0, Allocation.start(0), 1.0, 0.0)
    # Every so-many-th would be a diagonal through the grid.
    within = np.random.default_rng(prepared.spec.seed).random(count)
    chosen = wanted[((np.arange(count) + within) * len(wanted) / count).astype(int)]
    part = {name: getattr(prepared, name)[chosen] for name in ("positions", "limits", "units", "needed")}
    light = prepared.light and prepared.light.of_some(_LEARNING_PROBES)
    few = replace(prepared, **part, light=light)
    state, start = empty_state(few), Allocation.start(count)
    first, second = (0, FIRST_SAMPLES), (FIRST_SAMPLES, PILOT_SAMPLES)
    # No sample at all: distances alone.
    looked, looking = _timed(lambda: trace_shard(few, (0, count), (0, 0), start, threads=threads))
    alone = [trace_shard(few, (probe, probe + 1), first, start, threads=threads) for probe in range(count)]
    state.add(alone)
    early = state.spread()
    _, learning = _timed(lambda: lit(few, second, threads=threads))
    together, tracing = _timed(lambda: trace_shard(few, (0, count), second, state.allocation, threads=threads))
    state.add([together])
    late = state.spread()
    # Probe by probe there is more to do than rays; together they are as fast as a bake's, and each has its share of the rays.
    rays = np.array([t.rays for t in alone]) - looked.rays / count
    state.allocate(prepared.spec.stop)
    active = state.active()
    assert early is not None and late is not None
    before, after = early.relative(), late.relative()
    fell = math.log2(before.mean() / after.mean()) if len(after) and after.mean() > 0 else 1.0
    return Pilot(
        seconds=tracing / (second[1] - second[0]) * rays / max(rays.sum(), 1),
        distance_seconds=looking / count,
        active=active,
        variance=after,
        degrees=late.degrees,
        doubt=late.doubt,
        fall=min(max(fell, 1.0), _STEEPEST),
        allocation=Allocation(state.taken[active], state.eighths[active]),
        times=len(wanted) / count,
        learning_seconds=learning / (second[1] - second[0]) * (prepared.light.probes / light.probes if prepared.light and light else 0),
    )


def _timed(trace: Callable[[], T]) -> tuple[T, float]:
    started = time.perf_counter()
    return trace(), time.perf_counter() - started
