"""What a bake will keep, leave out and cost, before it is run."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np

from bake_core.allocation import PILOT_SAMPLES, Allocation
from bake_core.bake import Prepared, check_finite, compile_kernels, empty_state, prepare, trace_shard
from bake_core.environment import Find, no_images
from bake_core.scene import Scene
from bake_core.selection import LeftOut
from bake_core.spec import Spec

# Probes that are traced to learn a scene's speed and noise, spread evenly over the bake; each gets the samples of a bake's own pilot.
_PILOT_PROBES = 32
# An Embree 4 acceleration structure of triangles, of medium quality and robust, with its share of construction: bytes a triangle.
_BVH_BYTES = 150
# The interpreter with numba, Embree and OpenImageIO loaded.
_BASE_BYTES = 300e6


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
    paths_per_second : float
        As the pilot had them.
    pilot_error : float or None
        The error figure of the pilot's probes.
    samples, seconds : int, float
        Of a texel, and of tracing, until the target error is reached, if the error falls as that of independent samples; to the last sample
        where there is no target.
    most_seconds : float
        If the bake goes to its last sample.
    memory_bytes, atlas_bytes : int
        Resident memory at the end; texels before compression.
    """

    volumes: tuple[PlannedVolume, ...]
    probes: int
    outputs: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    paths_per_second: float
    pilot_error: float | None
    samples: int
    seconds: float
    most_seconds: float
    memory_bytes: int
    atlas_bytes: int


@dataclass(frozen=True)
class Pilot:
    """A few probes traced: what a sample of every texel of one probe takes, what its distances take, and the error so far."""

    sample_seconds: float
    distance_seconds: float
    error: float | None


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
    samples = samples_needed(spec, pilot.error)
    one = empty_state(replace(prepared, positions=prepared.positions[:1]))
    state_bytes = n * sum(a.nbytes for a in vars(one).values() if isinstance(a, np.ndarray))
    atlas_bytes = n * sum(s.map_bytes(o) for o in s.outputs)
    return Plan(
        volumes=tuple(PlannedVolume(v.name, tuple(v.origin.tolist()), tuple(v.spacing.tolist()), v.counts) for v in prepared.volumes),
        probes=n,
        outputs=s.outputs,
        left_out=prepared.left_out,
        paths_per_second=s.capture**2 / pilot.sample_seconds,
        pilot_error=pilot.error,
        samples=samples,
        seconds=n * (pilot.distance_seconds + samples * pilot.sample_seconds),
        most_seconds=n * (pilot.distance_seconds + spec.stop.max_samples * pilot.sample_seconds),
        memory_bytes=int(_BASE_BYTES + scene.triangle_count * _BVH_BYTES + scene.positions.nbytes * 3 + 2 * state_bytes + 2 * atlas_bytes),
        atlas_bytes=atlas_bytes,
    )


def samples_needed(spec: Spec, error: float | None) -> int:
    """Samples to the target, judged by the error after the pilot: as independent ones have it, σ²/n. An estimate, no bound."""
    stop = spec.stop
    if stop.target_error is None or error is None:
        return stop.max_samples
    return int(min(max(math.ceil(PILOT_SAMPLES * (error / stop.target_error) ** 2), PILOT_SAMPLES // 2), stop.max_samples))


def trace_pilot(prepared: Prepared, threads: int) -> Pilot:
    """Trace probes spread evenly through the bake."""
    n = prepared.probe_count
    chosen = np.unique(np.linspace(0, n - 1, min(_PILOT_PROBES, n)).astype(int))
    positions, limits, units = (a[chosen] for a in (prepared.positions, prepared.limits, prepared.units))
    few = replace(prepared, positions=positions, limits=limits, units=units)
    state, given, seconds = empty_state(few), Allocation.start(len(chosen)), []
    for samples in ((0, PILOT_SAMPLES // 2), (PILOT_SAMPLES // 2, PILOT_SAMPLES)):
        started = time.perf_counter()
        state.add([trace_shard(few, (0, len(chosen)), samples, given, threads=threads)])
        seconds.append(max(time.perf_counter() - started, 1e-9) / len(chosen))
        given = state.allocation
    # Both passes drew as many samples; the first looked for distances, too.
    return Pilot(seconds[1] / (PILOT_SAMPLES // 2), max(seconds[0] - seconds[1], 0.0), state.error())
