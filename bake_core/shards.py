"""One shard of one pass: some probes, some samples, by any process and in any order."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import Allocation
from bake_core.capture import Capture, capture_radiance
from bake_core.distances import capture_distance
from bake_core.octahedral import texel_solid_angles
from bake_core.prepared import Prepared
from bake_core.tally import Tally, outside
from bake_core.tracer import Tracer
from bake_core.walls import moments_and_walls

# Probes whose distances are held at once: 64² rays of 33 bytes each, 9 MB a thread.
_DISTANCE_CHUNK = 64


def shard_ranges(probe_count: int, shards: int) -> list[tuple[int, int]]:
    """Half-open ranges of probes, as equal as they go; never an empty one."""
    shards = max(1, min(shards, probe_count))
    edges = [probe_count * i // shards for i in range(shards + 1)]
    return list(pairwise(edges))


def trace_shard(
    prepared: Prepared,
    probes: tuple[int, int],
    samples: tuple[int, int],
    allocation: Allocation,
    *,
    threads: int,
    cancelled: NDArray[np.uint8] | None = None,
    advance: Callable[[float], None] = lambda fraction: None,
) -> Tally:
    """One shard's part of one pass.

    Parameters
    ----------
    probes, samples : (int, int)
        Half-open ranges. The pass that starts at sample 0 captures distances first: who stands inside a solid is not traced.
    allocation : Allocation
        What each probe of the bake has had before this pass, and what part of it each gets.
    cancelled : (1,) uint8, optional
        Set it to 1 from any thread: the kernels stop within one texel.
    advance : callable
        Told the fraction of this shard done since it was last called; from any thread.

    Raises
    ------
    Cancelled
    """
    s = prepared.selection
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    positions = np.ascontiguousarray(prepared.positions[slice(*probes)])
    ids = np.arange(*probes, dtype=np.uint64)
    capture = Capture(s.capture, s.irradiance, prepared.spec.seed, s.keeps("radiance"))
    spans = allocation.spans(samples, slice(*probes))
    seen: dict[str, NDArray[np.float32]] = {}
    looked = 0
    if samples[0] == 0:
        needed = prepared.needed[slice(*probes)]
        seen, looked = _see(prepared, probes[0] + np.flatnonzero(needed), threads, flag)
        free = outside(seen["backface"])
        seen = {name: values if name == "backface" else values[free] for name, values in seen.items()}
        seen["backface"], kept = _spread(seen["backface"], needed), _spread(free, needed)
        spans[~kept, :, 1] = spans[~kept, :, 0]
    else:
        kept = allocation.eighths[slice(*probes)].max(1) > 0
    irradiance, radiance, rays = capture_radiance(
        lit(prepared, samples, threads=threads, cancelled=flag),
        np.ascontiguousarray(positions[kept]),
        ids[kept],
        np.ascontiguousarray(spans[kept]),
        capture,
        threads=threads,
        cancelled=flag,
        advance=advance,
    )
    empty = np.zeros
    # What all shards share is counted once.
    learning = prepared.light.rays(samples) if prepared.light is not None and probes[0] == 0 and samples[1] > samples[0] else 0
    return Tally(
        *probes,
        *samples,
        taken=spans[..., 1],
        irradiance=_stored(irradiance),
        radiance=_stored(radiance),
        visibility=seen.get("visibility", empty((0, 0, 0, 0), np.float32)),
        backface=seen.get("backface", empty(0, np.float32)),
        distance=seen.get("distance", empty((0, 0), np.float32)),
        normal=seen.get("normal", empty((0, 0, 0), np.float32)),
        rays=rays + looked,
        learning=learning,
    )


def lit(prepared: Prepared, samples: tuple[int, int], *, threads: int, cancelled: NDArray[np.uint8] | None = None) -> Tracer:
    """What a pass traces with: a light cache in it, unless every path is to go on to its end.

    Raises
    ------
    Cancelled
    """
    light = prepared.light
    if light is None:
        return prepared.tracer
    if samples[0] == samples[1]:
        return light.blank()
    return light.known(samples[1], threads=threads, cancelled=np.zeros(1, np.uint8) if cancelled is None else cancelled)


def _spread(values: NDArray[Any], where: NDArray[np.bool_]) -> NDArray[Any]:
    """Values of those where a mask says so; zeros for the others."""
    out = np.zeros(len(where), values.dtype)
    out[where] = values
    return out


def _stored(sums: NDArray[np.float64]) -> NDArray[np.float32]:
    """Sums in single precision: 2⁻²⁴ of a value is far below what its samples know. What overflows is refused where maps are checked."""
    with np.errstate(over="ignore"):
        return sums.astype(np.float32)


def _see(
    prepared: Prepared, probes: NDArray[np.int64], threads: int, flag: NDArray[np.uint8]
) -> tuple[dict[str, NDArray[np.float32]], int]:
    """Distances and what is made of them, a few probes at a time on each thread; and how many rays they took."""
    s = prepared.selection
    positions, limits, units = (np.ascontiguousarray(a[probes]) for a in (prepared.positions, prepared.limits, prepared.units))
    solid_angle = texel_solid_angles(s.distance).reshape(-1) / (4 * np.pi)

    def look(first: int) -> tuple[dict[str, NDArray[np.float32]], int]:
        chunk = slice(first, first + _DISTANCE_CHUNK)
        distance, normal, back, rays = capture_distance(prepared.tracer, positions[chunk], s.distance, cancelled=flag)
        # One row at a time: a matrix product's bits may depend on how many rows it has.
        seen = {"backface": np.array([solid_angle[row].sum() for row in back], np.float32)}
        if s.keeps("visibility"):
            seen["visibility"] = moments_and_walls(distance, limits[chunk], units[chunk], s.visibility)
        if s.keeps("distance"):
            seen["distance"] = np.where(np.isfinite(distance), distance, s.miss_distance).astype(np.float32)
        if s.keeps("normal"):
            if s.normal != s.distance:
                _, normal, _, more = capture_distance(prepared.tracer, positions[chunk], s.normal, cancelled=flag)
                rays += more
            seen["normal"] = normal
        return seen, rays

    with ThreadPoolExecutor(threads) as pool:
        parts, counts = zip(*pool.map(look, range(0, max(len(positions), 1), _DISTANCE_CHUNK)), strict=True)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, sum(counts)
