"""Sums as bytes and back, and passes that may only be added whole and in turn."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.allocation import FULL, HALVES, SCRAMBLES, SCRAMBLES_PER_HALF
from bake_core.tally import BACKFACE_LIMIT, State, Tally

Array = NDArray[Any]
NOTHING = np.zeros((0, 0, 0, 0), np.float32)
PROBES, TEXELS = 6, 9
# The last three of them stand inside a solid.
BACKFACE = np.linspace(0, 0.5, PROBES, dtype=np.float32)


def tally(probes: tuple[int, int], samples: tuple[int, int], *, seed: int = 0, radiance: bool = True) -> Tally:
    """A shard's part of a pass: numbers that depend on the probe, not on the shard."""
    n = probes[1] - probes[0]
    random = np.random.default_rng(seed)
    kept = np.arange(*probes)[BACKFACE[slice(*probes)] < BACKFACE_LIMIT]
    whole = random.random((PROBES, SCRAMBLES, TEXELS, 3), np.float32)[kept]
    first = samples[0] == 0
    return Tally(
        *probes,
        *samples,
        taken=np.full((n, HALVES), samples[1] // HALVES),
        irradiance=whole,
        radiance=random.random((PROBES, HALVES, 16, 3), np.float32)[kept] if radiance else NOTHING,
        visibility=random.random((PROBES, 2, 2, 2))[kept].astype(np.float32) if first else np.zeros((0, 0, 0, 0), np.float32),
        backface=BACKFACE[slice(*probes)] if first else np.zeros(0, np.float32),
        distance=np.full((len(kept), 4), 2.0, np.float32) if first else np.zeros((0, 0), np.float32),
        normal=np.full((len(kept), 4, 3), 1.0, np.float32) if first else np.zeros((0, 0, 0), np.float32),
        rays=10 * n,
        learning=7 if probes[0] == 0 else 0,
    )


def empty() -> State:
    return State(
        samples=0,
        taken=np.zeros((PROBES, HALVES), np.int64),
        eighths=np.full((PROBES, HALVES), FULL),
        needed=np.ones(PROBES, np.bool_),
        irradiance=np.zeros((PROBES, SCRAMBLES, TEXELS, 3), np.float32),
        radiance=np.zeros((PROBES, HALVES, 16, 3), np.float32),
        visibility=np.zeros((PROBES, 2, 2, 2), np.float32),
        backface=np.zeros(PROBES, np.float32),
        distance=np.zeros((PROBES, 4), np.float32),
        normal=np.zeros((PROBES, 4, 3), np.float32),
        rays=0,
    )


def equal(a: Tally | State, b: Tally | State) -> bool:
    def same(x: Any, y: Any) -> bool:
        if isinstance(x, np.ndarray):
            return x.dtype == y.dtype and x.shape == y.shape and np.array_equal(x, y)
        return type(x) is type(y) and bool(x == y)

    return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


@pytest.mark.parametrize("samples", [(0, 16), (16, 32)])
def test_a_tally_comes_back_from_its_bytes(samples: tuple[int, int]) -> None:
    t = tally((1, 4), samples)
    data = t.to_bytes()
    assert equal(Tally.from_bytes(data), t)
    assert Tally.from_bytes(data).to_bytes() == data == tally((1, 4), samples).to_bytes()


def test_a_state_comes_back_from_its_bytes_and_can_go_on() -> None:
    state = empty()
    state.add([tally((0, PROBES), (0, 16))])
    data = state.to_bytes()
    again = State.from_bytes(data)
    assert equal(again, state) and again.to_bytes() == data
    for s in (state, again):
        s.add([tally((0, PROBES), (16, 32), seed=1)])
    assert again.to_bytes() == state.to_bytes()


def test_bytes_hold_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    data = tally((0, 2), (0, 16)).to_bytes()
    later = time.time() + 86_400 * 400
    monkeypatch.setattr(time, "time", lambda: later)
    assert tally((0, 2), (0, 16)).to_bytes() == data


def test_the_sum_does_not_depend_on_shards_or_their_order() -> None:
    splits = [[(0, 6)], [(0, 1), (1, 4), (4, 6)], [(4, 6), (0, 1), (1, 4)], [(i, i + 1) for i in range(6)]]
    sums = []
    for split in splits:
        state = empty()
        for k, samples in enumerate(((0, 16), (16, 32), (32, 64))):
            state.add([tally(probes, samples, seed=k) for probes in split])
        sums.append(state.to_bytes())
    assert len(set(sums)) == 1


def test_what_a_pass_adds() -> None:
    state = empty()
    first, second = tally((0, PROBES), (0, 16)), tally((0, PROBES), (16, 32), seed=1)
    state.add([first])
    state.add([second])
    assert state.samples == 32
    kept = state.active()
    assert len(first.irradiance) == kept.sum() == 3
    np.testing.assert_array_equal(state.irradiance[kept], first.irradiance + second.irradiance)
    np.testing.assert_array_equal(state.radiance[kept], first.radiance + second.radiance)
    np.testing.assert_array_equal(state.backface, first.backface)
    for name in ("visibility", "distance", "normal"):  # of the first pass only
        np.testing.assert_array_equal(getattr(state, name)[kept], getattr(first, name))
    for name in ("irradiance", "radiance", "visibility", "distance", "normal"):
        assert not getattr(state, name)[~kept].any()
    assert (state.allocation.eighths[~kept] == 0).all() and (state.allocation.eighths[kept] == FULL).all()


@pytest.mark.parametrize("samples", [1, 2, SCRAMBLES - 1])
def test_with_fewer_samples_than_scrambles_there_is_no_error(samples: int) -> None:
    state = empty()
    state.add([tally((0, PROBES), (0, samples))])
    assert state.error() is None


def test_inactive_probes_do_not_count() -> None:
    state = empty()
    state.add([tally((0, PROBES), (0, 16))])
    before = state.error()
    assert before is not None and before > 0
    inactive = ~state.active()
    assert 0 < inactive.sum() < PROBES
    state.irradiance[inactive] = np.random.default_rng(3).random((inactive.sum(), SCRAMBLES, TEXELS, 3)).astype(np.float32) * 100
    assert state.error() == before


def test_halves_count_alike_whatever_their_numbers_of_samples() -> None:
    """One half had 16 samples of 1, the other 8 of 4: no number of samples may have a say in the mean."""
    state = replace(empty(), samples=32, taken=np.tile([[16, 8]], (PROBES, 1)))
    state.irradiance[:, :SCRAMBLES_PER_HALF] = 16 / SCRAMBLES_PER_HALF * 1.0
    state.irradiance[:, SCRAMBLES_PER_HALF:] = 8 / SCRAMBLES_PER_HALF * 4.0
    state.radiance[:, 0], state.radiance[:, 1] = 16 * 1.0, 8 * 4.0
    np.testing.assert_array_equal(state.mean(), 2.5)
    np.testing.assert_array_equal(state.mean(slice(1, 3)), np.full((2, TEXELS, 3), 2.5))
    np.testing.assert_array_equal(state.mean_radiance(), 2.5)
    np.testing.assert_array_equal(state.scramble_means().mean(1), state.mean())
    assert state.error() == 0  # each half agrees with itself


@pytest.mark.parametrize(("probes", "loosest"), [(1, 1.25), (4, 1.15), (50, 1.05)])
def test_the_bound_of_radiance_holds_95_times_out_of_100(probes: int, loosest: float) -> None:
    """Two halves that err normally about texels of very different brightness: not less often, nor is the bound loose."""
    random = np.random.default_rng(1)
    held, ratio = [], []
    for _ in range(400):
        truth = random.exponential(size=(probes, 1, 256, 3))
        means = truth * (1 + 0.05 * random.normal(size=(probes, HALVES, 256, 1)))
        state = replace(
            empty(),
            samples=32,
            taken=np.full((probes, HALVES), 16),
            needed=np.ones(probes, np.bool_),
            backface=np.zeros(probes, np.float32),
            radiance=(16 * means).astype(np.float32),
        )
        difference, square = ((means.mean(1) - truth[:, 0]) ** 2).sum(-1), (truth[:, 0] ** 2).sum(-1)
        error = float(np.sqrt((difference / (square + (0.05 * np.sqrt(square).mean()) ** 2)).mean()))
        stated = state.radiance_error()
        assert stated is not None
        held.append(error <= stated)
        ratio.append(stated / error)
    assert np.mean(held) > 0.95 - 3 * (0.05 * 0.95 / 400) ** 0.5
    assert np.median(ratio) < loosest


def test_what_is_not_kept_is_not_added() -> None:
    state = replace(empty(), radiance=NOTHING, distance=np.zeros((0, 0), np.float32))
    state.add([tally((0, PROBES), (0, 16), radiance=False)])
    assert not state.radiance.size and not state.distance.size


@pytest.mark.parametrize(
    "passes",
    [
        [],  # no tally at all
        [((0, 3), (0, 16))],  # the end is missing
        [((1, 6), (0, 16))],  # the beginning
        [((0, 2), (0, 16)), ((3, 6), (0, 16))],  # a gap
        [((0, 4), (0, 16)), ((3, 6), (0, 16))],  # an overlap
        [((0, 3), (0, 16)), ((0, 3), (0, 16)), ((3, 6), (0, 16))],  # a shard twice
        [((0, 3), (0, 16)), ((3, 6), (0, 8))],  # of two passes
        [((0, 6), (16, 32))],  # not the next pass
    ],
)
def test_what_is_not_the_next_whole_pass_is_refused_and_changes_nothing(passes: list[Any]) -> None:
    state = empty()
    with pytest.raises(ValueError, match="pass"):
        state.add([tally(*p) for p in passes])
    assert equal(state, empty())


def test_a_pass_added_twice_is_refused() -> None:
    state = empty()
    state.add([tally((0, 6), (0, 16))])
    with pytest.raises(ValueError, match="does not follow"):
        state.add([tally((0, 6), (0, 16))])


def test_probes_that_see_backs_are_inactive() -> None:
    state = empty()
    state.add([tally((0, 6), (0, 16))])
    np.testing.assert_array_equal(state.active(), np.linspace(0, 0.5, 6) < BACKFACE_LIMIT)
    assert not replace(state, backface=np.full(6, BACKFACE_LIMIT, np.float32)).active().any()
