"""Passes, when to stop, and whether the error figure means what it says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.allocation import HALVES, SCRAMBLES, SCRAMBLES_PER_HALF, of_half
from bake_core.convergence import Point, decide, f95, fit_pass, next_pass, relative_error, spread
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


@pytest.mark.parametrize(
    ("samples", "error", "end"),
    [
        (64, None, 128),
        (64, 0.021, 72),  # 1.1 times as many: an eighth of 64, which is a round of scrambles
        (64, 0.024, 96),  # 1.44
        (64, 0.04, 128),  # four times: doubled, and looked at again
        (256, 0.0201, 288),
        (16, 0.0201, 32),  # the pilot is everybody's
    ],
)
def test_the_last_pass_is_no_longer_than_it_must_be(samples: int, error: float | None, end: int) -> None:
    assert next_pass(Stop(target_error=0.02, max_samples=4096), samples, error) == (samples, end)
    assert next_pass(Stop(target_error=None, max_samples=4096), samples, error) == (samples, 2 * samples)


def test_a_pass_is_shortened_to_the_time_that_is_left() -> None:
    stop = Stop(max_seconds=10.0, max_samples=4096)
    curve = [Point(16, 0, 2.0, 0.3), Point(32, 0, 4.0, 0.2)]  # 8 samples a second
    assert fit_pass(stop, (32, 64), curve, 4.0) == (32, 64)
    assert fit_pass(stop, (32, 64), curve, 8.0) == (32, 48)
    assert fit_pass(stop, (32, 64), curve, 7.9) == (32, 48)  # whole rounds of scrambles
    assert fit_pass(stop, (32, 64), curve, 8.1) == (32, 40)
    assert fit_pass(stop, (32, 64), curve, 9.1) == (32, 32)
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


def rounds(samples: int) -> Array:
    """How many samples each scramble has had."""
    scramble = np.arange(SCRAMBLES_PER_HALF)
    return np.concatenate([(of_half(samples, half) - scramble + SCRAMBLES_PER_HALF - 1) // SCRAMBLES_PER_HALF for half in range(HALVES)])


def error_of(sums: Array, samples: int) -> float:
    """The figure for probes that all had as many samples."""
    drawn = np.broadcast_to(rounds(samples), sums.shape[:2])
    return relative_error(spread(sums, drawn, drawn / samples))


def synthetic(random: np.random.Generator, probes: int, texels: int, samples: int, sigma: Array, correlated: bool) -> tuple[Array, Array]:
    """(sums, truth): scrambles whose means err normally; with `correlated`, all texels of a probe err alike, as shared paths make them."""
    truth = 0.2 + random.random((probes, 1, texels, 3))
    drawn = rounds(samples)[:, None, None]
    shape = (probes, SCRAMBLES, 1, 1) if correlated else (probes, SCRAMBLES, texels, 3)
    means = truth * (1 + sigma * random.normal(size=shape) / np.sqrt(drawn))
    return means * drawn, truth[:, 0]


def true_error(sums: Array, samples: int, truth: Array) -> float:
    """DESIGN's figure with the truth known."""
    difference = ((sums.sum(1) / samples - truth) ** 2).sum(-1)
    square = (truth**2).sum(-1)
    return float(np.sqrt((difference / (square + (0.05 * np.sqrt(square).mean()) ** 2)).mean()))


def coverage(probes: int, correlated: bool, samples: int, sigma: Array, trials: int = 2000) -> tuple[float, float]:
    """How often the true error is within the bound, and the median of bound over error."""
    random = np.random.default_rng(0)
    held, ratio = [], []
    for _ in range(trials):
        sums, truth = synthetic(random, probes, 16, samples, sigma, correlated)
        bound, error = error_of(sums, samples), true_error(sums, samples, truth)
        held.append(error <= bound)
        ratio.append(bound / error)
    return float(np.mean(held)), float(np.median(ratio))


@pytest.mark.parametrize(("probes", "samples", "loosest"), [(1, 64, 6.0), (2, 64, 3.0), (8, 64, 1.8), (30, 18, 1.4), (100, 16, 1.2)])
def test_the_bound_holds_95_times_out_of_100(probes: int, samples: int, loosest: float) -> None:
    """Where a probe's texels err alike: not less, not much more either. Of many probes the mean is well known, and the bound tight."""
    held, ratio = coverage(probes, True, samples, np.full((probes, 1, 1, 1), 0.4))
    assert 0.95 - 3 * math.sqrt(0.05 * 0.95 / 2000) < held < 0.985
    assert ratio < loosest


def test_the_bound_is_safe_where_texels_err_independently() -> None:
    held, ratio = coverage(20, False, 64, np.full((20, 1, 1, 1), 0.4), 100)
    assert held == 1 and ratio < 1.4


def test_the_bound_holds_where_a_few_probes_make_all_the_error() -> None:
    sigma = np.full((100, 1, 1, 1), 0.01)
    sigma[:3] = 1.0
    held, _ = coverage(100, True, 64, sigma)
    assert held > 0.92


def joined(random: np.random.Generator, probes: int, kept: float) -> tuple[Array, Array]:
    """As `synthetic`, but a half's scrambles err against one another: of their mean's variance only so much is left."""
    truth = 0.2 + random.random((probes, 1, 16, 3))
    error = random.normal(size=(probes, HALVES, SCRAMBLES_PER_HALF, 1, 1))
    mean = error.mean(2, keepdims=True)
    error = error + (math.sqrt(kept) - 1) * mean
    means = truth * (1 + 0.1 * error.reshape(probes, SCRAMBLES, 1, 1))
    return means * rounds(64)[:, None, None], truth[:, 0]


@pytest.mark.parametrize(("probes", "loosest"), [(1, 6.0), (30, 2.0), (300, 1.25)])
def test_the_halves_say_how_much_less_they_err_than_their_scrambles(probes: int, loosest: float) -> None:
    random = np.random.default_rng(3)
    held, ratio, known = [], [], []
    for _ in range(500):
        sums, truth = joined(random, probes, 0.4)
        drawn = np.broadcast_to(rounds(64), sums.shape[:2])
        bound, error = error_of(sums, 64), true_error(sums, 64, truth)
        held.append(error <= bound)
        ratio.append(bound / error)
        known.append(spread(sums, drawn, drawn / 64).ratio)
    assert np.mean(held) > 0.95 - 3 * math.sqrt(0.05 * 0.95 / 500)
    assert np.median(ratio) < loosest
    # Of one probe nobody knows; the spread about a half's mean is that of scrambles that err independently.
    assert np.mean(known) == (1 if probes == 1 else pytest.approx(0.4, rel=0.1))


def test_f_distribution() -> None:
    """Against the printed table."""
    for m, n, quantile in ((1, 3, 10.128), (2, 6, 5.143), (4, 12, 3.259), (8, 24, 2.355), (30, 90, 1.586)):
        assert f95(m, n) == pytest.approx(quantile, rel=0.04 if m == 1 else 0.002)


def test_more_samples_make_it_smaller_by_the_square_root() -> None:
    random = np.random.default_rng(2)
    few, many = (error_of(synthetic(random, 100, 16, n, np.full((100, 1, 1, 1), 0.4), False)[0], n) for n in (16, 1024))
    assert few / many == pytest.approx(8, rel=0.05)


def test_equal_scrambles_have_no_error() -> None:
    assert error_of(np.full((2, SCRAMBLES, 8, 3), 5.0), 64) == 0


def test_black_and_no_probe_have_no_error() -> None:
    assert error_of(np.zeros((2, SCRAMBLES, 8, 3)), 64) == 0
    assert error_of(np.zeros((0, SCRAMBLES, 8, 3)), 64) == 0


def test_unequal_rounds_are_weighted_by_their_share() -> None:
    """18 samples: two scrambles had two, the others one. Sums in proportion have no error; equal sums do."""
    drawn = rounds(18)[None, :, None, None]
    assert error_of(np.broadcast_to(drawn * 2.0, (1, SCRAMBLES, 8, 3)).copy(), 18) == pytest.approx(0, abs=1e-12)
    assert error_of(np.full((1, SCRAMBLES, 8, 3), 2.0), 18) > 0.01


def test_scale_does_not_matter_and_dark_texels_weigh_little() -> None:
    random = np.random.default_rng(4)
    sums, _ = synthetic(random, 20, 16, 64, np.full((20, 1, 1, 1), 0.3), False)
    plain = error_of(sums, 64)
    for scale in (1e-30, 1e30):
        assert error_of(sums * scale, 64) == pytest.approx(plain, rel=1e-9)
    # Texels a thousand times darker than the mean, all noise: under DARK_FRACTION they add little.
    dark = sums.copy()
    dark[:, :, ::2] = 4e-3 * random.random((20, SCRAMBLES, 8, 3)) * rounds(64)[:, None, None]
    assert error_of(dark, 64) < 1.2 * plain
