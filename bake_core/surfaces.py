"""What a ray finds: the surface at its hit, made accurate enough to leave it again, and whether anything is in the way.

Arithmetic is float64 between queries (the queries themselves are float32): on scalars it costs nothing, and a hit point lies in its
triangle's plane to 1e-16. (`np.float64` widens; numba's `float` leaves a float32 as it is.)
"""

from __future__ import annotations

import math

import numpy as np

from bake_core.embree import set_ray
from bake_core.kernels import kernel
from bake_core.ray_log import ask_any, ask_nearest
from bake_core.textures import has_holes, lets_through

# Rounding a point to float32 and intersecting in float32 each err by about an ulp of the numbers involved: leave the surface by eight.
EPSILON = 2.0**-20
# Nearer to an edge than this (barycentric) a rounded point may lie beyond a wall that meets the triangle there, and a sealed room leaks.
_INSET = 2.0**-17
# What Embree leaves in place of a geometry or an instance where there is none.
INVALID = 0xFFFFFFFF
INFINITE = np.float32(np.inf)
# Camera rays pass through back faces, all rays through what alpha cuts out; this many before giving up bounds the loop.
MAX_PASSED = 4096
# Where a shadow ray goes on behind a hole: distances along one ray are accurate to about an ulp of themselves.
_PASSED = 1 + 2.0**-20


@kernel
def hit_item(ray_bits):  # type: ignore[no-untyped-def]
    """Which item a hit is of: an instance's number, or mesh 0's."""
    return ray_bits[19] if ray_bits[19] != INVALID else ray_bits[18]


@kernel
def surface(t, ray_bits, ray, dx, dy, dz):  # type: ignore[no-untyped-def]
    """What a hit found, from the RTCRayHit it left behind.

    Returns
    -------
    point : 3 float64
        In the triangle's plane, a hair inside its edges.
    n : 6 float64
        Geometric and shading normal, unit, both on the side the ray came from.
    epsilon : float64
        How far to leave the surface, metres.
    color : 3 float64
        Vertex colour.
    material : int
    front : bool
    triangle : int
    b1, b2 : float64
        Where in the triangle.
    twice_area : float64
        Of the triangle in the local frame, m².
    """
    item = hit_item(ray_bits)
    triangle = t.item_first_triangle[item] + ray_bits[17]
    b1 = max(np.float64(ray[15]), _INSET)
    b2 = max(np.float64(ray[16]), _INSET)
    b0 = max(1.0 - b1 - b2, _INSET)
    scale = 1.0 / (b0 + b1 + b2)
    b0, b1, b2 = b0 * scale, b1 * scale, b2 * scale
    corner = t.corners[triangle]
    ax, ay, az = np.float64(corner[0]), np.float64(corner[1]), np.float64(corner[2])
    bx, by, bz = np.float64(corner[3]), np.float64(corner[4]), np.float64(corner[5])
    cx, cy, cz = np.float64(corner[6]), np.float64(corner[7]), np.float64(corner[8])
    ex, ey, ez = bx - ax, by - ay, bz - az
    fx, fy, fz = cx - ax, cy - ay, cz - az
    gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    px, py, pz = b0 * ax + b1 * bx + b2 * cx, b0 * ay + b1 * by + b2 * cy, b0 * az + b1 * bz + b2 * cz
    sx = max(abs(ax - px), abs(bx - px), abs(cx - px))
    sy = max(abs(ay - py), abs(by - py), abs(cy - py))
    sz = max(abs(az - pz), abs(bz - pz), abs(cz - pz))
    moved = 0.0
    if item:
        m = t.item_transform[item]
        # A transformed triangle is intersected in its own space: rounding there is relative to where that space's zero stands.
        moved = abs(m[0, 3]) + abs(m[1, 3]) + abs(m[2, 3])
        px, py, pz = (
            m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3],
            m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3],
            m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3],
        )
        sx, sy, sz = (
            abs(m[0, 0]) * sx + abs(m[0, 1]) * sy + abs(m[0, 2]) * sz,
            abs(m[1, 0]) * sx + abs(m[1, 1]) * sy + abs(m[1, 2]) * sz,
            abs(m[2, 0]) * sx + abs(m[2, 1]) * sy + abs(m[2, 2]) * sz,
        )
        k = t.item_normal[item]
        gx, gy, gz = (
            k[0, 0] * gx + k[0, 1] * gy + k[0, 2] * gz,
            k[1, 0] * gx + k[1, 1] * gy + k[1, 2] * gz,
            k[2, 0] * gx + k[2, 1] * gy + k[2, 2] * gz,
        )
    length = math.sqrt(gx * gx + gy * gy + gz * gz)
    twice_area = length
    if length > 0:
        gx, gy, gz = gx / length, gy / length, gz / length
    else:
        # Embree does not hit triangles without area; a prototype squashed flat by its instance can still get here.
        gx, gy, gz = -dx, -dy, -dz
    front = gx * dx + gy * dy + gz * dz < 0
    nx, ny, nz = gx, gy, gz
    if t.normals.shape[0]:
        h = t.normals[triangle]
        hx = b0 * h[0, 0] + b1 * h[1, 0] + b2 * h[2, 0]
        hy = b0 * h[0, 1] + b1 * h[1, 1] + b2 * h[2, 1]
        hz = b0 * h[0, 2] + b1 * h[1, 2] + b2 * h[2, 2]
        if item:
            k = t.item_normal[item]
            hx, hy, hz = (
                k[0, 0] * hx + k[0, 1] * hy + k[0, 2] * hz,
                k[1, 0] * hx + k[1, 1] * hy + k[1, 2] * hz,
                k[2, 0] * hx + k[2, 1] * hy + k[2, 2] * hz,
            )
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        if length > 0:
            nx, ny, nz = hx / length, hy / length, hz / length
    if not front:
        gx, gy, gz, nx, ny, nz = -gx, -gy, -gz, -nx, -ny, -nz
    # What rounding can do across the plane, axis by axis: nothing for an axis-aligned wall through zero, so its offset is almost nothing.
    across = abs(gx) * (abs(px) + sx) + abs(gy) * (abs(py) + sy) + abs(gz) * (abs(pz) + sz)
    along = max(abs(px) + sx, abs(py) + sy, abs(pz) + sz)
    epsilon = EPSILON * (across + moved + along / 16)
    red = green = blue = 1.0
    if t.colors.shape[0]:
        c = t.colors[triangle]
        red = b0 * c[0, 0] + b1 * c[1, 0] + b2 * c[2, 0]
        green = b0 * c[0, 1] + b1 * c[1, 1] + b2 * c[2, 1]
        blue = b0 * c[0, 2] + b1 * c[1, 2] + b2 * c[2, 2]
    material = t.corner_bits[triangle, 9]
    return (px, py, pz), (gx, gy, gz, nx, ny, nz), epsilon, (red, green, blue), material, front, triangle, b1, b2, twice_area


@kernel
def find_surface(t, ray, ray_bits, x, y, z, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Whether a ray meets a surface, behind whatever it goes through where that is cut out; :func:`surface` then says which."""
    for _ in range(MAX_PASSED):
        set_ray(ray, ray_bits, x, y, z, dx, dy, dz, INFINITE)
        ask_nearest(t, ray)
        if ray_bits[18] == INVALID:
            return False
        if not has_holes(t):
            return True
        p, n, epsilon, _, material, _, triangle, b1, b2, _ = surface(t, ray_bits, ray, dx, dy, dz)
        if not lets_through(t, material, triangle, b1, b2, ray_bits):
            return True
        # Go on from the far side: the normal looks back at us.
        x, y, z = p[0] - epsilon * n[0], p[1] - epsilon * n[1], p[2] - epsilon * n[2]
    return False


@kernel
def blocked(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, tfar):  # type: ignore[no-untyped-def]
    """Whether anything lies between a point and the light: any hit, or hit after hit where something in the scene is cut out."""
    set_ray(ray, ray_bits, ox, oy, oz, dx, dy, dz, tfar)
    if not has_holes(t):
        ask_any(t, ray)
        return ray[8] < 0
    for _ in range(MAX_PASSED):
        ask_nearest(t, ray)
        if ray_bits[18] == INVALID:
            return False
        item = hit_item(ray_bits)
        triangle = t.item_first_triangle[item] + ray_bits[17]
        material = t.corner_bits[triangle, 9]
        if not lets_through(t, material, triangle, np.float64(ray[15]), np.float64(ray[16]), ray_bits):
            return True
        beyond = np.float32(ray[8] * _PASSED)
        set_ray(ray, ray_bits, ox, oy, oz, dx, dy, dz, tfar)
        ray[3] = beyond
    return True
