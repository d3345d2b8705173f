"""Rooms that no light of the environment can enter: a proof, by which a bake does without it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bake_core.distances import capture_distance
from bake_core.kernels import entry_kernel, kernel
from bake_core.reach import items_meeting
from bake_core.scene import ALPHA_OPAQUE, Scene
from bake_core.surfaces import EPSILON
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

# A surface of more triangles is not looked at: winding numbers would cost more than a hundredth or so of what a probe's paths do.
MOST_TRIANGLES = 1 << 14
# A triangle whose height is less than this part of its longest side may be missed by a ray: its normal, in single precision, may come out
# as zero, and what meets at its edges then does not meet.
_SLIVER = 2.0**-20
# Winding numbers are whole numbers everywhere but on the surface.
_WINDS = 0.75
# Rays along each side of the octahedral square by which a probe looks for a way out.
_LOOKS = 16


def is_sealed(scene: Scene, tracer: Tracer, positions: F64) -> bool:
    """Whether every probe stands inside an opaque surface without a gap.

    A surface has no gap if each edge is passed as often one way as the other by the triangles that share it, corners of equal coordinates
    being one: it then has no border, and the number of times that it winds about a point (Jacobson, Kavan and Sorkine-Hornung 2013, "Robust
    Inside-Outside Segmentation using Generalized Winding Numbers") is a whole number that changes only across it and is 0 far away. Where
    it is not 0, every way out leads through a triangle. Rays do not slip between two that share an edge, for acceleration structures are
    robust (:mod:`bake_core.embree`). Which side is the front does not matter: backs end rays, too.

    Parameters
    ----------
    positions : (n, 3) float64
        Of all probes, local frame. Those inside solids count as well: which they are is known only once the bake has begun.

    Notes
    -----
    Slivers, surfaces of more than :data:`MOST_TRIANGLES`, those that meet an open one in a corner, and probes as near to them as a ray's
    start may err prove nothing: the answer is no.
    """
    # Rays begin where single precision says.
    origins = positions.astype(np.float32).astype(np.float64)
    opaque = scene.materials.alpha_mode == ALPHA_OPAQUE
    inside = np.zeros(len(origins), np.bool_)
    shells: dict[int, list[F64]] = {}
    while not inside.all():
        first = origins[inside.argmin()]
        # Most scenes are open, and the first ray that meets nothing has told.
        distance, *_ = capture_distance(tracer, first[None], _LOOKS, cancelled=np.zeros(1, np.uint8))
        if np.isinf(distance).any():
            return False
        left = np.flatnonzero(~inside)
        for mesh, transform in items_meeting(scene, np.stack([first, first])):
            if mesh not in shells:
                shells[mesh] = _shells(scene, opaque, mesh)
            for shell in shells[mesh]:
                corners = shell @ transform[:, :3].T + transform[:, 3]
                if _wound(corners, first[None])[0]:
                    inside[left] |= _wound(corners, origins[left])
        if not inside[left[0]]:
            return False
    return bool(len(origins))


def _shells(scene: Scene, opaque: Bool, mesh: int) -> list[F64]:
    """The closed surfaces of a mesh, (t, 3, 3) float64 each, in its own space."""
    some = slice(int(scene.mesh_first_triangle[mesh]), int(scene.mesh_first_triangle[mesh + 1]))
    indices = scene.indices[some][opaque[scene.triangle_material[some]]]
    if not len(indices):
        return []
    used, corner = np.unique(indices, return_inverse=True)
    triangles = _welded(scene.positions[used])[corner.reshape(-1)].reshape(-1, 3)
    whole = (triangles != np.roll(triangles, 1, 1)).all(1)
    indices, triangles = indices[whole], triangles[whole]
    if not len(triangles):
        return []
    label = np.arange(triangles.max() + 1)
    _join(triangles, label)
    shell = label[triangles[:, 0]]
    corners = scene.positions[indices].astype(np.float64)
    sides = np.roll(corners, -1, 1) - corners
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    ends = np.stack([triangles, np.roll(triangles, -1, 1)], -1).reshape(-1, 2)
    _, edge = np.unique(np.sort(ends, 1) @ np.array([len(label), 1]), return_inverse=True)
    passed = np.bincount(edge, np.where(ends[:, 0] < ends[:, 1], 1.0, -1.0))
    bad = np.zeros(len(label), np.bool_)
    bad[np.repeat(shell, 3)[passed[edge] != 0]] = True
    bad[shell[area <= _SLIVER * (sides**2).sum(-1).max(1)]] = True
    bad |= np.bincount(shell, minlength=len(label)) > MOST_TRIANGLES
    return [corners[shell == i] for i in np.unique(shell[~bad[shell]])]


def _welded(positions: NDArray[np.float32]) -> I64:
    """A number for each place, the same for those of equal coordinates, (n,); zeros of either sign are equal."""
    bits = (positions + np.float32(0)).view(np.uint32).astype(np.uint64)
    high, low = bits[:, 0] << np.uint64(32) | bits[:, 1], bits[:, 2]
    order = np.lexsort((low, high))
    new = np.ones(len(order), np.int64)
    new[1:] = (high[order[1:]] != high[order[:-1]]) | (low[order[1:]] != low[order[:-1]])
    out = np.empty(len(order), np.int64)
    out[order] = np.cumsum(new) - 1
    return out


def _wound(corners: F64, points: F64) -> Bool:
    """Whether a closed surface winds about points, and none of it is as near to them as a ray's start may err."""
    low, high = corners.min((0, 1)), corners.max((0, 1))
    found: Bool = ((points > low) & (points < high)).all(1)
    some = np.flatnonzero(found)
    inside = np.zeros(len(some), np.bool_)
    _wind(np.ascontiguousarray(corners), np.ascontiguousarray(points[some]), EPSILON * float(np.abs(corners).max()), inside)
    found[some] = inside
    return found


@entry_kernel
def _join(triangles, label):  # type: ignore[no-untyped-def]
    """Give corners that triangles connect one label, the least of theirs; `label` is each corner's own at first."""
    for t in range(triangles.shape[0]):
        a = _root(label, triangles[t, 0])
        for i in range(1, 3):
            b = _root(label, triangles[t, i])
            label[max(a, b)] = min(a, b)
            a = min(a, b)
    for i in range(label.shape[0]):
        label[i] = label[label[i]]


@kernel
def _root(label, i):  # type: ignore[no-untyped-def]
    while label[i] != i:
        label[i] = label[label[i]]
        i = label[i]
    return i


@entry_kernel
def _wind(corners, points, near, inside):  # type: ignore[no-untyped-def]
    """Sum up solid angles: Van Oosterom and Strackee 1983, "The Solid Angle of a Plane Triangle"."""
    for p in range(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        total = 0.0
        touches = False
        for t in range(corners.shape[0]):
            ax, ay, az = corners[t, 0, 0] - x, corners[t, 0, 1] - y, corners[t, 0, 2] - z
            bx, by, bz = corners[t, 1, 0] - x, corners[t, 1, 1] - y, corners[t, 1, 2] - z
            cx, cy, cz = corners[t, 2, 0] - x, corners[t, 2, 1] - y, corners[t, 2, 2] - z
            a, b, c = math.sqrt(ax * ax + ay * ay + az * az), math.sqrt(bx * bx + by * by + bz * bz), math.sqrt(cx * cx + cy * cy + cz * cz)
            triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
            total += math.atan2(triple, a * b * c + ab * c + bc * a + ca * b)
            ex, ey, ez, fx, fy, fz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
            nx, ny, nz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
            if abs(triple) <= near * math.sqrt(nx * nx + ny * ny + nz * nz):
                beside_x = min(ax, bx, cx) > near or max(ax, bx, cx) < -near
                beside_y = min(ay, by, cy) > near or max(ay, by, cy) < -near
                beside_z = min(az, bz, cz) > near or max(az, bz, cz) < -near
                touches = touches or not (beside_x or beside_y or beside_z)
        # Each is half a solid angle, and the whole sphere has 4π.
        inside[p] = not touches and abs(total) > 2 * math.pi * _WINDS
