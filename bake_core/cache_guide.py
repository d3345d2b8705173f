"""Where light comes from about the points that the light cache learns at: which directions are worth more paths.

What paths from neighbouring points brought is kept by the part of the square that their directions were drawn from, and later paths are
drawn by it: Jensen 1995, "Importance Driven Path Tracing using the Photon Map"; in proportion to the root of the mean square, which is
best where what a direction brings is uncertain itself (Rath et al. 2020, "Variance-Aware Path Guiding"). Half of all paths are still drawn
by the cosine, so that none weighs more than twice what it would.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import kernel

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U64 = NDArray[np.uint64]

# Parts along either side of the square that directions are drawn from.
PARTS = 8
# Fewer points of one group have too few paths to tell of.
FEWEST_POINTS = 16
# What a group takes in memory: two sums for each part, and the table.
GROUP_BYTES = (2 * 8 + 4) * PARTS * (PARTS + 1)
# The share of paths that goes where light came from.
_GUIDED = 0.5
# As many paths as this count as one that found the mean everywhere, lest few that found nothing hide a part.
_PRIOR = 0.5
_BELOW_ONE = np.float32(1 - 2.0**-24)


class Guide(NamedTuple):
    """What is known of groups of points.

    Attributes
    ----------
    group : (g,) uint64, ascending
        Their codes.
    square, paths : (g, PARTS · PARTS) float64
        By part, sums over paths that were drawn there, each over its density: of the squares of what they brought, and of one.
    """

    group: U64
    square: F64
    paths: F64

    @classmethod
    def of(cls, codes: U64) -> Self:
        """One that knows nothing, of the groups that some points (n,) are of, if they are not too few."""
        group, points = np.unique(codes, return_counts=True)
        group = group[points >= FEWEST_POINTS]
        return cls(group, np.zeros((len(group), PARTS * PARTS)), np.zeros((len(group), PARTS * PARTS)))

    def rows(self, codes: U64) -> I64:
        """Which group each point (n,) is of; -1 where it is of none."""
        row = np.searchsorted(self.group, codes)
        row[row == len(self.group)] = 0
        return np.where(self.group[row] == codes, row, -1) if len(self.group) else np.full(len(codes), -1)

    def hear(self, heard: tuple[I64, F64]) -> None:
        """Add what :func:`sums` tells of some paths."""
        place, (square, paths) = heard
        self.square.reshape(-1)[place] += square
        self.paths.reshape(-1)[place] += paths

    def table(self) -> F32:
        """What :func:`guided` reads, (g, PARTS, PARTS + 1) float32: running sums of chances, of a row's parts and, last, of the rows."""
        mean = self.square.sum(1, keepdims=True) / np.maximum(self.paths.sum(1, keepdims=True), 1)
        weight = np.sqrt((self.square + _PRIOR * mean) / (self.paths + _PRIOR))
        total = weight.sum(1, keepdims=True)
        even = 1 / (PARTS * PARTS)
        chance = np.where(total > 0, (1 - _GUIDED) * even + _GUIDED * weight / np.where(total > 0, total, 1), even)
        chance = chance.reshape(-1, PARTS, PARTS)
        across = chance.cumsum(2)
        rows = across[:, :, -1].cumsum(1)
        table = np.concatenate([across / across[:, :, -1:], (rows / rows[:, -1:])[:, :, None]], 2).astype(np.float32)
        table[:, :, -2] = 1
        table[:, -1, -1] = 1
        return np.ascontiguousarray(table)


def sums(rows: I64, part: NDArray[np.uint8], brought: F64) -> tuple[I64, F64]:
    """What paths brought, by place in a guide's sums: (k,), and (2, k).

    Parameters
    ----------
    rows : (n,) int64
        Of the points that they are from.
    part : (n, paths) uint8
        Of each path.
    brought : (n, paths, 2) float64
        The square of what it brought, and one, over its density. Squares of float32's largest and smallest radiances are none in float32.
    """
    known = rows >= 0
    place, which = np.unique(rows[known, None] * (PARTS * PARTS) + part[known], return_inverse=True)
    return place, np.stack([np.bincount(which.ravel(), brought[known, :, i].ravel(), len(place)) for i in (0, 1)])


@kernel
def guided(table, u, v):  # type: ignore[no-untyped-def]
    """A point of the square drawn by a group's table (PARTS, PARTS + 1), and one over its density: strata stay strata."""
    row, below = 0, np.float32(0)
    while u >= table[row, PARTS]:
        below = table[row, PARTS]
        row += 1
    tall = table[row, PARTS] - below
    column, left = 0, np.float32(0)
    while v >= table[row, column]:
        left = table[row, column]
        column += 1
    wide = table[row, column] - left
    x = (row + min((u - below) / tall, _BELOW_ONE)) / np.float32(PARTS)
    y = (column + min((v - left) / wide, _BELOW_ONE)) / np.float32(PARTS)
    return min(np.float32(x), _BELOW_ONE), min(np.float32(y), _BELOW_ONE), 1 / (np.float64(tall) * wide * (PARTS * PARTS))
