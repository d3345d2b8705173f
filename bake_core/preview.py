"""A first look at a bake: the irradiance maps of some of its probes side by side."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bake_core.tally import State
from bake_core.verification_report import display, exposure_for

# More maps than this nobody looks at one by one.
MOST_PROBES = 256
# Texels are drawn as squares of this side, so that a map of eight texels can be seen.
_SCALE = 4


def preview(state: State) -> NDArray[np.uint8]:
    """Draw at most :data:`MOST_PROBES` probes, spread evenly over the bake, row by row; those inside geometry are black.

    Parameters
    ----------
    state : State
        With at least one sample.

    Returns
    -------
    picture : (height, width, 3) uint8
        sRGB, each map in octahedral coordinates with a dark line around it.
    """
    irradiance, active = state.mean(), state.active()
    n, m = irradiance.shape[:2]
    chosen = np.unique(np.linspace(0, n - 1, min(n, MOST_PROBES)).round().astype(int))
    side, columns = math.isqrt(m), math.isqrt(len(chosen) - 1) + 1
    rows = -(-len(chosen) // columns)
    maps = np.where(active[chosen, None, None], irradiance[chosen], 0.0).reshape(-1, side, side, 3)
    tile = side * _SCALE + 1
    picture = np.zeros((rows * tile, columns * tile, 3), np.float32)
    for at, tile_map in enumerate(maps):
        y, x = at // columns * tile, at % columns * tile
        picture[y : y + tile - 1, x : x + tile - 1] = tile_map.repeat(_SCALE, 0).repeat(_SCALE, 1)
    return display(picture, exposure_for(picture))
