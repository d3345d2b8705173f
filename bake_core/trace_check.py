"""Rays traced through a bundle, one by one beside Embree's: how often the light field is right, and how it is wrong.

Rays leave surface points that are uniform over the area inside the volumes (:mod:`bake_core.receivers`), in directions drawn with the
cosine: what a surface reflects comes along them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.bundle import VolumeData
from bake_core.embree import new_rayhit
from bake_core.errors import Cancelled
from bake_core.kernels import entry_kernel
from bake_core.light_field import HIT, MISS, UNKNOWN, Traces
from bake_core.materials import sample_lambert
from bake_core.receivers import Receivers, draw_receivers, stands_of
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.scene import Scene
from bake_core.surfaces import find_surface, surface
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# A hit counts as the same where it is no farther along the ray from Embree's than this many of the answering texel's footprints.
FOOTPRINTS = 2.0
_CANCELLED = 1


@dataclass(frozen=True)
class Rays:
    """Rays and the truth about them.

    Attributes
    ----------
    origins, directions : (n, 3) float64
        World, metres, off the surface by what rounding asks for; unit.
    distance : (n,) float64
        To what Embree hits; inf where it hits nothing.
    """

    origins: F64
    directions: F64
    distance: F64


@dataclass(frozen=True)
class Agreement:
    """How the light field's answers compare with Embree's, as shares of all rays.

    Attributes
    ----------
    rays : int
    agree : float
        The same verdict, and hits within :data:`FOOTPRINTS` of a texel's footprint of each other.
    false_hits : float
        A hit that is not there: Embree goes on by more than that, or misses.
    false_misses : float
        A miss where Embree hits.
    late_hits : float
        A hit behind the one that Embree finds, by more than that.
    unknown : float
    error : float
        Root of the mean squared difference of distances over hits that agree, metres.
    p95 : float
        95th percentile of that difference, in footprints.
    probes : float
        Mean number of probes that a ray asked.
    """

    rays: int
    agree: float
    false_hits: float
    false_misses: float
    late_hits: float
    unknown: float
    error: float
    p95: float
    probes: float


def draw_rays(
    scene: Scene, tracer: Tracer, volumes: Sequence[VolumeData], count: int, seed: int, *, cancelled: NDArray[np.uint8] | None = None
) -> Rays:
    """One cosine-distributed ray from each of `count` surface points; fewer where no such surface is to be had.

    Raises
    ------
    Cancelled
    """
    receivers = draw_receivers(scene, tracer, volumes, count, seed, cancelled=cancelled)
    return rays_from(tracer, receivers, seed, cancelled=cancelled)


def rays_from(tracer: Tracer, receivers: Receivers, seed: int, *, cancelled: NDArray[np.uint8] | None = None) -> Rays:
    """One cosine-distributed ray from each receiver."""
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    stands = stands_of(tracer, receivers.places)
    rays = np.empty((len(stands), 7))
    if _rays_kernel(tracer.tables, new_rayhit(), stands, np.uint64(seed), flag, rays) == _CANCELLED:
        raise Cancelled
    return Rays(rays[:, :3] + tracer.origin, rays[:, 3:6].copy(), rays[:, 6].copy())


@entry_kernel
def _rays_kernel(t, ray, stands, seed, cancelled, out):  # type: ignore[no-untyped-def]
    """Origin, direction and distance, (n, 7), local frame."""
    ray_bits = ray.view(np.uint32)
    for i in range(stands.shape[0]):
        if cancelled[0]:
            return _CANCELLED
        s = stands[i]
        # About the geometric normal, so that no ray begins below the surface.
        n = (s[3], s[4], s[5], s[3], s[4], s[5])
        u, v = sobol_pair(reverse_bits(uint32(i)), mix64(uint64(seed)))
        dx, dy, dz = sample_lambert(u, v, n)
        x, y, z = s[0] + s[9] * s[3], s[1] + s[9] * s[4], s[2] + s[9] * s[5]
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4], out[i, 5] = x, y, z, dx, dy, dz
        out[i, 6] = np.inf
        if find_surface(t, ray, ray_bits, x, y, z, dx, dy, dz):
            p, _, _, _, _, _, _, _, _, _ = surface(t, ray_bits, ray, dx, dy, dz)
            x, y, z = p[0] - x, p[1] - y, p[2] - z
            out[i, 6] = math.sqrt(x * x + y * y + z * z)
    return 0


def compare_traces(volumes: Sequence[VolumeData], rays: Rays, traces: Traces) -> Agreement:
    """Hold answers against the truth."""
    masks, apart = judge(volumes, rays, traces)
    n = max(len(rays.distance), 1)
    share = {name: float(mask.sum()) / n for name, mask in masks.items()}
    hits = masks["agree"] & (traces.verdict == HIT)
    difference = (traces.distance[hits] - rays.distance[hits]) ** 2
    return Agreement(
        rays=len(rays.distance),
        error=float(np.sqrt(difference.mean())) if hits.any() else 0.0,
        p95=float(np.percentile(apart[hits], 95)) if hits.any() else 0.0,
        probes=float(traces.probes.mean()) if len(rays.distance) else 0.0,
        **share,
    )


def judge(volumes: Sequence[VolumeData], rays: Rays, traces: Traces) -> tuple[dict[str, Bool], F64]:
    """Which ray is what, and how far hits are from the truth in footprints.

    A footprint is what a texel of the answering probe's distance map covers of a surface that faces the probe, at the hit that it gives:
    the distance from the probe times the side of a texel of mean solid angle, √(4π)/n.

    Returns
    -------
    masks : dict of str to (n,) bool
        ``agree``, ``false_hits``, ``false_misses``, ``late_hits``, ``unknown``; each ray is in one of them.
    apart : (n,) float64
        inf where one of the two hits nothing.
    """
    hit, missed = traces.verdict == HIT, traces.verdict == MISS
    footprint = np.full(len(hit), np.nan)
    for v, volume in enumerate(volumes):
        of = np.flatnonzero(hit & (traces.volume == v))
        point = rays.origins[of] + traces.distance[of, None] * rays.directions[of]
        side = math.sqrt(4 * math.pi) / volume.atlases["distance"].interior
        footprint[of] = np.linalg.norm(point - volume.positions()[traces.probe[of]], axis=1) * side
    real = np.isfinite(rays.distance)
    both = hit & real
    apart = np.full(len(hit), np.inf)
    apart[both] = np.abs(traces.distance[both] - rays.distance[both]) / footprint[both]
    far = apart > FOOTPRINTS
    late = hit & far & (traces.distance > rays.distance)
    masks = {
        "agree": (hit & ~far) | (missed & ~real),
        "false_hits": hit & far & ~late,
        "false_misses": missed & real,
        "late_hits": late,
        "unknown": traces.verdict == UNKNOWN,
    }
    return masks, apart
