"""Who gets how many samples: halves that decide about each other, and never about themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.allocation import FULL, HALVES, PILOT_SAMPLES, SCRAMBLES, Allocation, densities, of_half, uniform

Array = NDArray[Any]


@pytest.mark.parametrize("samples", [0, 1, 2, 15, 16, 17, 19, 256])
def test_halves_share_all_samples(samples: int) -> None:
    assert sum(of_half(samples, half) for half in range(HALVES)) == samples
    np.testing.assert_array_equal(Allocation.start(3).spans((0, samples)), uniform(3, (0, samples)))


def test_passes_follow_one_another_without_a_gap() -> None:
    given = Allocation.start(4)
    for first, end in ((0, 16), (16, 32)):
        given = Allocation(given.spans((first, end))[..., 1], given.eighths)
    assert (given.taken * HALVES == PILOT_SAMPLES).all()
    given = Allocation(given.taken, np.array([[8, 8], [4, 1], [1, 8], [2, 4]]))
    for first, end in ((32, 64), (64, 128), (128, 256), (256, 320)):
        spans = given.spans((first, end))
        np.testing.assert_array_equal(spans[..., 0], given.taken)
        given = Allocation(spans[..., 1], given.eighths)
        # Each has its share of the hardest probe's samples, or the pilot; rounded up to a whole round of a half's scrambles.
        share = np.maximum(end / HALVES * given.eighths / FULL, PILOT_SAMPLES / HALVES)
        assert (given.taken >= share).all() and (given.taken < share + SCRAMBLES / HALVES).all()
    assert given.taken[0].tolist() == [160, 160]


def test_a_limit_that_is_no_whole_round_is_kept() -> None:
    given = Allocation(np.full((2, HALVES), 16), np.array([[8, 8], [1, 4]]))
    np.testing.assert_array_equal(given.spans((32, 35))[..., 1], [[18, 17], [16, 16]])


def test_a_shard_is_told_what_the_whole_bake_is() -> None:
    given = Allocation(np.arange(20).reshape(10, 2) * 8, np.tile([[2, 8]], (10, 1)))
    np.testing.assert_array_equal(given.spans((32, 64), slice(3, 7)), given.spans((32, 64))[3:7])
    assert Allocation.from_bytes(given.to_bytes()).to_bytes() == given.to_bytes()


def test_each_half_is_sampled_by_what_the_other_saw() -> None:
    rates = np.full((4, HALVES), 1e-3)
    rates[0, 0], rates[1, 1] = 1.0, 1.0  # one half finds probe 0 hard, the other probe 1
    chosen = densities(rates, target=0.5, most=4096)
    assert chosen[0, 1] == FULL and chosen[0, 0] == 1
    assert chosen[1, 0] == FULL and chosen[1, 1] == 1
    again = rates.copy()
    again[:, 0] = 7.0
    np.testing.assert_array_equal(densities(again, 0.5, 4096)[:, 0], chosen[:, 0])


def test_samples_go_as_the_root_of_the_variance() -> None:
    """Neyman 1934: at as many samples in all, no other choice has less variance."""
    rates = np.geomspace(1 / 64, 1, 200)[:, None].repeat(HALVES, 1)
    chosen = densities(rates, target=0.5, most=4096)
    exact = FULL * np.sqrt(rates[:, 0])
    assert (chosen[:, 0] >= exact * (1 - 1e-12)).all() and (chosen[:, 0] < 2 * np.maximum(exact, 1)).all()
    n = chosen[:, 0] / FULL
    assert (rates[:, 0] / n).mean() < 0.9 * (rates[:, 0] / n.mean()).mean()


def test_where_the_target_is_far_everybody_gets_all() -> None:
    """Uniform sampling would just reach it, or not even that: no probe is starved for another's sake."""
    rates = np.geomspace(1 / 64, 1, 200)[:, None].repeat(HALVES, 1)
    just = float(np.sqrt(rates.mean() / 256))
    assert (densities(rates, just / 2, 256) == FULL).all()
    chosen = densities(rates, just * 1.4, 256)
    assert (rates[:, 0] * FULL / chosen[:, 0]).mean() / 256 <= (0.8 * just * 1.4) ** 2
    assert chosen.mean() < FULL


def test_black_probes_get_the_least() -> None:
    assert (densities(np.zeros((3, HALVES)), 0.02, 256) == 1).all()
