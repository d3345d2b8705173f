"""Figures of answers whose error is known."""

from __future__ import annotations

import numpy as np
import pytest

from bake_core.receiver_comparison import compare_receivers
from bake_core.thresholds import ReceiverLimits, Thresholds, parse_thresholds


def test_noise_of_the_reference_stays_out_of_relmse() -> None:
    """Answers 5 % too bright, estimates of 40 %: 0.05² |E|² / (|E|² + (m/10)²), to a fiftieth of the noise that is kept out."""
    random = np.random.default_rng(1)
    truth = np.exp(random.normal(0, 1, (20000, 1))) * [3.0, 2.0, 1.0]
    noisy = truth * (1 + 0.4 * random.standard_normal((4, 20000, 3)))
    exact = compare_receivers(1.05 * truth, np.broadcast_to(truth, noisy.shape))
    size = np.linalg.norm(truth, axis=1)
    expected = (0.05**2 * size**2 / (size**2 + (0.1 * size.mean()) ** 2)).mean()
    assert exact.relmse == pytest.approx(expected, rel=1e-9)
    assert exact.reference_noise == pytest.approx(0, abs=1e-20)
    assert exact.p95 == pytest.approx(0.05, rel=0.02)
    found = compare_receivers(1.05 * truth, noisy)
    assert found.mean_ratio == pytest.approx(1.05, abs=0.01)
    assert found.reference_noise == pytest.approx(0.4**2 / 4 * expected / 0.05**2, rel=0.1)
    assert found.relmse is not None
    assert abs(found.relmse - expected) < 0.02 * found.reference_noise


def test_what_noise_leaves_of_the_percentile_is_told() -> None:
    """Right answers: the percentile is the reference's own noise, and reference_p95 says so."""
    random = np.random.default_rng(2)
    truth = np.full((20000, 3), 2.0)
    found = compare_receivers(truth, truth * (1 + 0.2 * random.standard_normal((4, 20000, 3))))
    assert found.p95 == pytest.approx(found.reference_p95, rel=0.03)
    assert found.relmse == pytest.approx(0, abs=0.03 * found.reference_noise)


def test_black_and_none() -> None:
    black = np.zeros((10, 3))
    dark = compare_receivers(black, np.zeros((4, 10, 3)))
    assert (dark.mean_ratio, dark.relmse, dark.p95) == (1, 0, 0)
    leak = compare_receivers(black + 1e-6, np.zeros((4, 10, 3)))
    assert (leak.mean_ratio, leak.relmse, leak.p95) == (None, None, None)
    none = compare_receivers(np.zeros((0, 3)), np.zeros((4, 0, 3)))
    assert (none.mean_ratio, none.relmse, none.p95) == (1, 0, 0)
    limits = ReceiverLimits(mean_ratio=(0.9, 1.1), relmse=0.1, p95=0.1)
    assert limits.failures(dark) == limits.failures(none) == []
    assert limits.failures(leak) == [
        "the path-traced irradiance is black and the bundle's is not",
        "relMSE infinite is above 0.1",
        "95th percentile of the relative error infinite is above 0.1",
    ]
    with pytest.raises(ValueError, match="four"):
        compare_receivers(black, np.zeros((2, 10, 3)))


def test_limits_are_read_from_a_file_and_default_to_none() -> None:
    ones = np.ones((100, 3))
    figures = compare_receivers(1.5 * ones, np.broadcast_to(ones, (4, 100, 3)))
    assert Thresholds().receivers.failures(figures) == []
    limits = parse_thresholds({"receivers": {"mean_ratio": [0.9, 1.1], "relmse": 0.05, "p95": 0.3}}).receivers
    assert limits.failures(figures) == [
        "mean ratio 1.5000 is outside 0.9 to 1.1",
        "relMSE 0.2475 is above 0.05",
        "95th percentile of the relative error 0.4975 is above 0.3",
    ]
