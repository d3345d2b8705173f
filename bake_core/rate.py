"""How fast a bake's error falls: the slope of log error against log samples and against log seconds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.convergence import Point

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Rate:
    """error = `coefficient` · x^`slope`, fitted.

    Attributes
    ----------
    points : int
        How many points of the curve have an error to fit.
    slope, coefficient : float or None
        None with fewer than two points.
    standard_error : float or None
        Of the slope; None with fewer than three points, for two lie on a line whatever they are.
    """

    points: int
    slope: float | None = None
    coefficient: float | None = None
    standard_error: float | None = None


def rate_by_samples(curve: Sequence[Point]) -> Rate:
    """The slope against samples: -0.5 for independent samples, steeper for what Sobol' points gain."""
    return _rate([p.samples for p in curve], curve)


def rate_by_seconds(curve: Sequence[Point], began: float) -> Rate:
    """The slope against seconds of tracing; `began` is when the first ray went out, on the curve's clock."""
    return _rate([p.seconds - began for p in curve], curve)


def rate_of_runs(x: Sequence[float], errors: Sequence[float]) -> Rate:
    """The slope through runs that share no samples, of errors above 0."""
    told = [(a, e) for a, e in zip(x, errors, strict=True) if a > 0 and e > 0]
    if len({a for a, _ in told}) < 2:
        return Rate(len(told[:1]))
    at, error = np.array(sorted(told), np.float64).T
    slope, level, standard_error = fit_line(np.log(at), np.log(error))
    return Rate(len(at), slope, math.exp(level), standard_error)


def in_words(rate: Rate | None) -> str:
    """A rate as people read it, or why there is none; None is one against seconds of which nobody knows how many went into tracing."""
    if rate is None:
        return "cannot be told: its seconds are not of tracing alone"
    if rate.slope is None:
        return f"cannot be told from {('no point', 'one point')[rate.points]} with an error above 0"
    if rate.standard_error is None:
        return f"{rate.slope:.2f}; how sure that is cannot be told from two points"
    return f"{rate.slope:.2f} ± {rate.standard_error:.2f}"


def _rate(x: Sequence[float], curve: Sequence[Point]) -> Rate:
    told = [(a, p.samples, p.error) for a, p in zip(x, curve, strict=True) if a > 0 and p.error is not None and p.error > 0]
    if len(told) < 2:
        return Rate(len(told))
    at, samples, error = np.array(told, np.float64).T
    slope, level, standard_error = fit_line(np.log(at), np.log(error), samples)
    return Rate(len(told), slope, math.exp(level), standard_error)


def fit_line(x: F64, y: F64, samples: F64 | None = None) -> tuple[float, float, float | None]:
    """Weighted least squares through logarithms of errors whose passes share samples.

    Parameters
    ----------
    x, y : (k,) float64
        From two points on.
    samples : (k,) float64
        That each point's error was measured from; rising. None where each has samples of its own, shared with no other.

    Returns
    -------
    slope, level : float
        Of y = level + slope · x.
    standard_error : float or None
        Of the slope; None with two points.

    Notes
    -----
    Aitken 1936, "On Least Squares and Linear Combination of Observations". A pass keeps the samples of those before it: the means of
    m < n independent samples have correlation √(m/n), their variances over the scrambles its square, m/n, and so have the logarithms of
    those. That is a Markov chain's correlation, so what is new in a point is its difference from ρ = m/n of the one before.
    Unweighted, the standard error would come out too small.
    """
    rho = np.zeros(len(x) - 1) if samples is None else samples[:-1] / samples[1:]
    rows = np.stack([np.ones_like(x), x, y], 1)
    rows[1:] = (rows[1:] - rho[:, None] * rows[:-1]) / np.sqrt(1 - rho * rho)[:, None]
    design, value = rows[:, :2], rows[:, 2]
    inverse = np.linalg.inv(design.T @ design)
    level, slope = inverse @ (design.T @ value)
    if len(x) == 2:
        return float(slope), float(level), None
    residual = value - design @ (level, slope)
    return float(slope), float(level), math.sqrt(float(residual @ residual) / (len(x) - 2) * float(inverse[1, 1]))
