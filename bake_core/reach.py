"""What of a scene lies within a box, or in which cells of a grid: what proofs about what a bake can leave out are made from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import entry_kernel, kernel
from bake_core.placement import Volume
from bake_core.scene import Scene

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Triangles at once: 9 MB of corners.
_CHUNK = 1 << 17


def triangles_meeting(scene: Scene, box: F64, wanted: Bool | None = None) -> Iterator[F64]:
    """Every triangle whose own box meets a box, some at a time; of instances whose box does not, none is looked at.

    Parameters
    ----------
    box : (2, 3) float64
        Lowest and highest corner, local frame. What touches it meets it.
    wanted : (materials,) bool, optional
        Triangles of other materials are left out.

    Yields
    ------
    (t, 3, 3) float64
        Corners, local frame.
    """
    first = scene.mesh_first_triangle
    for mesh, transform in items_meeting(scene, box):
        yield from _meeting(scene, int(first[mesh]), int(first[mesh + 1]), transform, box, wanted)


def items_meeting(scene: Scene, box: F64) -> Iterator[tuple[int, F64]]:
    """Mesh 0, and every instance whose box meets a box.

    Parameters
    ----------
    box : (2, 3) float64
        Lowest and highest corner, local frame.

    Yields
    ------
    int, (3, 4) float64
        Its mesh, and the way from its space to the local frame.
    """
    yield 0, np.eye(3, 4)
    if not len(scene.instance_mesh):
        return
    low, high = _mesh_boxes(scene)
    middle, half = (low + high)[scene.instance_mesh] / 2, (high - low)[scene.instance_mesh] / 2
    linear, moved = scene.instance_transform[:, :, :3], scene.instance_transform[:, :, 3]
    centre, extent = np.einsum("iab,ib->ia", linear, middle) + moved, np.einsum("iab,ib->ia", np.abs(linear), half)
    for i in np.flatnonzero(((centre + extent >= box[0]) & (centre - extent <= box[1])).all(1)):
        yield int(scene.instance_mesh[i]), scene.instance_transform[i]


def _meeting(scene: Scene, first: int, end: int, transform: F64, box: F64, wanted: Bool | None) -> Iterator[F64]:
    """Of one item's triangles."""
    for start in range(first, end, _CHUNK):
        some = slice(start, min(start + _CHUNK, end))
        indices = scene.indices[some]
        if wanted is not None:
            indices = indices[wanted[scene.triangle_material[some]]]
        corners = scene.positions[indices] @ transform[:, :3].T + transform[:, 3]
        corners = corners[((corners.max(1) >= box[0]) & (corners.min(1) <= box[1])).all(1)]
        if len(corners):
            yield corners


def _mesh_boxes(scene: Scene) -> tuple[F64, F64]:
    """Lowest and highest corner of each mesh, (m, 3) float64; of an empty one, zeros."""
    first = scene.mesh_first_triangle
    low, high = np.zeros((len(first) - 1, 3)), np.zeros((len(first) - 1, 3))
    for mesh, (start, end) in enumerate(pairwise(first)):
        if end > start:
            corners = scene.positions[scene.indices[start:end].ravel()]
            low[mesh], high[mesh] = corners.min(0), corners.max(0)
    return low, high


def reach_box(scene: Scene, volume: Volume) -> F64:
    """Where a volume's light can be held against the truth, (2, 3) float64, local frame."""
    low, high = volume.reach
    return np.stack([low, high]) - scene.origin


def probes_about_surfaces(scene: Scene, volume: Volume, margin: float) -> Bool:
    """Which probes stand around a cell that holds a piece of surface, (n,) bool, in flat order.

    A query takes the eight probes around its point, or around the nearest point of the grid: cells at the grid's border reach outwards
    without end. So a query on a surface is answered as if every probe were there.

    Parameters
    ----------
    margin : float
        Metres by which a point may lie off the surface that it stands for.
    """
    counts = np.asarray(volume.counts)
    cells = np.maximum(counts - 1, 1)
    holds = np.zeros(cells, np.bool_)
    origin = volume.origin - scene.origin
    everywhere = np.array([[-np.inf] * 3, [np.inf] * 3])
    for corners in triangles_meeting(scene, everywhere):
        if holds.all():
            break
        _mark_cells(corners, origin, volume.spacing, margin, (tuple(np.empty((4, 3))), tuple(np.empty((2, 3), np.int64))), holds)
    needed = np.zeros(volume.counts, np.bool_)
    for corner in range(8):
        low = [corner >> axis & 1 for axis in range(3)]
        # An axis with one probe has one cell, and nothing above it.
        if all(not low[axis] or counts[axis] > 1 for axis in range(3)):
            needed[tuple(slice(low[axis], low[axis] + cells[axis]) for axis in range(3))] |= holds
    return needed.ravel(order="F")


@kernel
def _apart(corners, low, high):  # type: ignore[no-untyped-def]
    """Whether an axis separates a triangle from a box: the triangle's normal, or one across an edge of each.

    Akenine-Möller 2001, "Fast 3D Triangle-Box Overlap Testing"; the box's own axes are not looked at.
    """
    ax, ay, az = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2
    hx, hy, hz = (high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2
    ex, ey, ez = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    fx, fy, fz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    for axis in range(10):
        if axis == 0:
            nx, ny, nz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
        else:
            edge, side = (axis - 1) // 3, (axis - 1) % 3
            dx, dy, dz = ex, ey, ez
            if edge == 1:
                dx, dy, dz = fx, fy, fz
            elif edge == 2:
                dx, dy, dz = fx - ex, fy - ey, fz - ez
            if side == 0:
                nx, ny, nz = 0.0, -dz, dy
            elif side == 1:
                nx, ny, nz = dz, 0.0, -dx
            else:
                nx, ny, nz = -dy, dx, 0.0
        reach = abs(nx) * hx + abs(ny) * hy + abs(nz) * hz
        lowest, highest = np.inf, -np.inf
        for i in range(3):
            d = nx * (corners[i, 0] - ax) + ny * (corners[i, 1] - ay) + nz * (corners[i, 2] - az)
            lowest, highest = min(lowest, d), max(highest, d)
        if lowest > reach or highest < -reach:
            return True
    return False


@entry_kernel
def _mark_cells(triangles, origin, spacing, margin, room, holds):  # type: ignore[no-untyped-def]
    """Mark the cells that triangles meet when these are grown by a margin; those at the border have no outer side.

    `room` is (4, 3) float64 and (2, 3) int64 to work in.
    """
    (low, high, least, most), (first, last) = room
    for t in range(triangles.shape[0]):
        corners = triangles[t]
        for axis in range(3):
            a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
            least[axis], most[axis] = min(a, b, c) - margin, max(a, b, c) + margin
            end = holds.shape[axis] - 1.0
            first[axis] = np.int64(min(max(math.floor((least[axis] - origin[axis]) / spacing[axis]), 0.0), end))
            last[axis] = np.int64(min(max(math.floor((most[axis] - origin[axis]) / spacing[axis]), 0.0), end))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    if holds[i, j, k]:
                        continue
                    for axis, index in ((0, i), (1, j), (2, k)):
                        # The cell, grown, as far as the triangle's own box goes: finite, though a border's cell is not.
                        low[axis], high[axis] = least[axis], most[axis]
                        if index > 0:
                            low[axis] = max(low[axis], origin[axis] + index * spacing[axis] - margin)
                        if index < holds.shape[axis] - 1:
                            high[axis] = min(high[axis], origin[axis] + (index + 1) * spacing[axis] + margin)
                    if not _apart(corners, low, high):
                        holds[i, j, k] = True
