"""OBJ read for its triangles: `v` and `f` lines, strictly; all else in it is about looks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bake_core.errors import SceneError


def read_obj(data: bytes, name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices, (v, 3) float64, and triangles, (n, 3) int64; a polygon is a fan about its first corner.

    Trimesh's reader takes an index from the end for one of the whole file, not of what stands before its line, and index 0 for the last
    vertex.

    Raises
    ------
    SceneError
        ``scene.bad_mesh``, with the line.
    """
    vertices: list[tuple[float, ...]] = []
    triangles: list[tuple[int, int, int]] = []
    # Names and comments may be of any encoding; numbers are ASCII in all of them.
    lines = data.decode("ascii", "replace").replace("\\\r\n", " ").replace("\\\n", " ").splitlines()
    for number, line in enumerate(lines, 1):
        word, *values = line.partition("#")[0].split() or [""]
        if word not in ("v", "f"):
            continue
        place = f"{name}: line {number}"
        try:
            if word == "v":
                x, y, z = map(float, values[:3])
                vertices.append((x, y, z))
                continue
            corners = [int(value.partition("/")[0]) for value in values]
        except ValueError:
            what = "three numbers" if word == "v" else "whole numbers, as in 'f 1 2 3' or 'f 1/1/1 2/2/2 3/3/3'"
            raise SceneError("scene.bad_mesh", f"must be {what}; is {line.strip()[:60]!r}", place) from None
        if len(corners) < 3:
            raise SceneError("scene.bad_mesh", f"a face needs three corners or more, has {len(corners)}", place)
        for corner in corners:
            if not (1 <= corner <= len(vertices) or -len(vertices) <= corner <= -1):
                text = f"names vertex {corner}, but {len(vertices)} stand before it; counting is from 1, or back from -1"
                raise SceneError("scene.bad_mesh", text, place)
        # -1 is the vertex that stands last so far.
        fan = [c - 1 if c > 0 else c + len(vertices) for c in corners]
        triangles += [(fan[0], b, c) for b, c in pairwise(fan[1:])]
    return np.array(vertices, np.float64).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)
