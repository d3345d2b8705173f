"""How wrong a bake still is, and when it stops.

The spread of independent scrambles gives each irradiance texel's standard error (Owen 1997, "Monte Carlo Variance of Scrambled Net
Quadrature": replicates of a scrambled sequence are independent and unbiased). DESIGN's figure puts them together:

    error = 95 % upper bound of √mean(|ΔE|² / (E² + (0.05 Ē)²)) over irradiance texels of active probes
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bake_core.spec import Stop

F64 = NDArray[np.float64]

# Texels darker than this fraction of the mean count as if they were this bright: nobody sees 2 % of black.
DARK_FRACTION = 0.05
# One-sided 95 % point of the normal distribution.
_Z95 = 1.6448536269514722
# The first pass; each later one doubles the samples.
FIRST_SAMPLES = 16
# A pass that a time limit shortens is a multiple of this: each scramble gets as many samples.
SMALLEST_PASS = 4

Verdict = Literal["continue", "target", "samples", "time", "interrupt"]


@dataclass(frozen=True)
class Point:
    """One point of a job's curve of error against run time: what there is at the end of a pass.

    Attributes
    ----------
    samples : int
        Of each capture texel, so far.
    rays : int
        Traced so far, of whatever kind: through texels, on from surfaces, towards light, for distances.
    seconds : float
        Since the bake began.
    error : float or None
        None where it cannot be measured (fewer samples than scrambles).
    """

    samples: int
    rays: int
    seconds: float
    error: float | None


def next_pass(stop: Stop, samples: int) -> tuple[int, int]:
    """The half-open range of samples of the pass after `samples` are done: 16, 32, 64, … up to the spec's maximum."""
    return samples, min(max(FIRST_SAMPLES, 2 * samples), stop.max_samples)


def fit_pass(stop: Stop, samples: tuple[int, int], curve: Sequence[Point], seconds: float) -> tuple[int, int]:
    """Shorten a pass so that it ends within the spec's time limit, judged by how long samples have taken so far.

    Parameters
    ----------
    samples : (int, int)
        From :func:`next_pass`.
    curve : sequence of Point
        Passes so far.
    seconds : float
        Since the bake began.

    Returns
    -------
    (int, int)
        Empty (start equals end) where not even one round of :data:`SMALLEST_PASS` samples fits.
    """
    if stop.max_seconds is None or not curve:
        return samples
    before = curve[-2] if len(curve) > 1 else Point(0, 0, 0.0, None)
    per_sample = (curve[-1].seconds - before.seconds) / (curve[-1].samples - before.samples)
    fitting = int(max(stop.max_seconds - seconds, 0) / max(per_sample, 1e-9)) // SMALLEST_PASS * SMALLEST_PASS
    return samples[0], samples[0] + min(samples[1] - samples[0], fitting)


def decide(stop: Stop, samples: int, error: float | None, seconds: float) -> Verdict:
    """Whether to go on after a pass, and if not, why. A target of null never stops early."""
    if stop.target_error is not None and error is not None and error <= stop.target_error:
        return "target"
    if samples >= stop.max_samples:
        return "samples"
    if stop.max_seconds is not None and seconds >= stop.max_seconds:
        return "time"
    return "continue"


def relative_error(sums: F64, samples: int, active: NDArray[np.bool_]) -> float | None:
    """DESIGN's error figure from per-scramble sums.

    Parameters
    ----------
    sums : (p, r, m, 3) float64
        Irradiance sums of r scrambles. With s samples, scramble i has had ⌈(s - i) / r⌉ of them.
    samples : int
        s.
    active : (p,) bool
        Probes that count.

    Returns
    -------
    float or None
        0.02 is 2 %. None with fewer than one sample in each scramble; 0 where everything is black.
    """
    r = sums.shape[1]
    if samples < r:
        return None
    sums = sums[active]
    if not sums.size:
        return 0.0
    drawn = np.array([-(-(samples - i) // r) for i in range(r)], np.float64)
    means = sums / drawn[:, None, None]
    estimate = sums.sum(1) / samples
    # Variance of the pooled estimate: the scrambles' spread, each weighted by its share of the samples.
    share = drawn / samples
    spread = ((means - estimate[:, None]) ** 2 * share[:, None, None] ** 2).sum(1) * (r / (r - 1))
    variance = spread.sum(-1)
    square = (estimate**2).sum(-1)
    floor = (DARK_FRACTION * float(np.sqrt(square).mean())) ** 2
    if floor == 0:
        return 0.0
    per_probe = (variance / (square + floor)).mean(1)
    mean = float(per_probe.mean())
    if mean == 0:
        return 0.0
    # How many probes' worth of errors there are: Satterthwaite 1946, and his sum of squares without its bias. A probe counts as one number,
    # because its texels share paths.
    n = min(float(per_probe.sum()) ** 2 / float((per_probe**2).sum()) * (r + 1) / (r - 1), len(per_probe))
    # The error itself scatters like χ² of n degrees of freedom, what is known of it like n (r - 1): their quotient is F-distributed.
    return math.sqrt(mean * _f95(n, n * (r - 1)))


def _f95(m: float, n: float) -> float:
    """The 95 % point of the F distribution with m ≥ 1 and n ≥ 3 degrees of freedom: Paulson 1942, Ann. Math. Stat. 13(2).

    4 % too large at (1, 3), within 0.2 % from (2, 6) on.
    """
    a, b = 2 / (9 * m), 2 / (9 * n)
    p, q = 1 - a, 1 - b
    return ((p * q + _Z95 * math.sqrt(p * p * b + q * q * a - a * b * _Z95**2)) / (q * q - b * _Z95**2)) ** 3
