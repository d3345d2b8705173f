"""How much light gets through a wall: the leak ratio of :func:`bake_core.examples.two_rooms`, of any way to ask for irradiance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

# So many that not one corner of the room is missed: a point for every 8 cm square.
COUNT = 4096
# Of the dark room: within a spacing of the shared wall's dark side, at x = 0.01.
_NEAR, _FAR = 0.01, 1.01
# Low corner, two edges, normal: the wall, the floor, the ceiling, the sides.
_SURFACES = np.array(
    [
        [[_NEAR, 0, -2], [0, 3, 0], [0, 0, 4], [1, 0, 0]],
        [[_NEAR, 0, -2], [_FAR - _NEAR, 0, 0], [0, 0, 4], [0, 1, 0]],
        [[_NEAR, 3, -2], [_FAR - _NEAR, 0, 0], [0, 0, 4], [0, -1, 0]],
        [[_NEAR, 0, -2], [_FAR - _NEAR, 0, 0], [0, 3, 0], [0, 0, 1]],
        [[_NEAR, 0, 2], [_FAR - _NEAR, 0, 0], [0, 3, 0], [0, 0, -1]],
    ],
    np.float64,
)
# To the lit room.
_MIRROR = np.array([-1.0, 1.0, 1.0])


def dark_points(scale: float = 1.0) -> tuple[F64, F64]:
    """Positions and normals (COUNT, 3) on the dark room's surfaces near the shared wall, uniform over their area.

    Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences", in two dimensions; the surface by where a number falls in their
    areas' running sum.
    """
    plastic = 1.32471795724474602596
    i = np.arange(COUNT) + 1
    u, v = i / plastic % 1, i / plastic**2 % 1
    area = np.linalg.norm(np.cross(_SURFACES[:, 1], _SURFACES[:, 2]), axis=-1)
    ends = np.cumsum(area) / area.sum()
    surface = np.searchsorted(ends, (np.arange(COUNT) + 0.5) / COUNT)
    corner, a, b, normal = np.moveaxis(_SURFACES[surface], 1, 0)
    return (corner + u[:, None] * a + v[:, None] * b) * scale, normal


def leak_ratio(ask: Callable[[F64, F64], F64], scale: float = 1.0) -> float:
    """Mean irradiance at points of the dark room over that at the same points mirrored into the lit one.

    Parameters
    ----------
    ask : callable
        Irradiance (n, 3) of positions and normals (n, 3).
    scale : float
        That of the rooms.
    """
    positions, normals = dark_points(scale)
    return float(ask(positions, normals).mean() / ask(positions * _MIRROR, normals * _MIRROR).mean())
