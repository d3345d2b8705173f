"""Volumes without light, for tests of where receivers are drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bake_core.bundle import VolumeData


def volume(origin: ArrayLike, spacing: ArrayLike, counts: ArrayLike, *, active: bool = True) -> VolumeData:
    """A grid of probes, all of them active or none."""
    cells = np.asarray(counts, np.int64)
    n = int(cells.prod())
    return VolumeData(
        name="grid",
        origin=np.asarray(origin, np.float64),
        spacing=np.asarray(spacing, np.float64),
        counts=cells,
        states=np.full(n, active, np.uint8),
        offsets=np.zeros((n, 3), np.float32),
        backface=np.zeros(n, np.float32),
        parameters={},
        distance_limit=1.0,
        atlases={},
    )
