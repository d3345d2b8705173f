"""Who gets how many samples: a bake's scrambles in two halves, each deciding where the other's samples go.

Samples go where the error is: at equal cost of a sample, a mean of relative variances r/n is least for n ∝ √r (Neyman 1934, "On the Two
Different Aspects of the Representative Method"). But whoever gets more samples because of what it has seen is biased: a probe whose first
samples happened to be dark looks finished, and keeps its dark mean (Kirk and Arvo 1991, "Unbiased Sampling Techniques for Image
Synthesis"). Here the scrambles of one half decide about those of the other, once, after a pilot that is the same for all:

    n of half A = function of half B's pilot,    n of half B = function of half A's pilot.

Halves share no random number. Given what B saw, A's numbers of samples are constants and each of A's means is unbiased; so is the mean of
both, whose weights are constants too. No weight depends on a value that it multiplies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bake_core.stored import Stored

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# Independent scrambles of every sample sequence. Their spread is the bake's error: Sobol' points themselves are not independent.
HALVES = 2
SCRAMBLES_PER_HALF = 4
SCRAMBLES = HALVES * SCRAMBLES_PER_HALF
# The first pass; each later one doubles the samples. The first two are everybody's.
FIRST_SAMPLES = 16
PILOT_SAMPLES = 2 * FIRST_SAMPLES
# Densities are counted in eighths; the least is one, so that a probe that saw nothing of a rare light in the pilot looks again.
FULL = 8
# How much of the target may be spent on sampling easy probes less, if the sample limit is to be enough all the same. The rest is for what
# three degrees of freedom do not know, and for the bound's distance from the estimate.
_PART_OF_TARGET = 0.8


def of_half(samples: int, half: int) -> int:
    """How many of a bake's first `samples` samples are a half's."""
    return (samples + HALVES - 1 - half) // HALVES


def of_scramble(samples: Any, scramble: Any) -> Any:
    """How many of a half's first `samples` samples are a scramble's, 0 to SCRAMBLES_PER_HALF - 1: ints or arrays; in kernels, too."""
    return (samples + SCRAMBLES_PER_HALF - 1 - scramble) // SCRAMBLES_PER_HALF


def uniform(probes: int, samples: tuple[int, int]) -> I64:
    """(p, HALVES, 2) int64: the same half-open range of samples for every probe, as each half counts them."""
    span = [[of_half(end, half) for end in samples] for half in range(HALVES)]
    return np.broadcast_to(np.array(span, np.int64), (probes, HALVES, 2)).copy()


@dataclass(frozen=True)
class Allocation(Stored):
    """What probes have had, and how many of the hardest one's samples they are to have.

    Attributes
    ----------
    taken : (n, HALVES) int64
        Samples of each half so far.
    eighths : (n, HALVES) int64
        Out of FULL; 0 for a probe inside a solid, which is not traced. Else a power of two, so that a probe has had one of the numbers of
        points at which a Sobol' sequence is a net, whenever the hardest probe has; until its share is more than the pilot was, it is left
        out of passes.
    """

    taken: I64
    eighths: I64

    @classmethod
    def start(cls, probes: int) -> Self:
        """Before the first sample."""
        return cls(np.zeros((probes, HALVES), np.int64), np.full((probes, HALVES), FULL, np.int64))

    def spans(self, samples: tuple[int, int], probes: slice = slice(None)) -> I64:
        """(p, HALVES, 2) int64: what a pass over a half-open range of samples means for some probes."""
        taken, eighths = self.taken[probes], self.eighths[probes]
        most = np.array([of_half(samples[1], half) for half in range(HALVES)])
        # Whole rounds of scrambles, so that all of a half have had as many.
        rounds = -(-most * eighths // (FULL * SCRAMBLES_PER_HALF)) * SCRAMBLES_PER_HALF
        return np.stack([taken, np.maximum(taken, np.minimum(rounds, most))], -1)


def _power_of_two(least: F64) -> I64:
    """The smallest of 1, 2, 4 and 8 that is not less."""
    out: I64 = 2 ** np.ceil(np.log2(np.clip(least, 1, FULL))).astype(np.int64)
    return out


def densities(rates: F64, target: float, most: int) -> I64:
    """How densely to sample each probe's halves after the pilot.

    Parameters
    ----------
    rates : (n, HALVES) float64
        Each half's own estimate of a probe's relative variance per sample.
    target : float
        Relative error that the bake is to reach.
    most : int
        Samples that no texel may exceed.

    Returns
    -------
    (n, HALVES) int64
        Out of FULL. As √rate, the hardest probes at FULL; flatter where that would leave the target out of reach of `most`
        samples.
    """
    out = np.full(rates.shape, FULL, np.int64)
    for half in range(HALVES):
        rate = rates[:, HALVES - 1 - half]
        root = np.sqrt(rate)
        allowed = (_PART_OF_TARGET * target) ** 2 * most
        # From Neyman's choice towards uniform: the first that reaches the target in time.
        for reference in root.max(initial=0.0) * 0.5 ** np.arange(0, 8, 0.25):
            if reference <= 0:
                eighths = np.ones(len(rate), np.int64)
                break
            eighths = _power_of_two(FULL * root / reference)
            if (rate * FULL / eighths).mean() <= allowed:
                break
        else:
            eighths = np.full(len(rate), FULL, np.int64)
        out[:, half] = eighths
    return out
