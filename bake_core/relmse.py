"""Relative squared error beside a reference that is noisy itself."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

# Below a tenth of the mean, error counts as absolute: else relMSE would be decided by the darkest corner.
RELMSE_FLOOR = 0.1


def relative_squares(answers: F64, estimates: F64, *, bounded: bool = False) -> F64:
    """Squared relative errors, in the mean free of the reference's noise.

    Parameters
    ----------
    answers : (n, 3) float64
    estimates : (k, n, 3) float64
        k ≥ 4, independent, of the same number of samples each. Not black everywhere.
    bounded : bool
        Divide by the answer's square, too: no square is above 1, so a few dark points that got light do not outweigh all others.

    Returns
    -------
    (n,) float64
        Their mean is relMSE. One may be negative where noise exceeds the error.

    Notes
    -----
    With a the answer, b the mean of the estimates, |·| over channels and m the mean of |b| over points, the relative error of a point is
    |a - b| / √(|b|² + (m/10)²). Its square is taken as the mean of (a - bᵢ)·(a - bⱼ) / (|b'|² + (m/10)²) over all pairs, b' being the mean
    of the estimates that are not in the pair: noise of neither factor is in the other, nor in the divisor.
    """
    k = len(estimates)
    floor = (RELMSE_FLOOR * np.linalg.norm(estimates.mean(0), axis=1).mean()) ** 2
    pairs = list(itertools.combinations(range(k), 2))
    own = (answers**2).sum(1) if bounded else 0.0
    out = np.zeros(len(answers))
    for i, j in pairs:
        others = estimates[[o for o in range(k) if o not in (i, j)]].mean(0)
        out += ((answers - estimates[i]) * (answers - estimates[j])).sum(1) / ((others**2).sum(1) + floor + own)
    return out / len(pairs)
