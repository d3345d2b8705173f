"""Figures of pictures whose error is known."""

from __future__ import annotations

import numpy as np
import pytest

from bake_core.comparison import compare, flip_map
from bake_core.thresholds import Limits, Thresholds

EVERYWHERE = np.ones((60, 80), bool)


def noisy(value: float, seed: int, sigma: float = 0.5) -> np.ndarray:
    return (value * (1 + sigma * np.random.default_rng(seed).standard_normal((60, 80, 3)))).astype(np.float32)


def test_a_picture_five_per_cent_too_bright_is_told_so_through_noise() -> None:
    """Of a constant factor 1.05 it is 0.05² / (1 + 0.1²); the noise of the halves, ten times as much, stays out of it."""
    picture = np.full((60, 80, 3), 2.1, np.float32)
    figures = compare(picture, (noisy(2, 1, 0.3), noisy(2, 2, 0.3)), EVERYWHERE)
    assert figures.mean_ratio == pytest.approx(1.05, abs=0.01)
    exact = compare(picture, (noisy(2, 1, 0), noisy(2, 2, 0)), EVERYWHERE)
    assert exact.relmse == pytest.approx(0.05**2 / 1.01, rel=1e-4)
    assert exact.reference_noise == 0
    assert figures.reference_noise > 0.03
    assert figures.relmse == pytest.approx(exact.relmse, abs=0.002)


def test_only_surface_counts() -> None:
    surface = EVERYWHERE.copy()
    surface[:, 40:] = False
    picture = np.ones((60, 80, 3), np.float32)
    picture[:, 40:] = 100
    ones = np.ones_like(picture)
    figures = compare(picture, (ones, ones), surface)
    assert figures.mean_ratio == 1
    assert figures.relmse == 0
    assert figures.flip > 0.1


def test_black_pictures() -> None:
    black, light = np.zeros((60, 80, 3), np.float32), np.full((60, 80, 3), 1e-6, np.float32)
    same = compare(black, (black, black), EVERYWHERE)
    assert (same.mean_ratio, same.relmse, same.flip) == (1, 0, 0)
    assert Thresholds().failures({"indirect": same, "whole": same}) == []
    leak = compare(light, (black, black), EVERYWHERE)
    assert leak.mean_ratio is None
    assert leak.relmse is None
    assert Thresholds().failures({"indirect": leak, "whole": same}) == [
        "indirect: the path-traced picture is black and the rasterised one is not",
        "indirect: relMSE infinite is above 0.05",
    ]


def test_no_surface_at_all_is_no_failure() -> None:
    sky = np.ones((60, 80, 3), np.float32)
    figures = compare(sky, (sky, sky), ~EVERYWHERE)
    assert (figures.mean_ratio, figures.relmse, figures.flip) == (1, 0, 0)


def test_flip_tells_alike_from_unlike_also_where_most_is_black() -> None:
    reference = np.zeros((60, 80, 3), np.float32)
    reference[20:30, 20:50] = 5
    assert flip_map(reference, reference).max() == 0
    moved = flip_map(reference, np.roll(reference, 10, 1))
    assert moved.shape == (60, 80)
    assert 0.02 < moved.mean() < 0.5


def test_a_limit_that_is_not_kept_is_named_with_its_figure() -> None:
    ones = np.ones((60, 80, 3), np.float32)
    figures = compare(ones * np.float32(1.2), (ones, ones), EVERYWHERE)
    failures = Limits(mean_ratio=(0.95, 1.05), relmse=0.01, flip=0.001).failures(figures)
    assert failures[0] == "mean ratio 1.2000 is outside 0.95 to 1.05"
    assert failures[1].startswith("relMSE 0.0396 is above")
    assert failures[2].startswith("HDR-FLIP")
    assert Limits().failures(figures) == []
