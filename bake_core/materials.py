"""Materials as the kernels see them: what they reflect, and how a direction is drawn from it.

Lambert about a shading normal, folded at the geometric surface so that it reflects its albedo exactly:

    f(wi) cosθ = albedo/π · ((wi·ns)+ + (mirror(wi)·ns)+)   for wi above the surface ng,   mirror(wi) = wi - 2 (wi·ng) ng

Directions that cosine sampling about ns puts below the surface come back mirrored, and the second term is their density. With
ns = ng it is plain Lambert. (Without it, interpolated normals darken a furnace by (1 - cos δ)/2 for an angle δ between the two.)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.errors import SceneError
from bake_core.kernels import kernel
from bake_core.sampling import basis, cosine_hemisphere
from bake_core.scene import Scene

INV_PI = 1 / math.pi


class MaterialTable(NamedTuple):
    """Columns by material index: albedo (m, 3) float32, emission (m, 3) float32, double_sided (m,) bool."""

    albedo: NDArray[np.float32]
    emission: NDArray[np.float32]
    double_sided: NDArray[np.bool_]


def material_table(scene: Scene) -> MaterialTable:
    """The kernels' view of a scene's materials.

    Raises
    ------
    SceneError
        ``scene.unsupported`` where a material in use is not exactly Lambert.
    """
    m = scene.materials
    # The reader keeps only materials in use.
    for i in np.flatnonzero((m.metallic != 0) | (m.roughness != 1)):
        raise SceneError(
            "scene.unsupported",
            f"metallic {m.metallic[i]:g}, roughness {m.roughness[i]:g}: only Lambert (metallic 0, roughness 1) is traced yet; "
            "set these factors in the material",
            f"material {m.name[i]!r} (materials[{i}])" if m.name[i] else f"materials[{i}]",
        )
    return MaterialTable(np.ascontiguousarray(m.base_color), np.ascontiguousarray(m.emission), np.ascontiguousarray(m.double_sided))


@kernel
def lambert_cosine(wx, wy, wz, n):  # type: ignore[no-untyped-def]
    """(wi·ns)+ + (mirror(wi)·ns)+ for wi above the surface, else 0; over π it is the pdf of :func:`sample_lambert`.

    `n` is (ng, ns) as six numbers, both on the side of wo.
    """
    above = wx * n[0] + wy * n[1] + wz * n[2]
    if above <= 0:
        return 0.0
    direct = wx * n[3] + wy * n[4] + wz * n[5]
    mirrored = direct - 2 * above * (n[0] * n[3] + n[1] * n[4] + n[2] * n[5])
    return max(direct, 0.0) + max(mirrored, 0.0)


@kernel
def sample_lambert(u, v, n):  # type: ignore[no-untyped-def]
    """A direction with pdf :func:`lambert_cosine` / π; `n` as there."""
    lx, ly, lz = cosine_hemisphere(u, v)
    tx, ty, tz, bx, by, bz = basis(n[3], n[4], n[5])
    wx = lx * tx + ly * bx + lz * n[3]
    wy = lx * ty + ly * by + lz * n[4]
    wz = lx * tz + ly * bz + lz * n[5]
    above = wx * n[0] + wy * n[1] + wz * n[2]
    if above < 0:
        wx -= 2 * above * n[0]
        wy -= 2 * above * n[1]
        wz -= 2 * above * n[2]
    return wx, wy, wz
