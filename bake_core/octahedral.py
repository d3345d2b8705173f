"""The octahedral map of the sphere onto a square, its texels, and tiles with a wrapping border.

Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit Vectors", JCGT 3(2). Mirrors ``shaders/octahedral.glsl``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def dir_to_oct(w: NDArray[np.floating]) -> NDArray[np.floating]:
    """Project directions onto the octahedral square.

    Inverse of :func:`oct_to_dir`. Mirrors ``obDirToOct`` in ``shaders/octahedral.glsl``.

    Parameters
    ----------
    w : (..., 3) floating
        Directions; any length but zero.

    Returns
    -------
    oct_xy : (..., 2), dtype of `w`
        Points in [-1, 1]^2.

    Notes
    -----
    A zero counts as positive, so both sides of a fold agree, and so does -0.
    """
    w = np.asarray(w)
    p = w[..., :2] / np.abs(w).sum(axis=-1, keepdims=True)
    folded = (1 - np.abs(p[..., ::-1])) * np.where(p >= 0, 1, -1).astype(w.dtype)
    square: NDArray[np.floating] = np.where(w[..., 2:] < 0, folded, p)
    return square


def oct_to_dir(oct_xy: NDArray[np.floating]) -> NDArray[np.floating]:
    """Unit directions of points of the octahedral square.

    Inverse of :func:`dir_to_oct`. Mirrors ``obOctToDir``.

    Parameters
    ----------
    oct_xy : (..., 2) floating
        Points in [-1, 1]^2.

    Returns
    -------
    w : (..., 3), dtype of `oct_xy`
    """
    p = np.asarray(oct_xy)
    z = 1 - np.abs(p).sum(axis=-1, keepdims=True)
    t = np.maximum(-z, 0)
    xy = p + np.where(p >= 0, -t, t)
    v = np.concatenate([xy, z], axis=-1)
    unit: NDArray[np.floating] = v / np.linalg.norm(v, axis=-1, keepdims=True)
    return unit


def wrap_oct(oct_xy: NDArray[np.floating]) -> NDArray[np.floating]:
    """Points a little outside the square, as texels of a border are, to the points of the square that they stand for.

    Crossing an edge at height y comes back through the same edge at -y. Mirrors ``obWrapOct`` in ``shaders/trace.glsl``.

    Parameters
    ----------
    oct_xy : (..., 2) floating
        Points in (-3, 3)^2.

    Returns
    -------
    (..., 2), dtype of `oct_xy`
        Points in [-1, 1]^2.
    """
    p = np.array(oct_xy)
    for axis in (0, 1):
        over = np.abs(p[..., axis]) > 1
        along = np.where(p[..., axis] > 0, 2, -2) - p[..., axis]
        p[..., axis] = np.where(over, along, p[..., axis])
        p[..., 1 - axis] = np.where(over, -p[..., 1 - axis], p[..., 1 - axis])
    return p


def texel_directions(n: int) -> F64:
    """Directions through the centres of an n×n map's texels.

    Returns
    -------
    (n, n, 3) float64
        Row index grows with the square's second coordinate, column with its first.
    """
    c = (np.arange(n) + 0.5) * 2 / n - 1
    x, y = np.meshgrid(c, c)
    d: F64 = oct_to_dir(np.stack([x, y], -1)).astype(np.float64)
    return d


def texel_triangles(n: int) -> F64:
    """Every texel of an n×n map (n even) as two spherical triangles.

    A face of the octahedron is flat, so straight lines in the square become great circles on the sphere. With n even the folds run
    along texel edges and diagonals; split along the right diagonal, each half of a texel is one spherical triangle.

    Returns
    -------
    (n, n, 2, 3, 3) float64
        row, column, half, vertex, xyz; unit vertices.
    """
    if n % 2:
        raise ValueError("n must be even: a texel across a fold would be no spherical polygon")
    e = np.arange(n + 1) * 2 / n - 1
    x0, y0 = np.meshgrid(e[:-1], e[:-1])
    x1, y1 = np.meshgrid(e[1:], e[1:])
    a, b, c, d = (oct_to_dir(np.stack(p, -1)) for p in ((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
    # The fold |x| + |y| = 1 falls in quadrants with x·y > 0 and has slope -1 there, +1 in the others.
    falling = ((x0 + x1) * (y0 + y1) > 0)[..., None, None]
    first = np.where(falling, np.stack([a, b, d], -2), np.stack([a, b, c], -2))
    second = np.where(falling, np.stack([b, c, d], -2), np.stack([a, c, d], -2))
    out: F64 = np.stack([first, second], 2)
    return out


def texel_solid_angles(n: int) -> F64:
    """Exact solid angles of an n×n map's texels (n even); they sum to 4π.

    Van Oosterom and Strackee 1983, "The Solid Angle of a Plane Triangle".

    Returns
    -------
    (n, n) float64
        Steradians.
    """
    t = texel_triangles(n)
    a, b, c = t[..., 0, :], t[..., 1, :], t[..., 2, :]
    triple = np.abs((a * np.cross(b, c)).sum(-1))
    omega = 2 * np.arctan2(triple, 1 + (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1))
    total: F64 = omega.sum(-1)
    return total


def texel_cosines(n: int, normals: F64) -> F64:
    """Exact integrals of the clamped cosine over an n×n map's texels (n even): ∫ max(0, normal·ω) dω; they sum to π.

    Lambert 1760, "Photometria": over a spherical polygon the cosine's integral is half the sum, over edges, of arc length times the
    cosine between the normal and the edge's plane. Polygons are clipped at the normal's horizon first.

    Parameters
    ----------
    n : int
    normals : (m, 3) float64
        Unit.

    Returns
    -------
    (m, n²) float64
    """
    corners = texel_triangles(n).reshape(-1, 3, 3)
    out = np.empty((len(normals), n * n))
    for row, normal in enumerate(normals):
        height = corners @ normal
        total = np.zeros(len(corners))
        leaves, enters = np.zeros((len(corners), 3)), np.zeros((len(corners), 3))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            u, v, hu, hv = corners[:, a], corners[:, b], height[:, a, None], height[:, b, None]
            crossing = u * np.abs(hv) + v * np.abs(hu)
            crossing /= np.maximum(np.linalg.norm(crossing, axis=1, keepdims=True), 1e-300)
            start, end = np.where(hu >= 0, u, crossing), np.where(hv >= 0, v, crossing)
            total += np.where((hu >= 0) | (hv >= 0), _arc(start, end, normal)[:, None], 0)[:, 0]
            leaves += np.where((hu >= 0) & (hv < 0), crossing, 0)
            enters += np.where((hu < 0) & (hv >= 0), crossing, 0)
        # The piece of horizon between where the outline leaves and where it comes back.
        along = (np.cross(leaves, enters) * normal).sum(1)
        total += np.arctan2(along, (leaves * enters).sum(1))
        out[row] = np.abs(total / 2).reshape(-1, 2).sum(1)
    return out


def convolved(radiance: NDArray[np.floating], m: int) -> F64:
    """Irradiance, no 1/π inside, from radiance that is the same all over each texel.

    Parameters
    ----------
    radiance : (..., n, n, c) float

    Returns
    -------
    (..., m, m, c) float64
    """
    *probes, n, _, channels = radiance.shape
    texels = radiance.reshape(*probes, n * n, channels)
    rows = texel_cosines(n, texel_directions(m).reshape(-1, 3))
    # No matrix product: its sums are others on another machine.
    sums = [(row[:, None] * texels).sum(-2) for row in rows]
    return np.stack(sums, -2).reshape(*probes, m, m, channels)


def _arc(u: F64, v: F64, normal: F64) -> F64:
    """Length of the arc from u to v times the cosine between its plane's normal and `normal`."""
    plane = np.cross(u, v)
    sine = np.linalg.norm(plane, axis=1)
    out: F64 = np.arctan2(sine, (u * v).sum(1)) * (plane @ normal) / np.maximum(sine, 1e-300)
    return out


def with_border(interior: NDArray[np.floating]) -> NDArray[np.floating]:
    """Tiles with a 1-texel border that wraps octahedrally, so that bilinear filtering never leaves a tile.

    Crossing an edge of the square at height y comes back through the same edge at -y; a corner touches the opposite corner.

    Parameters
    ----------
    interior : (..., n, n, channels)

    Returns
    -------
    (..., n + 2, n + 2, channels), dtype of `interior`
    """
    n = interior.shape[-3]
    tile = np.empty((*interior.shape[:-3], n + 2, n + 2, interior.shape[-1]), interior.dtype)
    tile[..., 1:-1, 1:-1, :] = interior
    tile[..., 0, 1:-1, :] = interior[..., 0, ::-1, :]
    tile[..., -1, 1:-1, :] = interior[..., -1, ::-1, :]
    tile[..., 1:-1, 0, :] = interior[..., ::-1, 0, :]
    tile[..., 1:-1, -1, :] = interior[..., ::-1, -1, :]
    tile[..., 0, 0, :] = interior[..., -1, -1, :]
    tile[..., 0, -1, :] = interior[..., -1, 0, :]
    tile[..., -1, 0, :] = interior[..., 0, -1, :]
    tile[..., -1, -1, :] = interior[..., 0, 0, :]
    return tile
