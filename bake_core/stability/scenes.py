"""Building blocks of the cases' scenes."""

from __future__ import annotations

import json
import math
import struct

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.examples import box_sides, quads_part
from bake_core.gltf.writer import GlbWriter, pack_glb

F64 = NDArray[np.float64]


def box(half: float = 1.0, centre: ArrayLike = (0.0, 0.0, 0.0)) -> F64:
    """A cube's six sides, facing inwards, (6, 4, 3)."""
    c = np.asarray(centre, np.float64)
    return np.stack(box_sides(tuple(c - half), tuple(c + half)))


def box_with_hole(half_width: float) -> F64:
    """A box of 2 m, facing inwards, with a square hole in the middle of its ceiling, (9, 4, 3)."""
    h = half_width
    edges = [(-1, -h, -1, 1), (h, 1, -1, 1), (-h, h, -1, -h), (-h, h, h, 1)]
    ceiling = [[[x0, 1, z0], [x1, 1, z0], [x1, 1, z1], [x0, 1, z1]] for x0, x1, z0, z1 in edges]
    return np.concatenate([box()[[0, 1, 2, 4, 5]], np.array(ceiling, np.float64)])


def scene(corners: ArrayLike, albedo: float, emission: float = 0.0, *, double_sided: bool = False) -> bytes:
    """One mesh of one Lambert material, as GLB."""
    w = GlbWriter()
    material = w.material("wall", (albedo,) * 3, emission=(emission,) * 3, double_sided=double_sided)
    w.node("walls", mesh=w.mesh("walls", [quads_part(list(np.asarray(corners, np.float64)), material)]))
    return w.to_glb()


def sphere(segments: int = 24) -> tuple[F64, NDArray[np.int64]]:
    """A unit sphere of rings and segments that faces outwards: points, which are its smooth normals too, and triangles.

    Those at the poles have no area.
    """
    theta = np.linspace(0, math.pi, segments // 2 + 1)
    phi = np.linspace(0, 2 * math.pi, segments + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], 2).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(segments // 2), np.arange(segments), indexing="ij")
    a = (row * (segments + 1) + column).ravel()
    b = a + segments + 1
    return points, np.concatenate([np.stack([a, b, a + 1], 1), np.stack([a + 1, b, b + 1], 1)])


def under_root(glb: bytes, *, scale: float = 1.0, translation: float = 0.0) -> bytes:
    """The same scene below a new root node that is scaled, and moved along x, y and z."""
    (length,) = struct.unpack_from("<I", glb, 12)
    document = json.loads(glb[20 : 20 + length])
    (root,) = document["scenes"]
    document["nodes"].append({"name": "root", "children": root["nodes"], "scale": [scale] * 3, "translation": [translation] * 3})
    root["nodes"] = [len(document["nodes"]) - 1]
    return pack_glb(json.dumps(document).encode(), glb[28 + length :])


def polygon_vector(corners: ArrayLike, point: ArrayLike) -> F64:
    """Vector irradiance at a point from a polygon of radiance 1.

    Its product with a normal is the irradiance of a receiver that sees all of the polygon.
    Lambert 1760, "Photometria": ½ Σ θ_i Γ_i over the polygon's edges, θ the angle that an edge spans and Γ the unit normal of its
    plane. Its sign follows the way the corners run.
    """
    v = np.asarray(corners, np.float64) - np.asarray(point, np.float64)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    total = np.zeros(3)
    for a, b in zip(v, np.roll(v, -1, 0), strict=True):
        plane = np.cross(a, b)
        sine = float(np.linalg.norm(plane))
        total += math.atan2(sine, float(a @ b)) * plane / sine
    return total / 2


def slab_distances(directions: F64, inside: F64, half: float = 1.0) -> F64:
    """From a point in a cube about zero to its walls, along unit directions, (n,)."""
    d = np.where(directions == 0, 1e-300, directions)
    distance: F64 = ((np.sign(d) * half - inside) / d).min(1)
    return distance
