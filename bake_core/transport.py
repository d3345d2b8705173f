"""Unbiased path tracing: one path, from a ray to the radiance that comes back along it.

Kajiya 1986, "The Rendering Equation"; next-event estimation and multiple importance sampling after Veach 1997, "Robust Monte Carlo
Methods for Light Transport Simulation" (balance heuristic). Compiled strictly: no fastmath, so the same bits on every run.

Arithmetic is float64 between queries (the queries themselves are float32): on scalars it costs nothing, and a hit point lies in its
triangle's plane to 1e-16. (`np.float64` widens; numba's `float` leaves a float32 as it is.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import uint64
from numpy.typing import NDArray

from bake_core import embree
from bake_core.embree import intersect1, occluded1, set_ray
from bake_core.environment import Environment, Sky, environment_radiance, has_sky, sample_sky
from bake_core.ggx_albedo import AlbedoTable
from bake_core.kernels import either, kernel
from bake_core.lights import (
    EmitterTable,
    LightTable,
    choose,
    emitter_table,
    light_table,
    merge_lights,
    toward_light,
)
from bake_core.materials import (
    INV_PI,
    MaterialTable,
    gloss,
    gloss_table,
    is_glossy,
    lambert_cosine,
    material_table,
    no_gloss,
    sample_gloss,
    sample_lambert,
    scattered,
)
from bake_core.sampling import STRATIFIED_VERTICES, random_pair, sobol_pair, uniform_triangle
from bake_core.scene import Lights, Scene
from bake_core.spec import Spec
from bake_core.textures import (
    TextureTable,
    emission_at,
    emission_left,
    emits_unevenly,
    has_holes,
    lets_through,
    mean_emission,
    reflectance,
    scattered_spread,
    texture_table,
    widened,
)

# Roulette by throughput begins where a path has lost 90 % of its weight. With the chance to go on equal to throughput / τ below τ, a
# furnace of albedo a has a relative σ of τ√a from roulette: 10 % of a path here, against 100 % where τ = 1.
ROULETTE_THROUGHPUT = 0.1
# Where throughput does not fall (white walls), a path that has met no light for m > 64 vertices goes on with chance (m/(m+1))². Survival
# falls as 1/m², slower than any physical decay, so the variance stays finite; yet in a sealed dark room a path takes 128 vertices on
# average. From 16 on, a white street with narrow ways out (godot_zdm2) had 15 times the variance, at 0.7 times the cost.
ROULETTE_DARK_VERTICES = 64
# The same against light that never dies away (a sealed box of albedo 1 with an emitter in it has no finite answer): late enough that no
# path of an albedo below 0.999 gets here.
ROULETTE_LAST_VERTICES = 8192
# Rounding a point to float32 and intersecting in float32 each err by about an ulp of the numbers involved: leave the surface by eight.
_EPSILON = 2.0**-20
# Nearer to an edge than this (barycentric) a rounded point may lie beyond a wall that meets the triangle there, and a sealed room leaks.
_INSET = 2.0**-17
_INVALID = 0xFFFFFFFF
_INFINITE = np.float32(np.inf)
# Camera rays pass through back faces, all rays through what alpha cuts out; this many before giving up bounds the loop.
MAX_PASSED = 4096
# Where a shadow ray goes on behind a hole: distances along one ray are accurate to about an ulp of themselves.
_PASSED = 1 + 2.0**-20


class Tables(NamedTuple):
    """All that kernels read of a scene. Items are mesh 0 and then the instances.

    A triangle's corners stand together, because a hit at the end of an incoherent ray is a cache miss for every place it has to look:
    with vertices behind indices, fetching took a fifth of a path's time in the atrium.

    Attributes
    ----------
    corners : (t, 10) float32
        By triangle: the corners' nine coordinates, then the material's index as the bits of a uint32.
    corner_bits : (t, 10) uint32
        The same memory.
    normals, colors : (t, 3, 3) float32
        By triangle, corner and axis or channel; (0, 3, 3) where no mesh has any.
    item_first_triangle : (1 + i,) int64
    item_transform, item_normal : (1 + i, 3, 4) and (1 + i, 3, 3) float64
        Of points, and of normals up to a positive factor.
    """

    handle: np.uint64
    corners: NDArray[np.float32]
    corner_bits: NDArray[np.uint32]
    normals: NDArray[np.float32]
    colors: NDArray[np.float32]
    item_first_triangle: NDArray[np.int64]
    item_transform: NDArray[np.float64]
    item_normal: NDArray[np.float64]
    materials: MaterialTable
    gloss: AlbedoTable | None
    textures: TextureTable | None
    emitters: EmitterTable
    lights: LightTable
    environment: NDArray[np.float64]
    sky: Sky | None
    max_bounces: np.int64


@dataclass(frozen=True)
class Tracer:
    """A scene ready to be traced; rays are given in the scene's local frame (world minus `origin`)."""

    origin: NDArray[np.float64]
    lights: Lights
    tables: Tables
    geometry: embree.Geometry
    triangle_count: int

    @classmethod
    def build(cls, scene: Scene, spec: Spec, environment: Environment) -> Tracer:
        """Build the acceleration structure and the kernels' tables.

        Parameters
        ----------
        environment : Environment
            What :func:`bake_core.environment.read_environment` makes of the spec's.

        Raises
        ------
        SceneError, SpecError
            ``*.unsupported`` for what transport does not model yet.
        """
        geometry = embree.Geometry(scene)
        corners = np.empty((len(scene.indices), 10), np.float32)
        corners[:, :9] = scene.positions[scene.indices].reshape(-1, 9)
        corners[:, 9] = scene.triangle_material.view(np.float32)
        lights = merge_lights(scene, spec)
        transforms = np.concatenate([np.eye(3, 4)[None], scene.instance_transform.reshape(-1, 3, 4)])
        tables = Tables(
            handle=np.uint64(geometry.handle),
            corners=corners,
            corner_bits=corners.view(np.uint32),
            normals=scene.normals[scene.indices] if len(scene.normals) else np.zeros((0, 3, 3), np.float32),
            colors=scene.colors[scene.indices, :3] if len(scene.colors) else np.zeros((0, 3, 3), np.float32),
            item_first_triangle=np.concatenate([scene.mesh_first_triangle[:1], scene.mesh_first_triangle[scene.instance_mesh]]),
            item_transform=transforms,
            item_normal=_normal_matrices(transforms[:, :, :3]),
            materials=material_table(scene),
            gloss=gloss_table(scene),
            textures=texture_table(scene),
            emitters=emitter_table(scene),
            lights=light_table(lights, scene.bounds - scene.origin),
            environment=environment.constant,
            sky=environment.sky,
            max_bounces=np.int64(np.iinfo(np.int32).max if spec.max_bounces is None else spec.max_bounces),
        )
        if emits_unevenly(scene):
            tables = tables._replace(emitters=emitter_table(scene, mean_emission(tables, scene)))
        return cls(scene.origin, lights, tables, geometry, scene.triangle_count)


def _normal_matrices(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse transposes, up to a positive factor: the cofactor matrix times the determinant's sign, defined for singular ones too."""
    a, b, c = linear[:, 0], linear[:, 1], linear[:, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)
    sign = np.where((a * cofactors[:, 0]).sum(1) < 0, -1.0, 1.0)
    out: NDArray[np.float64] = cofactors * sign[:, None, None]
    return out


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
    item = ray_bits[19] if ray_bits[19] != _INVALID else ray_bits[18]
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
    epsilon = _EPSILON * (across + moved + along / 16)
    red = green = blue = 1.0
    if t.colors.shape[0]:
        c = t.colors[triangle]
        red = b0 * c[0, 0] + b1 * c[1, 0] + b2 * c[2, 0]
        green = b0 * c[0, 1] + b1 * c[1, 1] + b2 * c[2, 1]
        blue = b0 * c[0, 2] + b1 * c[1, 2] + b2 * c[2, 2]
    material = t.corner_bits[triangle, 9]
    return (px, py, pz), (gx, gy, gz, nx, ny, nz), epsilon, (red, green, blue), material, front, triangle, b1, b2, twice_area


@kernel
def blocked(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, tfar):  # type: ignore[no-untyped-def]
    """Whether anything lies between a point and the light: any hit, or hit after hit where something in the scene is cut out."""
    set_ray(ray, ray_bits, ox, oy, oz, dx, dy, dz, tfar)
    if not has_holes(t):
        occluded1(t.handle, ray.ctypes.data, 0)
        return ray[8] < 0
    for _ in range(MAX_PASSED):
        intersect1(t.handle, ray.ctypes.data, 0)
        if ray_bits[18] == _INVALID:
            return False
        item = ray_bits[19] if ray_bits[19] != _INVALID else ray_bits[18]
        triangle = t.item_first_triangle[item] + ray_bits[17]
        material = t.corner_bits[triangle, 9]
        if not lets_through(t, material, triangle, np.float64(ray[15]), np.float64(ray[16]), ray_bits):
            return True
        beyond = np.float32(ray[8] * _PASSED)
        set_ray(ray, ray_bits, ox, oy, oz, dx, dy, dz, tfar)
        ray[3] = beyond
    return True


@kernel
def pdf_emitter(t, strength, two_sided, d2, facing):  # type: ignore[no-untyped-def]
    """Per solid angle, of :func:`sample_emitter`, seen from a distance of √d2 under a cosine of `facing` at the emitter."""
    sides = 2.0 if two_sided else 1.0
    return strength * sides / t.emitters.total * d2 / max(facing, 1e-30)


@kernel
def emitter_strength(t, material, triangle):  # type: ignore[no-untyped-def]
    """What a triangle's part in the emitters' power is weighted by: its mean radiance, summed over channels."""
    if t.emitters.strength.shape[0]:
        return t.emitters.strength[triangle]
    le = t.materials.emission[material]
    return np.float64(le[0]) + np.float64(le[1]) + np.float64(le[2])


@kernel
def sample_emitter(t, px, py, pz, u, v, w):  # type: ignore[no-untyped-def]
    """A point on the emissive triangles, chosen by power and area, as seen from a point.

    Pdf: :func:`pdf_emitter`.

    Returns
    -------
    (3 float64, 3 float64, float64, 3 float64)
        The radiance there, the unit direction to the point, its pdf per solid angle (0: no light comes from there), and the point lifted
        off its surface towards the viewer, so that the emitter does not block itself.
    """
    e = t.emitters
    radiance = (0.0, 0.0, 0.0)
    i, _ = choose(e.cdf, np.float64(w))
    b1, b2 = uniform_triangle(u, v)
    b0 = 1.0 - b1 - b2
    x = b0 * e.vertices[i, 0, 0] + b1 * e.vertices[i, 1, 0] + b2 * e.vertices[i, 2, 0]
    y = b0 * e.vertices[i, 0, 1] + b1 * e.vertices[i, 1, 1] + b2 * e.vertices[i, 2, 1]
    z = b0 * e.vertices[i, 0, 2] + b1 * e.vertices[i, 1, 2] + b2 * e.vertices[i, 2, 2]
    dx, dy, dz = x - px, y - py, z - pz
    d2 = dx * dx + dy * dy + dz * dz
    d = math.sqrt(d2)
    pdf = 0.0
    side = 1.0
    if d > 0:
        dx, dy, dz = dx / d, dy / d, dz / d
        facing = -(dx * e.normal[i, 0] + dy * e.normal[i, 1] + dz * e.normal[i, 2])
        side = 1.0 if facing > 0 else -1.0
        if facing > 0 or (facing < 0 and e.double_sided[i]):
            material, triangle = e.material[i], e.triangle[i]
            radiance = emission_left(t, material, triangle, np.float64(b1), np.float64(b2))
            if radiance[0] + radiance[1] + radiance[2] > 0:
                pdf = pdf_emitter(t, emitter_strength(t, material, triangle), e.double_sided[i], d2, facing * side)
    lift = side * _EPSILON * (abs(x) + abs(y) + abs(z))
    lifted = (x + lift * e.normal[i, 0], y + lift * e.normal[i, 1], z + lift * e.normal[i, 2])
    return radiance, (dx, dy, dz), pdf, lifted


@kernel
def from_emitters(t, ray, ray_bits, p, n, epsilon, glossy, look, u, v, w):  # type: ignore[no-untyped-def]
    """Light from one point of one emissive triangle: radiance times :func:`scattered` over the sum of both techniques' pdfs.

    The balance heuristic's weight p_l / (p_l + p_b) is already in it.
    """
    radiance, d, pdf, end = sample_emitter(t, p[0], p[1], p[2], u, v, w)
    if pdf <= 0:
        return 0.0, 0.0, 0.0
    fr, fg, fb, bsdf_pdf = scattered(t, glossy, look, d[0], d[1], d[2], n)
    if fr + fg + fb <= 0:
        return 0.0, 0.0, 0.0
    # Both ends have left their surfaces, so that neither of them blocks.
    ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    if blocked(t, ray, ray_bits, ox, oy, oz, end[0] - ox, end[1] - oy, end[2] - oz, np.float32(1.0)):
        return 0.0, 0.0, 0.0
    both = pdf + bsdf_pdf
    return fr / both * radiance[0], fg / both * radiance[1], fb / both * radiance[2]


@kernel
def _from_sky(t, ray, ray_bits, p, n, epsilon, glossy, look, u, v):  # type: ignore[no-untyped-def]
    radiance, d, pdf = sample_sky(t.sky, np.float64(u), np.float64(v))
    fr, fg, fb, bsdf_pdf = scattered(t, glossy, look, d[0], d[1], d[2], n)
    if fr + fg + fb <= 0:
        return 0.0, 0.0, 0.0
    ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    if blocked(t, ray, ray_bits, ox, oy, oz, d[0], d[1], d[2], _INFINITE):
        return 0.0, 0.0, 0.0
    both = pdf + bsdf_pdf
    return fr / both * radiance[0], fg / both * radiance[1], fb / both * radiance[2]


# The same, from one direction of the sky.
from_sky = either("sky")(_from_sky)(lambda t, ray, ray_bits, p, n, epsilon, glossy, look, u, v: (0.0, 0.0, 0.0))


@kernel
def from_lights(t, ray, ray_bits, p, n, epsilon, glossy, look, u):  # type: ignore[no-untyped-def]
    """Light from one punctual or directional light, chosen by weight: Σ E times :func:`scattered`, unbiased."""
    i, chance = choose(t.lights.cdf, np.float64(u))
    wx, wy, wz, distance, gain = toward_light(t.lights, i, p[0], p[1], p[2])
    if gain <= 0:
        return 0.0, 0.0, 0.0
    fr, fg, fb, _ = scattered(t, glossy, look, wx, wy, wz, n)
    if fr + fg + fb <= 0:
        return 0.0, 0.0, 0.0
    ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
    if blocked(t, ray, ray_bits, ox, oy, oz, wx, wy, wz, np.float32(distance)):
        return 0.0, 0.0, 0.0
    return (
        gain * (fr / chance) * t.lights.value[i, 0],
        gain * (fg / chance) * t.lights.value[i, 1],
        gain * (fb / chance) * t.lights.value[i, 2],
    )


@kernel
def sample_pair(reversed_index, index, depth, key):  # type: ignore[no-untyped-def]
    """Two sample coordinates of a path's vertex: stratified at the first vertices, plain random numbers after."""
    if depth <= STRATIFIED_VERTICES:
        return sobol_pair(reversed_index, key)
    return random_pair(index, key)


@kernel
def trace_path(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, reversed_index, index, key, camera, spread):  # type: ignore[no-untyped-def]
    """One path.

    Parameters
    ----------
    t : Tables
    ray, ray_bits : (24,) float32, the same as uint32
        An aligned RTCRayHit to work in.
    ox … dz : float
        The ray, local frame; unit direction.
    reversed_index, index, key
        Sample point: its index within its scramble, with bits reversed and plain, and what picks the scramble.
    camera : bool
        Whether the ray itself passes through back faces of single-sided materials, as a rasteriser's does that culls them.
    spread : float
        Width of what the ray stands for, radians: the square root of its solid angle. Textures are averaged over it.

    Returns
    -------
    emitted : 3 float64
        Radiance of what the ray itself meets: an emitter, the environment.
    direct : 3 float64
        Reflected at the first surface straight from punctual and directional lights.
    indirect : 3 float64
        Reflected at the first surface, all the rest.
    hit : bool
        Whether the ray met a surface.
    light_pdf : float64
        With which density :func:`sample_emitter` or :func:`bake_core.environment.sample_sky` would have found what the ray met; 0 where
        neither could.
    """
    emitted_r = emitted_g = emitted_b = 0.0
    direct_r = direct_g = direct_b = 0.0
    indirect_r = indirect_g = indirect_b = 0.0
    # Throughput of the materials alone, and what roulette has left of survival: their quotient is the path's weight.
    beta_r = beta_g = beta_b = 1.0
    survival = 1.0
    by_throughput = 1.0
    dark = 0
    pdf = 0.0
    width = 0.0
    hit_any = False
    light_pdf = 0.0
    passed = 0
    depth = 0
    has_emitters = t.emitters.cdf.shape[0] > 0
    has_lights = t.lights.cdf.shape[0] > 0
    shines = has_sky(t) or t.environment[0] + t.environment[1] + t.environment[2] > 0
    look = no_gloss(t)
    needs_choice = t.emitters.cdf.shape[0] > 1 or t.lights.cdf.shape[0] > 1
    # Where the ray goes on from, behind what it has passed through.
    x, y, z = ox, oy, oz
    while True:
        if depth > 0 and depth >= t.max_bounces and not has_emitters:
            # The last ray can only find the environment: whether anything is in the way is a cheaper question than what.
            if not shines or blocked(t, ray, ray_bits, ox, oy, oz, dx, dy, dz, _INFINITE):
                break
            ray_bits[18] = _INVALID
        else:
            set_ray(ray, ray_bits, x, y, z, dx, dy, dz, _INFINITE)
            intersect1(t.handle, ray.ctypes.data, 0)
        if ray_bits[18] == _INVALID:
            # No light is drawn from a constant environment: cosine sampling is already its importance sampling.
            radiance, sky_pdf = environment_radiance(t, dx, dy, dz)
            if depth == 0:
                emitted_r, emitted_g, emitted_b = radiance
                light_pdf = sky_pdf
            else:
                # Along the surface itself both may be 0.
                gain = pdf / (pdf + sky_pdf) if sky_pdf > 0 else 1.0
                indirect_r += beta_r / survival * (gain * radiance[0])
                indirect_g += beta_g / survival * (gain * radiance[1])
                indirect_b += beta_b / survival * (gain * radiance[2])
            break
        s = surface(t, ray_bits, ray, dx, dy, dz)
        p, n, epsilon, _, material, front, triangle, b1, b2, _ = s
        two_sided = t.materials.double_sided[material]
        behind = not front and not two_sided
        if passed < MAX_PASSED and ((behind and camera and depth == 0) or lets_through(t, material, triangle, b1, b2, ray_bits)):
            # Go on from the far side: the normal looks back at us.
            x, y, z = p[0] - epsilon * n[0], p[1] - epsilon * n[1], p[2] - epsilon * n[2]
            passed += 1
            continue
        hit_any = hit_any or depth == 0
        if behind:
            break
        dark += 1
        le_r, le_g, le_b = emission_at(t, material, triangle, b1, b2, 0.0)
        hx, hy, hz = p[0] - ox, p[1] - oy, p[2] - oz
        facing = abs(dx * n[0] + dy * n[1] + dz * n[2])
        if le_r + le_g + le_b > 0:
            dark = 0
            strength = emitter_strength(t, material, triangle)
            if depth == 0:
                emitted_r, emitted_g, emitted_b = le_r, le_g, le_b
                light_pdf = pdf_emitter(t, strength, two_sided, hx * hx + hy * hy + hz * hz, facing)
            else:
                gain = pdf / (pdf + pdf_emitter(t, strength, two_sided, hx * hx + hy * hy + hz * hz, facing)) / survival
                indirect_r += beta_r * gain * le_r
                indirect_g += beta_g * gain * le_g
                indirect_b += beta_b * gain * le_b
        if depth >= t.max_bounces:
            break
        width = widened(t, width, spread, math.sqrt(hx * hx + hy * hy + hz * hz))
        base_r, base_g, base_b, metallic, roughness = reflectance(t, s, width, facing)
        glossy = is_glossy(t, metallic, roughness)
        if glossy:
            look = gloss(t, (base_r, base_g, base_b), metallic, roughness, dx, dy, dz, n)
        else:
            beta_r *= base_r
            beta_g *= base_g
            beta_b *= base_b
        most = max(beta_r, beta_g, beta_b)
        if most <= 0:
            break
        depth += 1
        vertex = key + uint64(depth) * uint64(0xD1B54A32D192ED03)
        choice = np.float32(0)
        if needs_choice:
            choice, _ = sample_pair(reversed_index, index, depth, vertex + uint64(1))
        if has_emitters:
            light_u, light_v = sample_pair(reversed_index, index, depth, vertex + uint64(2))
            r, g, b = from_emitters(t, ray, ray_bits, p, n, epsilon, glossy, look, light_u, light_v, choice)
            if r + g + b > 0:
                dark = 0
                indirect_r += beta_r / survival * r
                indirect_g += beta_g / survival * g
                indirect_b += beta_b / survival * b
        if has_sky(t):
            light_u, light_v = sample_pair(reversed_index, index, depth, vertex + uint64(4))
            r, g, b = from_sky(t, ray, ray_bits, p, n, epsilon, glossy, look, light_u, light_v)
            if r + g + b > 0:
                dark = 0
                indirect_r += beta_r / survival * r
                indirect_g += beta_g / survival * g
                indirect_b += beta_b / survival * b
        if has_lights:
            # Emitters and punctual lights may share a number: each sum stays unbiased, and no product of the two is taken.
            r, g, b = from_lights(t, ray, ray_bits, p, n, epsilon, glossy, look, choice)
            if r + g + b > 0:
                dark = 0
                if depth == 1:
                    direct_r, direct_g, direct_b = beta_r * r, beta_g * g, beta_b * b
                else:
                    indirect_r += beta_r / survival * r
                    indirect_g += beta_g / survival * g
                    indirect_b += beta_b / survival * b
        bsdf_u, bsdf_v = sample_pair(reversed_index, index, depth, vertex)
        if glossy:
            dx, dy, dz = sample_gloss(t, look, np.float64(bsdf_u), np.float64(bsdf_v), n)
            fr, fg, fb, pdf = scattered(t, glossy, look, dx, dy, dz, n)
            if pdf <= 0 or fr + fg + fb <= 0:
                break
            beta_r *= fr / pdf
            beta_g *= fg / pdf
            beta_b *= fb / pdf
            most = max(beta_r, beta_g, beta_b)
        go_on = 1.0
        # A gloss may weigh more than 1 in a direction that is seldom drawn: what roulette took away it does not give back.
        if most < ROULETTE_THROUGHPUT * by_throughput:
            go_on = most / ROULETTE_THROUGHPUT / by_throughput
            by_throughput = most / ROULETTE_THROUGHPUT
        if dark > ROULETTE_DARK_VERTICES:
            go_on *= ((dark - 1.0) / dark) ** 2
        if depth > ROULETTE_LAST_VERTICES:
            go_on *= ((depth - 1.0) / depth) ** 2
        if go_on < 1:
            roulette, _ = random_pair(index, vertex + uint64(3))
            if roulette >= go_on:
                break
            survival *= go_on
        if not glossy:
            dx, dy, dz = sample_lambert(float(bsdf_u), float(bsdf_v), n)
            pdf = lambert_cosine(dx, dy, dz, n) * INV_PI
        spread = scattered_spread(t, spread, pdf)
        ox, oy, oz = p[0] + epsilon * n[0], p[1] + epsilon * n[1], p[2] + epsilon * n[2]
        x, y, z = ox, oy, oz
        passed = 0
    return (emitted_r, emitted_g, emitted_b), (direct_r, direct_g, direct_b), (indirect_r, indirect_g, indirect_b), hit_any, light_pdf
