"""What a bake will keep, leave out and cost, before it is run."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from bake_core.allocation import Allocation
from bake_core.bake import Prepared, check_finite, compile_kernels, empty_state, prepare, trace_shard
from bake_core.environment import Find, no_images
from bake_core.scene import Scene
from bake_core.spec import Spec

# Probes that are traced to learn the scene's speed, spread evenly over the bake, and the samples each of them gets.
_PILOT_PROBES, _PILOT_SAMPLES = 32, 4
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
    seconds : float
        Of tracing, if the bake goes to its last sample.
    memory_bytes, atlas_bytes : int
        Resident memory at the end; texels before compression.
    """

    volumes: tuple[PlannedVolume, ...]
    probes: int
    outputs: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    paths_per_second: float
    seconds: float
    memory_bytes: int
    atlas_bytes: int


def plan(scene: Scene, spec: Spec, *, threads: int, find: Find = no_images) -> Plan:
    """Predict a bake by tracing a few of its probes.

    Raises
    ------
    SpecError, SceneError
        As the bake would.
    """
    prepared = prepare(scene, spec, find)
    return predict(prepared, _paths_per_second(prepared, threads))


def predict(prepared: Prepared, speed: float) -> Plan:
    """Predict a bake that traces so many paths a second."""
    scene, spec, n, s = prepared.scene, prepared.spec, prepared.probe_count, prepared.selection
    one = empty_state(replace(prepared, positions=prepared.positions[:1]))
    state_bytes = n * sum(a.nbytes for a in vars(one).values() if isinstance(a, np.ndarray))
    texels = {
        "irradiance": (s.irradiance, 6),
        "visibility": (s.visibility, 8),
        "radiance": (s.capture, 6),
        "distance": (s.distance, 4),
        "normal": (s.normal, 6),
    }
    atlas_bytes = sum(n * (texels[o][0] + 2) ** 2 * texels[o][1] for o in s.outputs)
    return Plan(
        volumes=tuple(PlannedVolume(v.name, tuple(v.origin.tolist()), tuple(v.spacing.tolist()), v.counts) for v in prepared.volumes),
        probes=n,
        outputs=s.outputs,
        left_out=s.left_out,
        paths_per_second=speed,
        seconds=n * s.capture**2 * spec.stop.max_samples / speed,
        memory_bytes=int(_BASE_BYTES + scene.triangle_count * _BVH_BYTES + scene.positions.nbytes * 3 + 2 * state_bytes + 2 * atlas_bytes),
        atlas_bytes=atlas_bytes,
    )


def _paths_per_second(prepared: Prepared, threads: int) -> float:
    """Measured over probes spread evenly through the bake."""
    n = prepared.probe_count
    chosen = np.unique(np.linspace(0, n - 1, min(_PILOT_PROBES, n)).astype(int))
    compile_kernels(prepared)
    check_finite(prepared, threads=threads)
    given = Allocation.start(n)
    started = time.perf_counter()
    for probe in chosen:
        trace_shard(prepared, (int(probe), int(probe) + 1), (1, 1 + _PILOT_SAMPLES), given, threads=threads)
    paths = len(chosen) * prepared.selection.capture**2 * _PILOT_SAMPLES
    return paths / max(time.perf_counter() - started, 1e-9)
