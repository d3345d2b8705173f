"""What a bake will keep, leave out and cost, before it is run."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import PILOT_SAMPLES, SCRAMBLES, Allocation
from bake_core.bake import Prepared, check_finite, compile_kernels, empty_state, needed_probes, prepare, trace_shard
from bake_core.convergence import decide, error_bound, f95, next_pass
from bake_core.environment import Find, no_images
from bake_core.scene import Scene
from bake_core.selection import LeftOut
from bake_core.spec import Spec, Stop

# Probes that are traced to learn a scene's speed and noise, spread evenly over the bake; each gets the samples of a bake's own pilot.
_PILOT_PROBES = 32
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
class Plan:
    """A prediction.

    Attributes
    ----------
    unneeded_probes, unneeded_bytes : int
        Probes that no query on a surface asks, and what their texels take before compression: left out where the spec's receivers are
        surfaces, and could be where they are not.
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
    memory_bytes, atlas_bytes : int
        Resident memory at the end; texels before compression.
    """

    volumes: tuple[PlannedVolume, ...]
    probes: int
    outputs: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    unneeded_probes: int
    unneeded_bytes: int
    paths_per_second: float
    pilot_error: float | None
    samples: int
    seconds: float
    least_seconds: float
    greatest_seconds: float
    most_seconds: float
    memory_bytes: int
    atlas_bytes: int


@dataclass(frozen=True)
class Pilot:
    """A few probes traced.

    Attributes
    ----------
    sample_seconds, distance_seconds : float
        What a sample of every texel of one probe takes, and what its distances take; the mean of active and inactive ones.
    variance : (p,) float64
        Of those that are active: relative, as the error figure has it, after the pilot's samples.
    degrees : int
        Of freedom, of each.
    fall : float
        The power of 1/n with which variances fell from the pilot's first half to its end, within what is possible.
    allocation : Allocation
        What these probes have had, and what they are to have.
    times : float
        How many times as many active probes the bake has.
    """

    sample_seconds: float
    distance_seconds: float
    variance: NDArray[np.float64]
    degrees: int
    fall: float
    allocation: Allocation
    times: float


def plan(scene: Scene, spec: Spec, *, threads: int, find: Find = no_images) -> Plan:
    """Predict a bake by tracing a few of its probes.

    Raises
    ------
    SpecError, SceneError
        As the bake would.
    """
    prepared = prepare(scene, spec, find)
    n, s = prepared.probe_count, prepared.selection
    compile_kernels(prepared, audited=False)
    check_finite(prepared, threads=threads)
    pilot = trace_pilot(prepared, threads)
    samples, taken = samples_needed(spec.stop, pilot)
    doubt = _doubt(pilot)
    _, least = samples_needed(spec.stop, replace(pilot, variance=pilot.variance / doubt))
    _, greatest = samples_needed(spec.stop, replace(pilot, variance=pilot.variance * doubt, fall=1.0))
    _, most = samples_needed(spec.stop.model_copy(update={"target_error": None}), pilot)
    one = empty_state(replace(prepared, positions=prepared.positions[:1], needed=prepared.needed[:1]))
    state_bytes = n * sum(a.nbytes for a in vars(one).values() if isinstance(a, np.ndarray))
    asked = prepared.needed if spec.receivers == "surfaces" else needed_probes(scene, prepared.volumes)
    edges = np.cumsum([0] + [v.probe_count for v in prepared.volumes])
    sizes = [sum(s.map_bytes(o) for o in s.of(i)) for i in range(len(prepared.volumes))]
    stored = sum(size * int(prepared.needed[a:b].sum()) for size, a, b in zip(sizes, edges[:-1], edges[1:], strict=True))
    traced = int(prepared.needed.sum())

    def seconds(taken: float) -> float:
        return traced * (pilot.distance_seconds + taken * pilot.sample_seconds)

    return Plan(
        volumes=tuple(PlannedVolume(v.name, tuple(v.origin.tolist()), tuple(v.spacing.tolist()), v.counts) for v in prepared.volumes),
        probes=n,
        outputs=s.outputs,
        left_out=prepared.left_out,
        unneeded_probes=n - int(asked.sum()),
        unneeded_bytes=sum(size * int((~asked[a:b]).sum()) for size, a, b in zip(sizes, edges[:-1], edges[1:], strict=True)),
        paths_per_second=s.capture**2 / pilot.sample_seconds,
        pilot_error=error_bound(pilot.variance, pilot.degrees, pilot.times),
        samples=samples,
        seconds=seconds(taken),
        least_seconds=seconds(least),
        greatest_seconds=seconds(greatest),
        most_seconds=seconds(most),
        memory_bytes=int(_BASE_BYTES + scene.triangle_count * _BVH_BYTES + scene.positions.nbytes * 3 + 2 * state_bytes + 2 * stored),
        atlas_bytes=stored,
    )


def samples_needed(stop: Stop, pilot: Pilot) -> tuple[int, float]:
    """How many samples the hardest probes will have had, and how many an active one on average, when the bake stops.

    The bake's own passes and its own decisions, about errors that fall from the pilot's as its rate says.
    """
    given = pilot.allocation
    if stop.target_error is None:
        return stop.max_samples, float(stop.max_samples)
    samples, error = 0, None
    while True:
        samples = next_pass(stop, samples, error)[1]
        taken = (
            np.maximum(given.taken, given.spans((0, samples))[..., 1])
            if samples > PILOT_SAMPLES
            else np.full_like(given.taken, samples // 2)
        )
        mean = taken.sum(1)
        if samples >= SCRAMBLES:
            error = error_bound(pilot.variance * (PILOT_SAMPLES / np.maximum(mean, 1)) ** pilot.fall, pilot.degrees, pilot.times)
        if decide(stop, samples, error, 0.0) != "continue":
            return samples, float(mean.mean()) if len(mean) else float(samples)


def _doubt(pilot: Pilot) -> float:
    """By what factor the mean of the probes' variances may differ from that of all probes: half a 95 % interval of its logarithm."""
    n, mean = len(pilot.variance), float(pilot.variance.mean()) if len(pilot.variance) else 0.0
    if n < 2 or mean <= 0:
        return 1.0
    return math.exp(math.sqrt(float(f95(1.0, float(n - 1)))) * float(pilot.variance.std(ddof=1)) / mean / math.sqrt(n))


def trace_pilot(prepared: Prepared, threads: int) -> Pilot:
    """Trace probes spread evenly through the bake."""
    wanted = np.flatnonzero(prepared.needed)
    chosen = wanted[np.unique(np.linspace(0, len(wanted) - 1, min(_PILOT_PROBES, len(wanted))).astype(int))]
    few = replace(prepared, positions=prepared.positions[chosen], limits=prepared.limits[chosen], needed=prepared.needed[chosen])
    state, given = empty_state(few), Allocation.start(len(chosen))
    seconds, errors = [], []
    for samples in ((0, PILOT_SAMPLES // 2), (PILOT_SAMPLES // 2, PILOT_SAMPLES)):
        started = time.perf_counter()
        state.add([trace_shard(few, (0, len(chosen)), samples, given, threads=threads)])
        seconds.append(max(time.perf_counter() - started, 1e-9) / max(len(chosen), 1))
        given = state.allocation
        errors.append(state.spread())
    state.allocate(prepared.spec.stop)
    active = state.active()
    early, late = errors
    assert early is not None and late is not None
    a, b = early.relative(), late.relative()
    fell = math.log2(a.mean() / b.mean()) if len(b) and b.mean() > 0 else 1.0
    # Both passes drew as many samples; the first looked for distances, too.
    return Pilot(
        sample_seconds=seconds[1] / (PILOT_SAMPLES // 2),
        distance_seconds=max(seconds[0] - seconds[1], 0.0),
        variance=b,
        degrees=late.degrees,
        fall=min(max(fell, 1.0), _STEEPEST),
        allocation=Allocation(state.taken[active], state.eighths[active]),
        times=len(wanted) / max(len(chosen), 1),
    )
