"""How wrong a bake still is, and when it stops.

The spread of scrambles gives each irradiance texel's standard error (Owen 1997, "Monte Carlo Variance of Scrambled Net Quadrature").
Those of one half share out the points of one sequence between them, so that the half errs less than as many independent ones would. How
much less, its difference from the other half says, whose sequence is another: one number a probe, but one for the whole bake is well known
from all of its probes (a ratio estimate; Cochran 1977, "Sampling Techniques", chapter 6). DESIGN's figure puts them together:

    error = 95 % upper bound of √mean(|ΔE|² / (E² + (0.05 Ē)²)) over irradiance texels of active probes
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import FIRST_SAMPLES, HALVES, PILOT_SAMPLES, SCRAMBLES, SCRAMBLES_PER_HALF
from bake_core.spec import Stop

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# Texels darker than this fraction of the mean count as if they were this bright: nobody sees 2 % of black.
DARK_FRACTION = 0.05
# One-sided 95 % point of the normal distribution.
_Z95 = 1.6448536269514722
# A pass that is shortened is a multiple of this: each scramble gets as many samples.
SMALLEST_PASS = SCRAMBLES
_PROBES_AT_ONCE = 512
# Where fewer probes than these have most of the variance, nobody knows how much less than their scrambles their halves vary.
_FEWEST_PROBES = 4

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


def next_pass(stop: Stop, samples: int, error: float | None = None) -> tuple[int, int]:
    """The half-open range of samples of the pass after `samples` are done: 16, 32, 64, … up to the spec's maximum.

    The last pass is no longer than the error so far says that it must be, in eighths of what is done: independent samples would need
    (error / target)² as many, and scrambled ones need fewer.
    """
    end = max(FIRST_SAMPLES, 2 * samples)
    if stop.target_error is not None and error is not None and samples >= PILOT_SAMPLES:
        needed = samples * (error / stop.target_error) ** 2
        step = max(samples // 8 // SMALLEST_PASS, 1) * SMALLEST_PASS
        end = min(end, samples + max(math.ceil((needed - samples) / step), 1) * step)
    return samples, min(end, stop.max_samples)


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


@dataclass(frozen=True)
class Spread:
    """What scrambles say of an estimate.

    Attributes
    ----------
    square, variance : (p, m) float64
        Of texels: the estimate's square and its variance, summed over colours.
    degrees : int
        Of freedom, of each variance.
    ratio : float
        What `variance` has already been multiplied by: how much less two halves differ than their scrambles say, 1 at most.
    doubt : float
        By how much more that may be, a factor: its own 95 % bound.
    """

    square: F64
    variance: F64
    degrees: int
    ratio: float = 1.0
    doubt: float = 1.0

    def relative(self, floor: float | None = None) -> F64:
        """(p,) float64: each probe's mean of |ΔE|² / (E² + (0.05 Ē)²) over its texels; 0 where everything is black.

        Parameters
        ----------
        floor : float, optional
            (0.05 Ē)², where it is not that of these probes.
        """
        added = self.floor() if floor is None else floor
        whole = self.square + added
        share: F64 = np.divide(self.variance, whole, out=np.zeros_like(whole), where=whole > 0)
        per_probe: F64 = share.mean(1)
        return per_probe

    def floor(self) -> float:
        """(0.05 Ē)², Ē being the mean over all texels of |E|."""
        return (DARK_FRACTION * float(np.sqrt(self.square).mean())) ** 2 if self.square.size else 0.0


def spread(sums: NDArray[np.floating], drawn: I64, share: F64, half: int | None = None) -> Spread:
    """The variance of an estimate from its scrambles, each half's about its own mean, and from how much the halves differ.

    Parameters
    ----------
    sums : (p, SCRAMBLES, m, 3) float
        One half's scrambles stand together.
    drawn : (p, SCRAMBLES) int64
        Samples of each scramble; none may be 0.
    share : (p, SCRAMBLES) float64
        Each scramble's share of the estimate.
    half : int, optional
        Only that half's word, as if it were the whole estimate; its scrambles' spread, which says too much rather than too little.
    """
    chosen = range(HALVES) if half is None else range(half, half + 1)
    p, _, m, _ = sums.shape
    square, variance, difference = np.empty((p, m)), np.empty((p, m)), np.zeros((p, m))
    # A few probes at a time: the sums of all of them are most of a bake's memory.
    for first in range(0, p, _PROBES_AT_ONCE):
        part = slice(first, first + _PROBES_AT_ONCE)
        n = len(sums[part])
        varied, parts, wholes = np.zeros((n, m)), [], []
        for h in chosen:
            own = slice(h * SCRAMBLES_PER_HALF, (h + 1) * SCRAMBLES_PER_HALF)
            weight = share[part, own, None, None]
            means = sums[part, own] / drawn[part, own, None, None].astype(np.float64)
            total, mean = weight.sum(1), (weight * means).sum(1)
            parts.append(mean)
            wholes.append(total)
            varied += ((means - (mean / total)[:, None]) ** 2 * weight**2).sum((1, 3))
        whole = np.asarray(sum(wholes))
        square[part] = ((np.asarray(sum(parts)) / whole) ** 2).sum(-1)
        variance[part] = varied / whole[..., 0] ** 2 * SCRAMBLES_PER_HALF / (SCRAMBLES_PER_HALF - 1)
        if half is None:
            # Of a sum of two that err independently and count alike, half the difference varies as half the sum does.
            (a, b), (of_a, of_b) = parts, wholes
            difference[part] = ((a / of_a - b / of_b) ** 2 * (of_a * of_b / whole**2)).sum(-1)
    found = Spread(square, variance, len(chosen) * (SCRAMBLES_PER_HALF - 1))
    if half is not None:
        return found
    ratio, doubt = _ratio(found.relative(), replace(found, variance=difference).relative())
    return replace(found, variance=ratio * variance, ratio=ratio, doubt=doubt)


def _ratio(scrambles: F64, halves: F64) -> tuple[float, float]:
    """How much less halves vary than their scrambles say, and by what factor it may be more.

    Parameters
    ----------
    scrambles, halves : (p,) float64
        What each says of a probe's relative variance.
    """
    whole, square = float(scrambles.sum()), float((scrambles**2).sum())
    # How many probes make the variance, had all as much of it (Kish 1965, "Survey Sampling", section 8.2).
    if square <= 0 or whole**2 / square < _FEWEST_PROBES:
        return 1.0, 1.0
    ratio = float(halves.sum()) / whole
    error = math.sqrt(float(((halves - ratio * scrambles) ** 2).sum())) / whole
    # Points that share out a sequence never make a worse estimate than independent ones.
    likely = min(ratio, 1.0)
    # On both sides of Student's distribution, for a ratio of few probes is not as well known as its scatter says.
    student = math.sqrt(float(f95(1.0, whole**2 / square - 1)))
    return likely, min(ratio + student * error, 1.0) / likely if likely > 0 else 1.0


def relative_error(found: Spread) -> float:
    """DESIGN's error figure.

    Returns
    -------
    float
        0.02 is 2 %. 0 where there is nothing, or everything is black.
    """
    return error_bound(found.relative(), found.degrees, found.doubt)


def error_bound(per_probe: F64, degrees: int, doubt: float, times: float = 1.0) -> float:
    """The 95 % bound of a root mean square from each probe's estimated mean square.

    Parameters
    ----------
    per_probe : (p,) float64
        As :meth:`Spread.relative` has it.
    degrees, doubt : int, float
        Of freedom, of each; and by how much more all may be: :class:`Spread`'s.
    times : float
        Of how many times as many probes like these, which leave less doubt: what a plan says of a bake from a few of its probes.
    """
    mean = float(per_probe.mean()) if per_probe.size else 0.0
    if mean == 0:
        return 0.0
    # How many probes' worth of errors there are: Satterthwaite 1946, and his sum of squares without its bias. A probe counts as one number,
    # because its texels share paths.
    n = min(float(per_probe.sum()) ** 2 / float((per_probe**2).sum()) * (1 + 2 / degrees), len(per_probe)) * times
    # The error itself scatters like χ² of n degrees of freedom, what is known of it like n times those of each: their quotient is
    # F-distributed.
    return math.sqrt(mean * float(f95(n, n * degrees)) * (1 + (doubt - 1) / math.sqrt(times)))


def interval(means: F64, share: F64, ratio: float) -> tuple[F64, F64]:
    """Two-sided 95 % confidence intervals of numbers that each scramble has estimated.

    Student's t, with the degrees of freedom that Welch 1947 and Satterthwaite 1946 give to a sum of two halves' variances.

    Parameters
    ----------
    means : (p, SCRAMBLES, ...) float64
        One half's scrambles stand together.
    share : (p, SCRAMBLES) float64
        Each scramble's share of the estimate.
    ratio : float
        :class:`Spread`'s.

    Returns
    -------
    (p, ...) float64, (p, ...) float64
        Middles, and half the widths.
    """
    weight = share.reshape(*share.shape, *[1] * (means.ndim - 2))
    middle = (weight * means).sum(1)
    variances = []
    for half in range(HALVES):
        own = slice(half * SCRAMBLES_PER_HALF, (half + 1) * SCRAMBLES_PER_HALF)
        mean = (weight[:, own] * means[:, own]).sum(1, keepdims=True) / weight[:, own].sum(1, keepdims=True)
        spread_out = ((means[:, own] - mean) ** 2 * weight[:, own] ** 2).sum(1)
        variances.append(spread_out * SCRAMBLES_PER_HALF / (SCRAMBLES_PER_HALF - 1))
    total = np.asarray(sum(variances))
    squares = np.asarray(sum(v**2 for v in variances)) / (SCRAMBLES_PER_HALF - 1)
    degrees = np.divide(total**2, squares, out=np.full_like(total, SCRAMBLES - HALVES), where=squares > 0)
    # Student's t squared is F with one degree of freedom above.
    return middle, np.sqrt(f95(1.0, degrees) * ratio * total)


def f95(m: float, n: Any) -> Any:
    """The 95 % point of the F distribution with m ≥ 1 and n ≥ 3 degrees of freedom: Paulson 1942, Ann. Math. Stat. 13(2).

    4 % too large at (1, 3), within 0.2 % from (2, 6) on.
    """
    a, b = 2 / (9 * m), 2 / (9 * n)
    p, q = 1 - a, 1 - b
    return ((p * q + _Z95 * np.sqrt(p * p * b + q * q * a - a * b * _Z95**2)) / (q * q - b * _Z95**2)) ** 3
