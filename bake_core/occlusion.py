"""Where nothing can stand between a probe and a surface: a proof, by which a volume does without visibility maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bake_core.placement import Volume
from bake_core.reach import reach_box, triangles_meeting
from bake_core.scene import Scene
from bake_core.surfaces import EPSILON

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Pairs of a plane and a corner that a proof may look at: a second's work. What takes more is not proven.
_MOST_PAIRS = 1 << 28
# Planes looked at together: where nothing is convex, the first of them find that out.
_PLANES = 64


def nothing_occludes(scene: Scene, volume: Volume, probes: F64) -> bool:
    """Whether no probe of a volume can be hidden from a surface within its reach, whatever the shape of the two.

    For every triangle that meets the volume's reach, all probes and all corners of such triangles must lie on one side of its plane,
    or in it. A segment crosses a plane only if its ends lie on two sides, and both ends of a segment between probe and surface are
    in the convex hull of what has been looked at. It does so inside the reach, a box, so that no other triangle is in its way.

    Not a word is said of what lies behind a double-sided surface: from there no probe is seen at all. Nor is anything that fails the test
    known to occlude: the answer is then no.

    Parameters
    ----------
    probes : (n, 3) float64
        Where they stand, local frame; any points within reach whose hull holds them do as well.

    Returns
    -------
    bool
        Also where no triangle is in reach.
    """
    box = reach_box(scene, volume)
    found = []
    for corners in triangles_meeting(scene, box):
        if not _one_sided(corners, probes):
            return False
        found.append(corners)
        count = sum(len(c) for c in found)
        if count * max(3 * count, len(probes)) > _MOST_PAIRS:
            return False
    if not found:
        return True
    corners = np.concatenate(found)
    return _one_sided(corners, np.concatenate([probes, np.unique(corners.reshape(-1, 3), axis=0)]))


def _one_sided(triangles: F64, points: F64) -> bool:
    """Whether each triangle has all points on one side of its plane.

    Parameters
    ----------
    triangles : (t, 3, 3) float64
    points : (n, 3) float64
    """
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1)
    # A triangle without area stops no ray.
    solid = length > 0
    normals, anchors = normals[solid] / length[solid, None], triangles[solid, 0]
    # A ray leaves its surface by so much of its coordinates: what stands out by less is in no ray's way.
    slack = EPSILON * float(np.abs(points).max() + np.abs(triangles).max()) if len(points) else 0.0
    for start in range(0, len(normals), _PLANES):
        some = slice(start, start + _PLANES)
        side = points @ normals[some].T - (anchors[some] * normals[some]).sum(1)
        if ((side.min(0) < -slack) & (side.max(0) > slack)).any():
            return False
    return True
