"""Places drawn uniformly over the area of a scene's surfaces inside boxes: both sides of double-sided ones, every instance's own.

Triangles are clipped against the boxes and places drawn from what is left, so that a box that holds a millionth of the area costs no more
than one that holds all. Nothing is kept by triangle: the areas are summed twice, once to know how much there is, once to find where in the
sum each place lies, which is what a scene of a hundred million instanced triangles has memory for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint32, uint64
from numpy.typing import ArrayLike, NDArray

from bake_core.errors import Cancelled
from bake_core.kernels import entry_kernel, kernel
from bake_core.sampling import mix64, random_pair, reverse_bits, sobol_pair, uniform_triangle
from bake_core.scene import Scene
from bake_core.textures import opacity
from bake_core.tracer import Tables, Tracer

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

# A triangle has 3 corners, and each of a box's 6 sides adds one at most.
_MOST_CORNERS = 9


class Places(NamedTuple):
    """Places on surfaces, by what is hit rather than by where that is.

    Attributes
    ----------
    items : (n,) int64
        0: mesh 0 of the scene; 1 + i: its instance i.
    triangles : (n,) int64
        Within the item's mesh.
    barycentrics : (n, 2) float64
        Of the triangle's second and third corner.
    back : (n,) bool
        The back of a double-sided surface.
    """

    items: I64
    triangles: I64
    barycentrics: F64
    back: Bool

    def some(self, which: slice | Bool) -> Places:
        """Those of a slice, or where a mask says so."""
        return Places(self.items[which], self.triangles[which], self.barycentrics[which], self.back[which])


class SurfaceSampler:
    """Draws places on the surfaces of a scene inside some boxes; those that are cut out are not there.

    Parameters
    ----------
    boxes : (b, 2, 3) float
        Lowest and highest corners, world, metres. Where they overlap, no place counts twice.
    seed : int
        Places are a function of it and of their index.
    cancelled : (1,) uint8, optional

    Attributes
    ----------
    area : float
        m² inside the boxes, both sides of double-sided surfaces; holes, and overlaps of boxes as often as they overlap, included.

    Raises
    ------
    Cancelled
    """

    def __init__(self, scene: Scene, tracer: Tracer, boxes: ArrayLike, seed: int, cancelled: NDArray[np.uint8] | None = None) -> None:
        self._tables: Tables = tracer.tables
        self._counts = np.diff(scene.mesh_first_triangle)[np.concatenate([[0], scene.instance_mesh]).astype(np.int64)]
        self._boxes = np.ascontiguousarray(np.asarray(boxes, np.float64).reshape(-1, 2, 3) - scene.origin)
        self._seed = seed
        self._areas = np.zeros((len(self._boxes), len(self._counts)))
        flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
        if not _sum_areas(self._tables, self._counts, self._boxes, *_scratch(), flag, self._areas):
            raise Cancelled
        self.area = float(self._areas.sum())

    def draw(self, first: int, count: int) -> Places:
        """The places of indices from `first` on; fewer than `count` where some fell into holes, or into a box's overlap with one before."""
        items, triangles = np.zeros(count, np.int64), np.zeros(count, np.int64)
        barycentrics, back, there = np.zeros((count, 2)), np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        if self.area > 0:
            choices, points = np.empty(count), np.empty((count, 3))
            _draw_numbers(np.uint64(self._seed), first, choices, points)
            ends = np.cumsum(self._areas.ravel())
            targets = choices * ends[-1]
            order = np.argsort(targets, kind="stable")
            out = (items, triangles, barycentrics, back, there)
            _find_places(
                self._tables,
                self._counts,
                self._boxes,
                self._areas,
                ends.reshape(self._areas.shape),
                targets,
                order,
                points,
                *_scratch(),
                *out,
            )
        return Places(items, triangles, barycentrics, back).some(there)


def _scratch() -> tuple[F64, F64]:
    """Room for a triangle's corners, and for a polygon and what is being clipped off it."""
    return np.empty((3, 3)), np.empty((2, _MOST_CORNERS, 2))


@kernel
def _fetch(t, item, triangle, corners):  # type: ignore[no-untyped-def]
    """A triangle's corners in the local frame, float64."""
    c = t.corners[t.item_first_triangle[item] + triangle]
    m = t.item_transform[item]
    for i in range(3):
        x, y, z = np.float64(c[3 * i]), np.float64(c[3 * i + 1]), np.float64(c[3 * i + 2])
        for axis in range(3):
            corners[i, axis] = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]


@kernel
def _clip(corners, box, polygon):  # type: ignore[no-untyped-def]
    """What of a triangle is inside a box, as barycentrics (of corners 1 and 2) in polygon[0]; returns how many corners it has.

    Sutherland and Hodgman 1974, "Reentrant Polygon Clipping". On a box's side is inside.
    """
    polygon[0, 0, 0] = polygon[0, 0, 1] = polygon[0, 1, 1] = polygon[0, 2, 0] = 0.0
    polygon[0, 1, 0] = polygon[0, 2, 1] = 1.0
    n = 3
    for side in range(6):
        axis, upper = side >> 1, side & 1
        a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
        limit = box[upper, axis]
        if upper:
            if max(a, b, c) <= limit:
                continue
            f0, f1, f2 = limit - a, a - b, a - c
        else:
            if min(a, b, c) >= limit:
                continue
            f0, f1, f2 = a - limit, b - a, c - a
        kept = 0
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            p, q = polygon[0, i], polygon[0, j]
            here, there = f0 + p[0] * f1 + p[1] * f2, f0 + q[0] * f1 + q[1] * f2
            if here >= 0 and kept < _MOST_CORNERS:
                polygon[1, kept, 0], polygon[1, kept, 1] = p[0], p[1]
                kept += 1
            if (here >= 0) != (there >= 0) and kept < _MOST_CORNERS:
                s = here / (here - there)
                polygon[1, kept, 0], polygon[1, kept, 1] = p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1])
                kept += 1
        n = kept
        for i in range(n):
            polygon[0, i, 0], polygon[0, i, 1] = polygon[1, i, 0], polygon[1, i, 1]
        if n < 3:
            return 0
    return n


@kernel
def _fan_share(polygon, i):  # type: ignore[no-untyped-def]
    """Of the whole triangle's area: the i-th triangle of the polygon's fan about its first corner."""
    p, q, r = polygon[0, 0], polygon[0, i], polygon[0, i + 1]
    return abs((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))


@kernel
def _area_inside(t, item, triangle, box, corners, polygon):  # type: ignore[no-untyped-def]
    """Of the part of a triangle inside a box, m², once for each side that can be seen; the polygon's corners."""
    _fetch(t, item, triangle, corners)
    for axis in range(3):
        a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
        if not (max(a, b, c) >= box[0, axis] and min(a, b, c) <= box[1, axis]):
            return 0.0, 0
    n = _clip(corners, box, polygon)
    share = 0.0
    for i in range(1, n - 1):
        share += _fan_share(polygon, i)
    ex, ey, ez = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    fx, fy, fz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    sides = 2.0 if t.materials.double_sided[t.corner_bits[t.item_first_triangle[item] + triangle, 9]] else 1.0
    return share * 0.5 * np.sqrt(gx * gx + gy * gy + gz * gz) * sides, n


@entry_kernel
def _sum_areas(t, counts, boxes, corners, polygon, cancelled, areas):  # type: ignore[no-untyped-def]
    """Area inside each box by item, (b, items) float64; whether it came to the end."""
    for b in range(boxes.shape[0]):
        for item in range(counts.shape[0]):
            if cancelled[0]:
                return False
            total = 0.0
            for triangle in range(counts[item]):
                area, _ = _area_inside(t, item, triangle, boxes[b], corners, polygon)
                total += area
            areas[b, item] = total
    return True


@entry_kernel
def _draw_numbers(seed, first, choices, points):  # type: ignore[no-untyped-def]
    """By index: which part of the area, (n,); where in it, and a number for whether anything is there, (n, 3). All in [0, 1)."""
    key = mix64(seed)
    for i in range(choices.shape[0]):
        index = uint32(first + i)
        reversed_index = reverse_bits(index)
        fine, chance = random_pair(index, key + uint64(2))
        choice, _ = sobol_pair(reversed_index, key)
        u, v = sobol_pair(reversed_index, key + uint64(1))
        # 24 bits more: there may be more triangles than a float32 can tell apart.
        choices[i] = np.float64(choice) + np.float64(fine) * 2.0**-24
        points[i, 0], points[i, 1], points[i, 2] = u, v, chance


@entry_kernel
def _find_places(t, counts, boxes, areas, ends, targets, order, points, corners, polygon, items, triangles, barycentrics, back, there):  # type: ignore[no-untyped-def]
    """Walk the running sum of areas, and leave a place at each target; `order` sorts the targets.

    `ends` is the running sum after each item.
    """
    k = 0
    for b in range(boxes.shape[0]):
        for item in range(counts.shape[0]):
            before, end = ends[b, item] - areas[b, item], ends[b, item]
            if k >= order.shape[0]:
                return
            if targets[order[k]] >= end:
                continue
            running = 0.0
            for triangle in range(counts[item]):
                area, n = _area_inside(t, item, triangle, boxes[b], corners, polygon)
                running += area
                while k < order.shape[0] and targets[order[k]] < end:
                    # The last sum is `areas[b, item]` to the bit, and no target is allowed to round up to it.
                    inside = min(max(targets[order[k]] - before, 0.0), areas[b, item] * (1 - 2.0**-53))
                    if inside >= running:
                        break
                    o = order[k]
                    rest = min(max((inside - (running - area)) / area, 0.0), 1 - 2.0**-53)
                    k += 1
                    material = t.corner_bits[t.item_first_triangle[item] + triangle, 9]
                    if t.materials.double_sided[material]:
                        back[o] = rest >= 0.5
                        rest = 2 * rest - (1 if rest >= 0.5 else 0)
                    b1, b2 = _point_in(polygon, n, rest, np.float32(points[o, 0]), np.float32(points[o, 1]))
                    items[o], triangles[o], barycentrics[o, 0], barycentrics[o, 1] = item, triangle, b1, b2
                    first = _first_box(boxes, corners, b1, b2, b)
                    visible = opacity(t, material, t.item_first_triangle[item] + triangle, b1, b2)
                    there[o] = first == b and points[o, 2] < visible


@kernel
def _point_in(polygon, n, rest, u, v):  # type: ignore[no-untyped-def]
    """A point uniform over a polygon from three numbers, the first of which chooses a triangle of its fan."""
    total = 0.0
    for i in range(1, n - 1):
        total += _fan_share(polygon, i)
    left = rest * total
    chosen = 1
    for i in range(1, n - 1):
        share = _fan_share(polygon, i)
        if share > 0:
            chosen = i
        if left < share:
            break
        left -= share
    p, q, r = polygon[0, 0], polygon[0, chosen], polygon[0, chosen + 1]
    a, c = uniform_triangle(u, v)
    return p[0] + a * (q[0] - p[0]) + c * (r[0] - p[0]), p[1] + a * (q[1] - p[1]) + c * (r[1] - p[1])


@kernel
def _first_box(boxes, corners, b1, b2, b):  # type: ignore[no-untyped-def]
    """The first box that holds a point of box b."""
    for other in range(b):
        inside = True
        for axis in range(3):
            at = (1 - b1 - b2) * corners[0, axis] + b1 * corners[1, axis] + b2 * corners[2, axis]
            inside = inside and boxes[other, 0, axis] <= at and at <= boxes[other, 1, axis]
        if inside:
            return other
    return b
