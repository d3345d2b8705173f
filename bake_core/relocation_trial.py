"""Whether a volume's probes are better off near the walls or on their lattice, by measuring at its surfaces before anything is baked.

Nearer to the walls is nearly always better (:mod:`bake_core.relocation`), but not where light changes fast and bends along a wall, as
beside a lamp right below the ceiling: there the probe in the middle of the change told more. So points are drawn on the surfaces, the
irradiance of the eight probes around each is path-traced in the direction that the query would read it, at either place, and weighted as
the query would, with rays in the place of maps that do not exist yet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bake_core.bundle import VolumeData
from bake_core.irradiance import cell, corners, crush, facing, tent
from bake_core.parameters import PARAMETERS
from bake_core.placement import Volume
from bake_core.receiver_irradiance import irradiance_at
from bake_core.receivers import draw_receivers, stands_of
from bake_core.relmse import RELMSE_FLOOR
from bake_core.relocation import is_free
from bake_core.scene import Scene
from bake_core.shader_constants import biases
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]

# Points of all volumes together, and of one at least; paths from each point, and from each probe about it, for each of four estimates.
_POINTS, _LEAST, _SCRAMBLES, _PATHS = 1024, 128, 4, 8
# Fewer tell nothing.
_FEWEST = 64
_SEED = 0x6E1A7E
# Light that has bounced oftener is too even to tell places apart; and whether it ends at all has not been looked at yet.
_BOUNCES = 16
# Of the lattice's error: in the open probes near walls are a little worse, so on surfaces they must be better by this much.
_WORTH = 0.05


@dataclass(frozen=True)
class Trial:
    """A volume's probes, tried at both places.

    Attributes
    ----------
    points : int
        Surface points that it was measured at.
    error, lattice_error : float
        Mean square of the relative error there, bounded, with probes near the walls and on their lattice (:func:`_error`).
    moved : bool
        Where they are to stand.
    """

    points: int
    error: float
    lattice_error: float
    moved: bool


def try_relocation(scene: Scene, tracer: Tracer, volume: Volume, offsets: F64, among: int, *, threads: int) -> Trial | None:
    """Measure one volume with its probes at both places; they move where that takes 5 % off the error.

    Parameters
    ----------
    tracer : Tracer
        With the environment.
    offsets : (n, 3) float64
        From the lattice to the other places, metres.
    among : int
        Volumes that share the points, 128 each at least.

    Returns
    -------
    Trial or None
        None where there is nothing to measure at: too few surfaces that its probes see, or none that light reaches. The same for any
        number of threads.
    """
    stands = stands_of(tracer, draw_receivers(scene, tracer, (_empty(volume),), max(_POINTS // among, _LEAST), _SEED).places)
    n = len(stands)
    if n < _FEWEST:
        return None
    bounces = min(tracer.tables.max_bounces, np.int64(_BOUNCES))
    tracer = replace(tracer, tables=tracer.tables._replace(max_bounces=bounces))
    truth = irradiance_at(tracer, stands, samples=_PATHS, scrambles=_SCRAMBLES, seed=_SEED, threads=threads)
    ways = [_answers(tracer, volume, stands, scene.origin, moved, threads) for moved in (np.zeros_like(offsets), offsets)]
    if not (truth.any() and all(np.isfinite(values).all() for values in (truth, *ways))):
        return None
    lattice, near = (_error(answers, truth) for answers in ways)
    return Trial(n, near, lattice, near < (1 - _WORTH) * lattice)


def _error(answers: F64, truth: F64) -> float:
    """Mean over points of |a - b|² / (|a|² + |b|² + (m/10)²), from independent estimates (k, n, 3) of answers and of the truth.

    Squares are products of two estimates' differences, so noise adds nothing to them. The divisor is of all estimates: what one stray path
    brings to either counts at most as 1, at both places alike, where :func:`bake_core.relmse.relative_squares` would let it through.
    """
    k, difference = len(truth), answers - truth
    product = ((difference.sum(0) ** 2).sum(-1) - (difference**2).sum((0, 2))) / (k * (k - 1))
    size = (truth.mean(0) ** 2).sum(-1)
    divisor = (answers.mean(0) ** 2).sum(-1) + size + (RELMSE_FLOOR * np.sqrt(size).mean()) ** 2
    return float((product / divisor).mean())


def _answers(tracer: Tracer, volume: Volume, stands: F64, origin: F64, offsets: F64, threads: int) -> F64:
    """Four estimates of what a query answers at points, (4, n, 3)."""
    points, normals = stands[:, :3], stands[:, 6:9]
    base, fraction = cell(volume, points + origin)
    normal_bias, _ = biases(PARAMETERS, volume.spacing, np.asarray(volume.counts))
    biased = points + normals * normal_bias
    light, total = np.zeros((_SCRAMBLES, len(points), 3)), np.zeros(len(points))
    for corner, (upper, lattice, flat) in enumerate(corners(volume, base)):
        offset = offsets[flat]
        probes = volume.origin - origin + volume.spacing * lattice + offset
        seen = np.where(is_free(tracer, probes, biased - probes), 1, PARAMETERS["visibility_floor"])
        weight = tent(fraction - upper, offset / volume.spacing) * crush(facing(probes - points, normals) * seen)
        asked = weight > 0
        stand = np.concatenate([probes, normals, normals, np.zeros((len(probes), 1))], 1)[asked]
        found = irradiance_at(tracer, stand, samples=_PATHS, scrambles=_SCRAMBLES, seed=_SEED + 1 + corner, threads=threads)
        light[:, asked] += weight[asked, None] * found
        total += weight
    return light / np.maximum(total, np.finfo(np.float64).tiny)[:, None]


def _empty(volume: Volume) -> VolumeData:
    """A volume that nothing has been baked of, all its probes active and on their lattice."""
    n = volume.probe_count
    return VolumeData(
        name=volume.name,
        origin=volume.origin,
        spacing=volume.spacing,
        counts=np.asarray(volume.counts, np.int64),
        states=np.ones(n, np.uint8),
        offsets=np.zeros((n, 3), np.float32),
        backface=np.zeros(n, np.float32),
        parameters=PARAMETERS,
        distance_limit=volume.distance_limit,
        atlases={},
    )
