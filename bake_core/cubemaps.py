"""Cube maps: where their texels lie, and what they are on the octahedral square.

A face is a picture whose row 0 is its first. Looking along `axis`, columns grow along `right` and rows along `down`; the faces are those of
OpenGL's and Vulkan's cube maps, whose frames are left-handed.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import entry_kernel, kernel
from bake_core.octahedral import texel_directions

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

FACES = ("px", "nx", "py", "ny", "pz", "nz")
# Of each face: axis, right, down.
FRAMES = np.array(
    [
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[-1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, -1, 0], [1, 0, 0], [0, 0, -1]],
        [[0, 0, 1], [1, 0, 0], [0, -1, 0]],
        [[0, 0, -1], [-1, 0, 0], [0, -1, 0]],
    ],
    np.float64,
)
# Of a texel's area: less is rounding.
_TOUCHING = 1e-12
# A quad cut by three planes and then by a square's four sides.
_MOST_CORNERS = 4 + 3 + 4


def cube_directions(n: int) -> F64:
    """Directions through the texel centres of six n × n faces, (6, n, n, 3) float64, of length 1 along the faces' axes: not unit."""
    c = (np.arange(n) + 0.5) * 2 / n - 1
    axis, right, down = (FRAMES[:, i, None, None] for i in range(3))
    out: F64 = axis + c[None, None, :, None] * right + c[None, :, None, None] * down
    return out


def octahedral_radiance(faces: F32, n: int) -> F32:
    """Cube maps of radiance as octahedral ones: each texel the mean over its area in the square of what is constant over each cube texel.

    Parameters
    ----------
    faces : (p, 6, c, c, 3) float32
    n : int
        Texels along the octahedral map's side.

    Returns
    -------
    (p, n, n, 3) float32
    """
    start, column, weight = _overlaps(n, faces.shape[2])
    flat = faces.reshape(len(faces), -1, 3)
    out = np.empty((len(faces), n * n, 3), np.float32)
    for p, texels in enumerate(flat):
        out[p] = np.add.reduceat(weight[:, None] * texels[column].astype(np.float64), start[:-1], axis=0)
    return out.reshape(-1, n, n, 3)


@cache
def _overlaps(n: int, c: int) -> tuple[I64, I64, F64]:
    """For each of n² octahedral texels, the cube texels that it overlaps, and the shares of its area that they have, in one run each (CSR).

    Both maps take great circles to straight lines, the octahedral one octant by octant: an overlap is a convex polygon in the square.
    """
    scratch = np.empty((3, _MOST_CORNERS, 3))
    none = np.empty((0, 2), np.int64), np.empty(0)
    count = _overlap_kernel(FRAMES, n, c, scratch, *none)
    pairs, area = np.empty((count, 2), np.int64), np.empty(count)
    _overlap_kernel(FRAMES, n, c, scratch, pairs, area)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    row, column, weight = pairs[order, 0], pairs[order, 1], area[order]
    start = np.searchsorted(row, np.arange(n * n + 1))
    return start, column, weight / np.repeat(np.add.reduceat(weight, start[:-1]), np.diff(start))


@kernel
def _clip(source, count, a, b, c, target):  # type: ignore[no-untyped-def]
    """What of a convex polygon is where a x + b y + c z >= 0 (Sutherland and Hodgman 1974); corners in `target`, and their number."""
    out = 0
    for i in range(count):
        p, q = source[i], source[(i + 1) % count]
        hp, hq = a * p[0] + b * p[1] + c * p[2], a * q[0] + b * q[1] + c * q[2]
        if hp >= 0:
            for k in range(3):
                target[out, k] = p[k]
            out += 1
        if (hp > 0 and hq < 0) or (hp < 0 and hq > 0):
            s = hp / (hp - hq)
            for k in range(3):
                target[out, k] = p[k] + s * (q[k] - p[k])
            out += 1
    return out


@kernel
def _polygon_area(corners, count):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(count):
        p, q = corners[i], corners[(i + 1) % count]
        total += p[0] * q[1] - p[1] * q[0]
    return abs(total) / 2


@entry_kernel
def _overlap_kernel(frames, n, c, scratch, pairs, area):  # type: ignore[no-untyped-def]
    """Number of overlaps; fills them in where there is room."""
    found = 0
    x, y, z = scratch[0], scratch[1], scratch[2]
    for texel in range(6 * c * c):
        f = frames[texel // (c * c)]
        row, column = texel // c % c, texel % c
        for octant in range(8):
            sx, sy, sz = 1.0 - 2 * (octant & 1), 1.0 - 2 * (octant >> 1 & 1), 1.0 - 2 * (octant >> 2)
            for corner in range(4):
                u = (column + (1 if corner == 1 or corner == 2 else 0)) * 2 / c - 1
                v = (row + (corner >> 1)) * 2 / c - 1
                for k in range(3):
                    x[corner, k] = f[0, k] + u * f[1, k] + v * f[2, k]
            count = _clip(x, 4, sx, 0.0, 0.0, y)
            count = _clip(y, count, 0.0, sy, 0.0, x) if count > 2 else 0
            count = _clip(x, count, 0.0, 0.0, sz, y) if count > 2 else 0
            if count < 3:
                continue
            # Onto the square: the polygon stays one, its coordinates from 0 to n.
            low_i, low_j, high_i, high_j = n, n, 0, 0
            for k in range(count):
                length = sx * y[k, 0] + sy * y[k, 1] + sz * y[k, 2]
                fold = 0.0 if sz > 0 else y[k, 2]
                i = ((y[k, 0] - sx * fold) / length + 1) * n / 2
                j = ((y[k, 1] - sy * fold) / length + 1) * n / 2
                y[k, 0], y[k, 1], y[k, 2] = i, j, 1.0
                low_i, low_j = min(low_i, int(i)), min(low_j, int(j))
                high_i, high_j = max(high_i, min(int(i), n - 1)), max(high_j, min(int(j), n - 1))
            for j in range(low_j, high_j + 1):
                for i in range(low_i, high_i + 1):
                    left = _clip(y, count, 1.0, 0.0, -float(i), x)
                    left = _clip(x, left, -1.0, 0.0, float(i + 1), z)
                    left = _clip(z, left, 0.0, 1.0, -float(j), x)
                    left = _clip(x, left, 0.0, -1.0, float(j + 1), z)
                    size = _polygon_area(z, left)
                    # What rounding leaves of two that only touch.
                    if size > _TOUCHING:
                        if found < area.shape[0]:
                            pairs[found, 0], pairs[found, 1], area[found] = j * n + i, texel, size
                        found += 1
    return found


def octahedral_surfaces(distances: F64, n: int) -> tuple[F64, F32]:
    """What lies in the directions of an octahedral map's texel centres, from cube maps of distance.

    The reciprocal of depth along a face's axis is linear in the face's coordinates wherever a surface is flat, so it is continued from the
    nearest texel with its slope there: of the two differences along each coordinate the smaller one, for the other may lead over an edge.
    The slopes are the surface's normal, too.

    Parameters
    ----------
    distances : (p, 6, c, c) float64
        Metres along the rays through texel centres; inf where nothing is hit.
    n : int
        Texels along the octahedral maps' side.

    Returns
    -------
    distance : (p, n²) float64
        Metres; inf where the nearest texel has none.
    normal : (p, n², 3) float32
        Unit, towards the probe; zeros for a miss.
    """
    c = distances.shape[2]
    with np.errstate(divide="ignore"):
        # 0 for a miss.
        nearness = np.linalg.norm(cube_directions(c), axis=-1) / distances
    slope_u, slope_v = _slope(nearness, 3), _slope(nearness, 2)
    w = texel_directions(n).reshape(-1, 3)
    along = w @ FRAMES[:, 0].T
    face = along.argmax(1)
    ahead = along.max(1)
    u, v = ((w * FRAMES[face, i]).sum(1) / ahead for i in (1, 2))
    column, row = (np.clip(((x + 1) / 2 * c).astype(np.int64), 0, c - 1) for x in (u, v))
    at_u, at_v = (column + 0.5) * 2 / c - 1, (row + 0.5) * 2 / c - 1
    there, du, dv = (x[:, face, row, column] for x in (nearness, slope_u, slope_v))
    # Never so far that the surface comes to lie behind the probe: a slope that steep is one over an edge.
    here = there + du * (u - at_u) + dv * (v - at_v)
    here = np.where(here > 0, here, there)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(there > 0, 1 / (here * ahead), np.inf)
        plane = du[..., None] * FRAMES[face, 1] + dv[..., None] * FRAMES[face, 2]
        plane = plane + (there - du * at_u - dv * at_v)[..., None] * FRAMES[face, 0]
        normal = np.where((there > 0)[..., None], -plane / np.linalg.norm(plane, axis=-1, keepdims=True), 0.0)
    return distance, normal.astype(np.float32)


def _slope(nearness: F64, axis: int) -> F64:
    """Of nearness along a face's rows (axis 2) or columns (axis 3), by the face's own coordinate; 0 where no neighbour is hit."""
    c = nearness.shape[axis]
    step = np.diff(nearness, axis=axis) * c / 2
    hit = nearness > 0
    pair = np.take(hit, np.arange(1, c), axis) & np.take(hit, np.arange(c - 1), axis)
    step = np.where(pair, step, np.inf)
    pad = [(0, 0)] * nearness.ndim
    pad[axis] = (1, 1)
    padded = np.pad(step, pad, constant_values=np.inf)
    before, after = np.take(padded, np.arange(c), axis), np.take(padded, np.arange(1, c + 1), axis)
    slope = np.where(np.abs(before) < np.abs(after), before, after)
    out: F64 = np.where(np.isfinite(slope), slope, 0.0)
    return out
