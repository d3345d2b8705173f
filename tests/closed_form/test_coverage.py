"""The intervals that a bake's scrambles give hold the truth as often as they say."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from bake_core.prepared import Prepared
from tests.closed_form.coverage_table import SCENES, coverage


@pytest.mark.slow
@pytest.mark.parametrize(("name", "make", "target"), SCENES, ids=[name for name, _, _ in SCENES])
def test_intervals_hold_the_truth_as_often_as_they_say(name: str, make: Callable[[Path], Prepared], target: float) -> None:
    found = coverage(name, make, target)
    assert found.pairs >= 1000
    assert 0.93 <= found.probes <= 0.97
    assert 0.93 <= found.texels <= 0.97
    # Adaptive sampling is on, and nothing that it saves is paid for in bias.
    assert found.allotted < 0.95
    assert abs(found.bias) < 4 * found.within < 0.01
    # Of bakes that state a 95 % bound so many must hold it: all but what has a chance of less than 1 in 1,000.
    assert found.bounded >= _least(found.seeds)


def _least(bakes: int) -> int:
    """The fewest of so many successes of probability 0.95 that come about more often than 1 time in 1,000: binomial."""
    chance, fewest = 0.0, 0
    while chance < 1e-3:
        chance += math.comb(bakes, fewest) * 0.95**fewest * 0.05 ** (bakes - fewest)
        fewest += 1
    return fewest - 1


def test_the_same_in_a_hurry() -> None:
    """One scene, a fifth of the pairs: 95 % within four standard errors of a share."""
    found = coverage(*SCENES[0][:2], target=0.03, pairs=200, times=16)
    assert abs(found.probes - 0.95) < 4 * math.sqrt(0.95 * 0.05 / found.pairs)
