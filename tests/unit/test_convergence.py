"""Passes, when to stop, and whether the error figure means what it says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.convergence import Point, _f95, decide, fit_pass, next_pass, relative_error
from bake_core.spec import Stop

Array = NDArray[Any]


def passes(stop: Stop) -> list[tuple[int, int]]:
    out, samples = [], 0
    while samples < stop.max_samples:
        out.append(next_pass(stop, samples))
        samples = out[-1][1]
    return out


@pytest.mark.parametrize(
    ("most", "ends"),
    [(256, [16, 32, 64, 128, 256]), (64, [16, 32, 64]), (100, [16, 32, 64, 100]), (16, [16]), (5, [5]), (1, [1]), (17, [16, 17])],
)
def test_passes_double(most: int, ends: list[int]) -> None:
    assert passes(Stop(max_samples=most)) == list(zip([0, *ends[:-1]], ends, strict=True))


def test_a_pass_is_shortened_to_the_time_that_is_left() -> None:
    stop = Stop(max_seconds=10.0, max_samples=4096)
    curve = [Point(16, 0, 2.0, 0.3), Point(32, 0, 4.0, 0.2)]  # 8 samples a second
    assert fit_pass(stop, (32, 64), curve, 4.0) == (32, 64)
    assert fit_pass(stop, (32, 64), curve, 8.0) == (32, 48)
    assert fit_pass(stop, (32, 64), curve, 9.0) == (32, 40)
    assert fit_pass(stop, (32, 64), curve, 9.4) == (32, 36)  # whole rounds of four
    assert fit_pass(stop, (32, 64), curve, 9.6) == (32, 32)
    assert fit_pass(stop, (32, 64), curve, 1e9) == (32, 32)


def test_without_a_limit_or_before_anything_is_known_a_pass_is_whole() -> None:
    assert fit_pass(Stop(), (32, 64), [Point(32, 0, 1e9, None)], 1e9) == (32, 64)
    assert fit_pass(Stop(max_seconds=1.0), (0, 16), [], 100.0) == (0, 16)
    assert fit_pass(Stop(max_seconds=1.0), (16, 32), [Point(16, 0, 0.0, None)], 0.5) == (16, 32)


def test_speed_is_that_of_the_last_pass() -> None:
    """The first pass also captures distances."""
    stop = Stop(max_seconds=20.0)
    assert fit_pass(stop, (32, 64), [Point(16, 0, 10.0, None), Point(32, 0, 12.0, None)], 18.0) == (32, 48)


@pytest.mark.parametrize(
    ("stop", "samples", "error", "seconds", "verdict"),
    [
        (Stop(target_error=0.02), 64, 0.019, 1.0, "target"),
        (Stop(target_error=0.02), 64, 0.02, 1.0, "target"),
        (Stop(target_error=0.02), 64, 0.021, 1.0, "continue"),
        (Stop(target_error=0.02), 256, 0.021, 1.0, "samples"),
        (Stop(target_error=0.02), 256, 0.019, 1.0, "target"),
        (Stop(target_error=0.02), 3, None, 1.0, "continue"),
        (Stop(target_error=None), 64, 0.0, 1.0, "continue"),
        (Stop(target_error=None), 256, 0.5, 1.0, "samples"),
        (Stop(max_seconds=5.0), 64, 0.5, 4.9, "continue"),
        (Stop(max_seconds=5.0), 64, 0.5, 5.0, "time"),
        (Stop(max_seconds=5.0), 64, 0.01, 5.0, "target"),
        (Stop(max_seconds=5.0), 256, 0.5, 9.0, "samples"),
    ],
)
def test_verdicts(stop: Stop, samples: int, error: float | None, seconds: float, verdict: str) -> None:
    assert decide(stop, samples, error, seconds) == verdict


# --- the error figure ----------------------------------------------------------------------------------------------------------------


def synthetic(random: np.random.Generator, probes: int, texels: int, samples: int, sigma: Array, correlated: bool) -> tuple[Array, Array]:
    """(sums, truth): scrambles whose means err normally; with `correlated`, all texels of a probe err alike, as shared paths make them."""
    truth = 0.2 + random.random((probes, 1, texels, 3))
    drawn = np.array([-(-(samples - i) // 4) for i in range(4)])[:, None, None]
    shape = (probes, 4, 1, 1) if correlated else (probes, 4, texels, 3)
    means = truth * (1 + sigma * random.normal(size=shape) / np.sqrt(drawn))
    return means * drawn, truth[:, 0]


def true_error(sums: Array, samples: int, truth: Array) -> float:
    """DESIGN's figure with the truth known."""
    difference = ((sums.sum(1) / samples - truth) ** 2).sum(-1)
    square = (truth**2).sum(-1)
    return float(np.sqrt((difference / (square + (0.05 * np.sqrt(square).mean()) ** 2)).mean()))


def coverage(probes: int, correlated: bool, samples: int, sigma: Array, trials: int = 600) -> tuple[float, float]:
    """How often the true error is within the bound, and the median of bound over error."""
    random = np.random.default_rng(0)
    held, ratio = [], []
    for _ in range(trials):
        sums, truth = synthetic(random, probes, 16, samples, sigma, correlated)
        bound, error = relative_error(sums, samples, np.ones(probes, np.bool_)), true_error(sums, samples, truth)
        assert bound is not None
        held.append(error <= bound)
        ratio.append(bound / error)
    return float(np.mean(held)), float(np.median(ratio))


@pytest.mark.parametrize(("probes", "samples", "loosest"), [(1, 64, 6.0), (2, 64, 3.0), (8, 64, 1.8), (30, 18, 1.4), (100, 16, 1.2)])
def test_the_bound_holds_95_times_out_of_100(probes: int, samples: int, loosest: float) -> None:
    """Where a probe's texels err alike: not less, not much more either. Of many probes the mean is well known, and the bound tight."""
    held, ratio = coverage(probes, True, samples, np.full((probes, 1, 1, 1), 0.4))
    assert 0.95 - 3 * math.sqrt(0.05 * 0.95 / 600) < held < 0.985
    assert ratio < loosest


def test_the_bound_is_safe_where_texels_err_independently() -> None:
    held, ratio = coverage(20, False, 64, np.full((20, 1, 1, 1), 0.4), 100)
    assert held == 1 and ratio < 1.4


def test_the_bound_holds_where_a_few_probes_make_all_the_error() -> None:
    sigma = np.full((100, 1, 1, 1), 0.01)
    sigma[:3] = 1.0
    held, _ = coverage(100, True, 64, sigma)
    assert held > 0.92


def test_f_distribution() -> None:
    """Against the printed table."""
    for m, n, quantile in ((1, 3, 10.128), (2, 6, 5.143), (4, 12, 3.259), (8, 24, 2.355), (30, 90, 1.586)):
        assert _f95(m, n) == pytest.approx(quantile, rel=0.04 if m == 1 else 0.002)


def test_more_samples_make_it_smaller_by_the_square_root() -> None:
    random = np.random.default_rng(2)
    active = np.ones(100, np.bool_)
    few, many = (relative_error(synthetic(random, 100, 16, n, np.full((100, 1, 1, 1), 0.4), False)[0], n, active) for n in (16, 1024))
    assert few is not None and many is not None
    assert few / many == pytest.approx(8, rel=0.05)


@pytest.mark.parametrize("samples", [0, 1, 2, 3])
def test_with_fewer_samples_than_scrambles_there_is_none(samples: int) -> None:
    assert relative_error(np.ones((2, 4, 8, 3)), samples, np.ones(2, np.bool_)) is None


def test_equal_scrambles_have_no_error() -> None:
    assert relative_error(np.full((2, 4, 8, 3), 5.0), 64, np.ones(2, np.bool_)) == 0


def test_black_and_no_active_probe_have_no_error() -> None:
    assert relative_error(np.zeros((2, 4, 8, 3)), 64, np.ones(2, np.bool_)) == 0
    assert relative_error(np.random.default_rng(0).random((2, 4, 8, 3)), 64, np.zeros(2, np.bool_)) == 0


def test_inactive_probes_do_not_count() -> None:
    random = np.random.default_rng(3)
    sums, _ = synthetic(random, 10, 16, 64, np.full((10, 1, 1, 1), 0.1), False)
    active = np.arange(10) < 5
    noisy = sums.copy()
    noisy[5:] *= random.random((5, 4, 16, 3)) * 100
    assert relative_error(noisy, 64, active) == relative_error(sums, 64, active)


def test_unequal_rounds_are_weighted_by_their_share() -> None:
    """18 samples: two scrambles had five, two had four. Sums in proportion have no error; equal sums do."""
    drawn = np.array([5, 5, 4, 4.0])[None, :, None, None]
    active = np.ones(1, np.bool_)
    assert relative_error(np.broadcast_to(drawn * 2.0, (1, 4, 8, 3)).copy(), 18, active) == pytest.approx(0, abs=1e-12)
    assert relative_error(np.full((1, 4, 8, 3), 2.0), 18, active) > 0.01  # type: ignore[operator]


def test_scale_does_not_matter_and_dark_texels_weigh_little() -> None:
    random = np.random.default_rng(4)
    sums, _ = synthetic(random, 20, 16, 64, np.full((20, 1, 1, 1), 0.3), False)
    active = np.ones(20, np.bool_)
    plain = relative_error(sums, 64, active)
    assert plain is not None
    for scale in (1e-30, 1e30):
        assert relative_error(sums * scale, 64, active) == pytest.approx(plain, rel=1e-9)
    # Texels a thousand times darker than the mean, all noise: under DARK_FRACTION they add little.
    dark = sums.copy()
    dark[:, :, ::2] = 1e-3 * random.random((20, 4, 8, 3)) * 64
    assert relative_error(dark, 64, active) < 1.2 * plain  # type: ignore[operator]
