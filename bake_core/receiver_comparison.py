"""How far a bundle's answers are from path-traced irradiance at receivers. docs/verification.md defines the figures for a reader."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.bundle import VolumeData
from bake_core.irradiance import sample
from bake_core.receiver_irradiance import irradiance_at
from bake_core.receivers import Receivers, draw_receivers, stands_of
from bake_core.relmse import RELMSE_FLOOR, relative_squares
from bake_core.scene import Scene
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]

# Enough that a figure's own scatter from the choice of points is a few per cent of it.
COUNT = 2048
# Two for the product of differences, and as many for what that is divided by, which must not share their noise.
_SCRAMBLES = 4
_SEED = 0x0C70BA50
_PERCENTILE = 95


@dataclass(frozen=True)
class ReceiverFigures:
    """What a bundle's irradiance is like beside the path-traced one.

    Attributes
    ----------
    mean, reference_mean : float
        Of all channels.
    mean_ratio : float or None
        Their quotient; 1 where both are black, None where only the reference is.
    relmse : float or None
        Free of the reference's noise. None where only the reference is black.
    p95 : float or None
        The relative error that 95 % of the receivers keep.
    reference_noise : float
        relMSE of the reference itself, which was kept out of `relmse`.
    reference_p95 : float
        What `p95` would be for a bundle without error: it is not free of noise, and this must be well below.
    """

    mean: float
    reference_mean: float
    mean_ratio: float | None
    relmse: float | None
    p95: float | None
    reference_noise: float
    reference_p95: float


def compare_receivers(answers: F64, estimates: F64) -> ReceiverFigures:
    """Compare irradiance with independent estimates of its reference.

    Parameters
    ----------
    answers : (n, 3) float64
    estimates : (k, n, 3) float64
        k ≥ 4, of the same number of samples each.

    Notes
    -----
    With a the answer, b the mean of the estimates, |·| over channels and m the mean of |b| over receivers, the relative error of a
    receiver is |a - b| / √(|b|² + (m/10)²). relMSE is the mean of its square, by :func:`bake_core.relmse.relative_squares`.
    """
    k, n = estimates.shape[:2]
    if k < 4:
        raise ValueError("at least four estimates are needed: two for a difference's square, two for what divides it")
    if not n:
        return ReceiverFigures(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    reference = estimates.mean(0)
    mean, reference_mean = float(answers.mean()), float(reference.mean())
    if reference_mean == 0:
        same = mean == 0
        return ReceiverFigures(mean, 0.0, 1.0 if same else None, 0.0 if same else None, 0.0 if same else None, 0.0, 0.0)
    size = np.linalg.norm(reference, axis=1)
    floor = (RELMSE_FLOOR * size.mean()) ** 2
    noise = []
    for i, j in itertools.combinations(range(k), 2):
        others = estimates[[o for o in range(k) if o not in (i, j)]].mean(0)
        weight = 1 / ((others**2).sum(1) + floor)
        noise.append((((estimates[i] - estimates[j]) ** 2).sum(1) * weight).mean() / (2 * k))
    scale = np.sqrt(size**2 + floor)
    error = np.linalg.norm(answers - reference, axis=1) / scale
    # Half the difference of the estimates' halves scatters as their mean does.
    halves = (estimates[: k // 2].mean(0) - estimates[k // 2 : k // 2 * 2].mean(0)) / 2
    return ReceiverFigures(
        mean,
        reference_mean,
        mean / reference_mean,
        float(relative_squares(answers, estimates).mean()),
        float(np.percentile(error, _PERCENTILE)),
        float(np.mean(noise)),
        float(np.percentile(np.linalg.norm(halves, axis=1) / scale, _PERCENTILE)),
    )


def measure_receivers(
    scene: Scene,
    tracer: Tracer,
    volumes: Sequence[VolumeData],
    *,
    samples: int,
    threads: int = 1,
    advance: Callable[[float], None] | None = None,
    cancelled: NDArray[np.uint8] | None = None,
) -> tuple[Receivers, F64, F64]:
    """Draw receivers, ask a bundle's volumes, and path-trace; the view direction is the normal.

    Parameters
    ----------
    samples : int
        Paths from each receiver, all estimates together; a multiple of four.

    Returns
    -------
    receivers : Receivers
        :data:`COUNT`, or fewer where the volumes hold hardly any surface.
    answers : (n, 3) float64
    estimates : (4, n, 3) float64
        Independent of one another.

    Raises
    ------
    Cancelled
    """
    receivers = draw_receivers(scene, tracer, volumes, COUNT, _SEED, cancelled=cancelled)
    estimates = irradiance_at(
        tracer,
        stands_of(tracer, receivers.places),
        samples=samples // _SCRAMBLES,
        scrambles=_SCRAMBLES,
        seed=_SEED,
        threads=threads,
        advance=advance,
        cancelled=cancelled,
    )
    return receivers, sample(volumes, receivers.positions, receivers.normals).irradiance, estimates
