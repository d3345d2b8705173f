"""The fitted rate against power laws that are known, and its standard error against simulated bakes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bake_core.convergence import Point
from bake_core.rate import fit_line, in_words, rate_by_samples, rate_by_seconds

PASSES = np.array([16.0, 32, 64, 128, 256, 512])


def power_law(slope: float, coefficient: float, passes: int) -> list[Point]:
    """A bake that starts tracing after 3 s and takes 0.25 s a sample."""
    return [Point(int(n), 0, 3 + n / 4, coefficient * n**slope) for n in PASSES[:passes]]


@pytest.mark.parametrize("slope", [-0.5, -1.0, -0.73])
def test_a_power_law_is_found_exactly(slope: float) -> None:
    curve = power_law(slope, 0.8, 5)
    by_samples, by_seconds = rate_by_samples(curve), rate_by_seconds(curve, 3.0)
    assert by_samples.slope == pytest.approx(slope) and by_samples.coefficient == pytest.approx(0.8)
    # n = 4 t
    assert by_seconds.slope == pytest.approx(slope) and by_seconds.coefficient == pytest.approx(0.8 * 4**slope)
    for rate in (by_samples, by_seconds):
        assert rate.points == 5 and rate.standard_error == pytest.approx(0, abs=1e-9)


def test_what_cannot_be_told_is_not() -> None:
    one = rate_by_samples(power_law(-0.5, 1.0, 1))
    assert (one.points, one.slope, one.standard_error) == (1, None, None) and "cannot be told" in in_words(one)
    two = rate_by_samples(power_law(-0.5, 1.0, 2))
    assert two.slope == pytest.approx(-0.5) and two.standard_error is None and in_words(two).startswith("-0.50; ")
    assert rate_by_samples([]).points == 0 and "no point" in in_words(rate_by_samples([])) and "tracing alone" in in_words(None)
    # Errors that could not be measured, or are 0 (a furnace), have no logarithm.
    assert rate_by_samples([Point(2, 0, 1.0, None), Point(16, 0, 2.0, 0.0), Point(32, 0, 3.0, 0.1)]).points == 1


def test_the_fit_is_least_squares_with_the_whole_covariance() -> None:
    """Against the textbook's (X' C⁻¹ X)⁻¹ X' C⁻¹ y with C = min(m, n) / max(m, n), passes of odd sizes included."""
    samples = np.array([16.0, 32, 64, 100, 104])
    x, y = np.log(samples), np.array([0.3, -0.2, -0.1, -0.7, -0.75])
    inverse = np.linalg.inv(np.minimum.outer(samples, samples) / np.maximum.outer(samples, samples))
    design = np.stack([np.ones(5), x], 1)
    covariance = np.linalg.inv(design.T @ inverse @ design)
    level, slope = covariance @ design.T @ inverse @ y
    residual = y - design @ (level, slope)
    expected = slope, level, math.sqrt(residual @ inverse @ residual / 3 * covariance[1, 1])
    assert fit_line(x, y, samples) == pytest.approx(expected)


def test_the_standard_error_is_what_independent_samples_scatter() -> None:
    """2,000 bakes of 40 texels and 4 scrambles of independent samples: rate -0.5, and 95 % of t-intervals hold it."""
    random = np.random.default_rng(1)
    bakes, texels, scrambles = 2000, 40, 4
    steps = np.diff(PASSES, prepend=0)
    sums = (random.standard_normal((bakes, len(PASSES), texels, scrambles)) * np.sqrt(steps)[:, None, None]).cumsum(1)
    error = np.sqrt((sums / PASSES[:, None, None]).var(-1, ddof=1).mean(-1))
    fits = np.array([fit_line(np.log(PASSES), np.log(e), PASSES)[::2] for e in error], np.float64)
    slope, standard_error = fits.T
    assert slope.mean() == pytest.approx(-0.5, abs=4 * slope.std() / math.sqrt(bakes))
    # Student's t with 6 - 2 degrees of freedom; the count's own σ is 0.5 %.
    held = np.mean(np.abs(slope + 0.5) < 2.776 * standard_error)
    assert held == pytest.approx(0.95, abs=0.02)
