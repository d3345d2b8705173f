"""How much GGX reflects at a single bounce: the tables that give back what it loses, and the quadrature that they come from.

`python -m bake_core.ggx_albedo` writes ggx_albedo.npz anew; it is kept in a file so that every machine reads the same bits.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Below this roughness (alpha 1e-4, a lobe 1e-4 rad wide, a tenth of a millimetre one metre away) a surface is taken to have it: a mirror
# to every map of ours, whose finest texel is 1e-3 rad, and no second branch for directions that no density knows.
MIN_ROUGHNESS = 0.01
# With 64 × 64 entries the tables are right to 6e-4 at roughness 0.05, 4e-4 from 0.1 on and 1e-3 below: a third of what an eye or a test of
# 0.2 % could tell.
_ROWS = _COLUMNS = 64
_FILE = Path(__file__).with_suffix(".npz")


class AlbedoTable(NamedTuple):
    """Directional albedo of single-scattering GGX, by roughness and cosine.

    Attributes
    ----------
    values : (rows, columns, 2) float32
        At roughness MIN_ROUGHNESS … 1 and x in [0, 1], both even: E, what a surface of reflectance 1 reflects, and B - E (1 - cosθ)⁵,
        where B is what it reflects at the reflectance (1 - wo·h)⁵: the small part of B, so that its error is small too.
    averages : (rows, 2) float32
        2 ∫ · cosθ dcosθ of E and B.
    """

    values: F32
    averages: F32


def table_coordinate(cosine: F64, roughness: F64 | float) -> F64:
    """Where in a row a cosine lies: t (1 + r) / (t + r), t = √cosθ. Inverse: :func:`table_cosine`.

    E dips where cosθ is about alpha = r², however small that is: it lies at x = (1 + r) / 2.
    """
    t = np.sqrt(cosine)
    out: F64 = t * (1 + roughness) / (t + roughness)
    return out


def table_cosine(x: F64, roughness: F64 | float) -> F64:
    """Inverse of :func:`table_coordinate`."""
    out: F64 = (roughness * x / (1 + roughness - x)) ** 2
    return out


def single_scatter_albedo(cosine: F64, roughness: float, points: tuple[int, int] = (400, 200)) -> tuple[F64, F64]:
    """E and B of GGX with height-correlated Smith shadowing, by quadrature over visible normals.

    Heitz 2014, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs"; the visible normals by the spherical caps of
    Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps": ∫ f cosθ dω = ∫ F G₂/G₁ du dv over the unit square.

    Parameters
    ----------
    cosine : (n,) float64
        Of wo, above 0.
    roughness : float
        Alpha is its square.
    points : (int, int)
        Gauss points along the cap's axis, even points around half of it.
    """
    alpha = roughness**2
    node, weight = np.polynomial.legendre.leggauss(points[0])
    u, weight = ((node + 1) / 2)[:, None], (weight / 2)[:, None] / points[1]
    phi = (np.arange(points[1]) + 0.5) * np.pi / points[1]
    e, b = np.empty(len(cosine)), np.empty(len(cosine))
    for i, mu in enumerate(cosine):
        sine = np.sqrt(max(0.0, 1 - mu * mu))
        spread = np.sqrt(mu * mu + (alpha * sine) ** 2)
        ox, oz = alpha * sine / spread, mu / spread
        cap = (1 - u) * (1 + oz) - oz
        radius = np.sqrt(np.maximum(0.0, 1 - cap * cap))
        hx, hy, hz = alpha * (radius * np.cos(phi) + ox), alpha * radius * np.sin(phi), cap + oz
        length = np.sqrt(hx * hx + hy * hy + hz * hz)
        across = (hx * sine + hz * mu) / length
        down = np.maximum(2 * across * hz / length - mu, 0.0)
        # G₂/G₁ as in bake_core.ggx.
        g = down * (spread + mu) / (spread * down + np.sqrt(alpha**2 + (1 - alpha**2) * down * down) * mu)
        e[i] = np.sum(weight * g)
        b[i] = np.sum(weight * g * np.clip(1 - across, 0, 1) ** 5)
    return e, b


def _compute() -> AlbedoTable:
    roughnesses = np.linspace(MIN_ROUGHNESS, 1, _ROWS)
    x = np.linspace(0, 1, _COLUMNS)
    values, averages = np.empty((_ROWS, _COLUMNS, 2)), np.empty((_ROWS, 2))
    node, weight = np.polynomial.legendre.leggauss(16)
    # Inside each cell: the fraction of the way to its right end, and the quadrature's weight.
    share, weight = (node + 1) / 2, weight / 2
    for row, r in enumerate(roughnesses):
        mu = table_cosine(x, r)
        # At 0 the limit: a grazing ray sees only what reflects it on.
        e, b = single_scatter_albedo(np.maximum(mu, 1e-12), r)
        rest = b - e * (1 - mu) ** 5
        values[row] = np.stack([e, rest], 1)
        # Of the table as it is read between its entries, not of what it was made from: what is left over then integrates to exactly 1.
        at = (x[:-1, None] + share * (x[1] - x[0])).ravel()
        cosine = table_cosine(at, r)
        dcosine = 2 * np.sqrt(cosine) * r * (1 + r) / (1 + r - at) ** 2
        inside = np.tile(weight, _COLUMNS - 1) * (x[1] - x[0]) * 2 * cosine * dcosine
        ei, di = np.interp(at, x, e), np.interp(at, x, rest)
        averages[row] = np.sum(inside * ei), np.sum(inside * (di + ei * (1 - cosine) ** 5))
    return AlbedoTable(values.astype(np.float32), averages.astype(np.float32))


@cache
def albedo_table() -> AlbedoTable:
    """The table as it lies beside this module."""
    with np.load(_FILE) as f:
        return AlbedoTable(np.ascontiguousarray(f["values"]), np.ascontiguousarray(f["averages"]))


if __name__ == "__main__":
    np.savez(_FILE, **_compute()._asdict())
