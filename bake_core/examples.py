"""Scenes of our own: the demo's, and those whose answer is known in closed form. Each function gives (GLB bytes, spec).

Corners are put at short decimals or exact fractions, so that the closed forms hold for the float32 scene too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.gltf.writer import GlbWriter, Part, look_at

Vec3 = Sequence[float]
Example = tuple[bytes, dict[str, Any]]
Corners = NDArray[np.float64]

_QUAD = np.array([[0, 1, 2], [0, 2, 3]])
# The sides of a box as corner numbers x + 2y + 4z, counter-clockwise as seen from inside: -x, +x, -y, +y, -z, +z.
_SIDES = ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))


def box_sides(low: Vec3, high: Vec3) -> list[Corners]:
    """The six sides of a box, facing inwards, in the order -x, +x, -y, +y, -z, +z."""
    corner = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)], np.float64)
    return [corner[list(side)] for side in _SIDES]


def quads_part(quads: Sequence[Corners], material: int, *, outwards: bool = False) -> Part:
    """Quads as one primitive, turned round where they shall face outwards."""
    quads = [q[::-1] if outwards else q for q in quads]
    indices = np.concatenate([_QUAD + 4 * i for i in range(len(quads))])
    return Part(np.concatenate(quads), indices, material=material)


def _horizontal(x: Vec3, z: Vec3, y: float, *, up: bool) -> Corners:
    """A horizontal rectangle over x[0]..x[1], z[0]..z[1], facing up or down."""
    quad = np.array([[x[0], y, z[0]], [x[0], y, z[1]], [x[1], y, z[1]], [x[1], y, z[0]]], np.float64)
    return quad if up else quad[::-1]


def cornell() -> Example:
    """A Cornell box: a room of 2 × 2 × 2 m, open in front (+z), two boxes, a lamp in the ceiling, and a sun that comes in at the front.

    Walls are single-sided and face inwards. Both boxes are one mesh, used twice. The turns are by 3-4-5 triangles, so that the bytes
    do not hang on a mathematics library. The 8 × 8 × 8 probes are 25 cm apart, the outermost half of that from the walls.
    """
    w = GlbWriter()
    white = w.material("white", (0.76, 0.75, 0.72))
    left = w.material("terracotta", (0.65, 0.13, 0.06))
    right = w.material("teal", (0.05, 0.32, 0.38))
    blocks = w.material("blocks", (0.74, 0.70, 0.60))
    lamp = w.material("lamp", (0.78, 0.78, 0.78), emission=(9.0, 7.2, 4.8))
    sides = box_sides((-1, 0, -1), (1, 2, 1))
    # The lamp hangs 1 cm below the ceiling: two surfaces in one plane would have no order.
    glow = _horizontal((-0.35, 0.35), (-0.3, 0.3), 1.99, up=False)
    plain = quads_part([sides[2], sides[3], sides[4]], white)
    room = w.mesh("room", [plain, quads_part([sides[0]], left), quads_part([sides[1]], right), quads_part([glow], lamp)])
    # A block stands on the floor and has no bottom.
    faces = box_sides((-0.5, 0, -0.5), (0.5, 1, 0.5))
    block = w.mesh("block", [quads_part([f for i, f in enumerate(faces) if i != 2], blocks, outwards=True)])
    w.node("room", mesh=room)
    w.node("tall block", mesh=block, matrix=_turned((0.58, 1.2, 0.58), (0.96, 0.28), (-0.36, 0, -0.36)))
    w.node("short block", mesh=block, matrix=_turned((0.56, 0.56, 0.56), (0.936, -0.352), (0.38, 0, 0.32)))
    sun = w.light("directional", (1.0, 0.92, 0.78), 7.0)
    w.node("sun", light=sun, matrix=look_at((0.9, 1.5, 2.0), (0, 0, 0)))
    w.node("front", camera=w.camera(math.radians(56)), matrix=look_at((0.0, 1.02, 0.98), (0.0, 0.92, -1.0)))
    w.node("corner", camera=w.camera(math.radians(62)), matrix=look_at((-0.9, 1.55, 0.92), (0.35, 0.6, -0.5)))
    grid = {"name": "room", "origin": [-0.875, 0.125, -0.875], "spacing": [0.25, 0.25, 0.25], "counts": [8, 8, 8]}
    return w.to_glb(), {"version": 1, "volumes": [grid]}


def glossy_cornell(roughness: float, color: Vec3 = (0.95, 0.93, 0.88)) -> Example:
    """A Cornell box that is closed all round, its boxes of metal: mirrors at roughness 0. A lamp, and no other light.

    All that the metal shows is what probes saw. The 6 × 6 × 6 probes are 32 cm apart.
    """
    w = GlbWriter()
    white = w.material("white", (0.76, 0.75, 0.72))
    left = w.material("terracotta", (0.65, 0.13, 0.06))
    right = w.material("teal", (0.05, 0.32, 0.38))
    metal = w.material("metal", color, metallic=1.0, roughness=roughness)
    lamp = w.material("lamp", (0.78, 0.78, 0.78), emission=(9.0, 7.2, 4.8))
    sides = box_sides((-1, 0, -1), (1, 2, 1))
    glow = _horizontal((-0.35, 0.35), (-0.3, 0.3), 1.99, up=False)
    plain = quads_part([sides[2], sides[3], sides[4], sides[5]], white)
    room = w.mesh("room", [plain, quads_part([sides[0]], left), quads_part([sides[1]], right), quads_part([glow], lamp)])
    faces = box_sides((-0.5, 0, -0.5), (0.5, 1, 0.5))
    block = w.mesh("block", [quads_part([f for i, f in enumerate(faces) if i != 2], metal, outwards=True)])
    w.node("room", mesh=room)
    w.node("tall block", mesh=block, matrix=_turned((0.58, 1.2, 0.58), (0.96, 0.28), (-0.36, 0, -0.36)))
    w.node("short block", mesh=block, matrix=_turned((0.56, 0.56, 0.56), (0.936, -0.352), (0.38, 0, 0.32)))
    w.node("front", camera=w.camera(math.radians(62)), matrix=look_at((0.55, 1.2, 0.95), (-0.15, 0.6, -0.6)))
    grid = {"name": "room", "origin": [-0.8, 0.2, -0.8], "spacing": [0.32, 0.32, 0.32], "counts": [6, 6, 6]}
    return w.to_glb(), {"version": 1, "volumes": [grid]}


def _turned(size: Vec3, turn: tuple[float, float], position: Vec3) -> NDArray[np.float64]:
    """Scale, then turn about +y by the angle whose cosine and sine are `turn`, then move."""
    cosine, sine = turn
    rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.asarray(size)
    matrix[:3, 3] = position
    return matrix


def closed_box(albedo: float, emission: float, max_bounces: int | None = None, *, metallic: float = 0.0, roughness: float = 1.0) -> Example:
    """A furnace: a sealed box of 2 × 2 × 2 m, all of whose walls have this albedo and emit this radiance, with 2 × 2 × 2 probes.

    Every texel of every probe has irradiance π·Le/(1−a); with `max_bounces` k, times (1−a^(k+1)).
    """
    w = GlbWriter()
    wall = w.material("wall", (albedo,) * 3, metallic=metallic, roughness=roughness, emission=(emission,) * 3)
    w.node("box", mesh=w.mesh("box", [quads_part(box_sides((-1, -1, -1), (1, 1, 1)), wall)]))
    # Off the box's symmetries, so that no two probes see the same.
    grid = {"name": "box", "origin": [-0.55, -0.45, -0.6], "spacing": [1.0, 1.0, 1.0], "counts": [2, 2, 2]}
    stop = {"target_error": None, "max_samples": 256}
    return w.to_glb(), {"version": 1, "volumes": [grid], "max_bounces": max_bounces, "stop": stop}


def plane_under_sun(
    albedo: float = 0.5, irradiance: float = 3.0, direction: Vec3 = (0.48, -0.8, 0.36), half_width: float = 4096.0
) -> Example:
    """A plane at y = 0, facing up, under a directional light of the glTF's; one probe 1 m above it.

    With E⊥ the light's irradiance and d its unit direction of travel, the plane's radiance is L = a·E⊥·|d.y|/π, and a receiver of
    normal n in the open above an endless plane has E(n) = π·L·(1−n.y)/2: a·E⊥·|d.y| facing down, half of it on a vertical receiver,
    0 facing up.
    A plane that ends at `half_width` w loses 0.82/w² of the first and 1.14/w of the second.
    """
    w = GlbWriter()
    span = (-half_width, half_width)
    plane = quads_part([_horizontal(span, span, 0.0, up=True)], w.material("plane", (albedo,) * 3))
    w.node("plane", mesh=w.mesh("plane", [plane]))
    w.node("sun", light=w.light("directional", intensity=irradiance), matrix=look_at((0, 0, 0), direction))
    grid = {"name": "above", "origin": [0.0, 1.0, 0.0], "spacing": [1.0, 1.0, 1.0], "counts": [1, 1, 1]}
    stop = {"target_error": None, "max_samples": 256}
    return w.to_glb(), {"version": 1, "volumes": [grid], "resolution": {"irradiance": 16}, "stop": stop}


def square_emitter(radiance: float = 1.0, *, shared: bool = True) -> Example:
    """A black unit square at x = 1 that emits towards the probe at the origin, and its twin at x = -1, mirrored by a scale of -1.

    At the origin, E(+x) = E(-x) = π·Le·F, F = (4/π)·(X/√(1+X²))·atan(X/√(1+X²)), X = 1/2: the form factor of a rectangle 1 m away from an
    element parallel to it (Howell, A Catalog of Radiation Heat Transfer Configuration Factors, B-4). E = 0.752275·Le.

    Parameters
    ----------
    radiance : float
        Le, from the front of each square.
    shared : bool
        True: both nodes share a mesh, so both are instances. False: each has its own, so both are baked into the static world.
    """
    w = GlbWriter()
    glow = w.material("glow", (0.0, 0.0, 0.0), emission=(radiance,) * 3)
    square = np.array([[1, -0.5, -0.5], [1, -0.5, 0.5], [1, 0.5, 0.5], [1, 0.5, -0.5]], np.float64)
    part = quads_part([square], glow)
    mesh = w.mesh("square", [part])
    w.node("square", mesh=mesh)
    w.node("twin", mesh=mesh if shared else w.mesh("twin", [part]), scale=(-1, 1, 1))
    grid = {"name": "between", "origin": [0.0, 0.0, 0.0], "spacing": [1.0, 1.0, 1.0], "counts": [1, 1, 1]}
    stop = {"target_error": None, "max_samples": 256}
    return w.to_glb(), {"version": 1, "volumes": [grid], "resolution": {"irradiance": 16}, "stop": stop}


def square_emitter_irradiance(radiance: float = 1.0) -> float:
    """Closed form of :func:`square_emitter` at the origin, facing either square."""
    x = 0.5 / math.sqrt(1.25)
    return radiance * 4 * x * math.atan(x)


def two_rooms(albedo: float = 0.7, scale: float = 1.0) -> Example:
    """Two sealed rooms of 4 × 3 × 4 m beside each other, a wall of 2 cm between them; a lamp in the left one's ceiling.

    The rooms are x in [-4.01, -0.01] and [0.01, 4.01], y in [0, 3], z in [-2, 2]. In the right one every irradiance is exactly 0.
    The probes (8 × 3 × 4, 1 m apart) stand half a metre from the walls, none in the wall between. All lengths are times `scale`.
    """
    w = GlbWriter()
    wall = w.material("wall", (albedo,) * 3)
    lamp = w.material("lamp", (0.0, 0.0, 0.0), emission=(10.0, 10.0, 10.0))
    glow = _horizontal((-2.51, -1.51), (-0.5, 0.5), 2.98, up=False)
    left, right = box_sides((-4.01, 0, -2), (-0.01, 3, 2)), box_sides((0.01, 0, -2), (4.01, 3, 2))
    lit = w.mesh("lit room", [quads_part([q * scale for q in left], wall), quads_part([glow * scale], lamp)])
    dark = w.mesh("dark room", [quads_part([q * scale for q in right], wall)])
    w.node("lit room", mesh=lit)
    w.node("dark room", mesh=dark)
    for name, eye, target in (("lit", (-3.8, 1.6, 1.8), (-0.5, 1.2, -1.0)), ("dark", (3.8, 1.6, 1.8), (0.5, 1.2, -1.0))):
        w.node(name, camera=w.camera(math.radians(70)), matrix=look_at([x * scale for x in eye], [x * scale for x in target]))
    origin, spacing = [-3.5 * scale, 0.5 * scale, -1.5 * scale], [scale] * 3
    return w.to_glb(), {"version": 1, "volumes": [{"name": "rooms", "origin": origin, "spacing": spacing, "counts": [8, 3, 4]}]}


def tunnel() -> Example:
    """Two galleries of 2 × 2.4 × 14 m beside each other, a wall of 5 cm between them that ends in a gallery across; a lamp near one's end.

    The first is x in [-2.025, -0.025], the second its mirror image, the one across z in [14, 16]; light comes to the second round the bend
    alone, and falls over its length to a hundredth. The probes (4 × 3 × 16, 1 m apart) stand off the middle of everything.
    """
    w = GlbWriter()
    stone = w.material("stone", (0.7, 0.66, 0.6))
    lamp = w.material("lamp", (0.0, 0.0, 0.0), emission=(20.0, 18.0, 14.0))
    first, second = box_sides((-2.025, 0, 0), (-0.025, 2.4, 14)), box_sides((0.025, 0, 0), (2.025, 2.4, 14))
    across = box_sides((-2.025, 0, 14), (2.025, 2.4, 16))
    # Where galleries meet there is no side; of the wall between them, the narrow one.
    end = np.array([[-0.025, 0, 14], [0.025, 0, 14], [0.025, 2.4, 14], [-0.025, 2.4, 14]], np.float64)
    sides = first[:5] + second[:5] + across[:4] + across[5:] + [end]
    glow = _horizontal((-1.4, -0.8), (1.0, 3.0), 2.38, up=False)
    w.node("tunnel", mesh=w.mesh("tunnel", [quads_part(sides, stone), quads_part([glow], lamp)]))
    grid = {"name": "tunnel", "origin": [-1.6, 0.45, 0.3], "spacing": [1.0, 1.0, 1.0], "counts": [4, 3, 16]}
    return w.to_glb(), {"version": 1, "volumes": [grid]}


def rough_floor(triangles: int) -> Example:
    """A closed room of 2 × 2 × 2 m under a lamp, with a bumpy floor of about so many triangles: one in which trees have something to do."""
    side = max(1, round(math.sqrt(triangles / 2)))
    at = np.linspace(-1, 1, side + 1)
    z, x = np.meshgrid(at, at, indexing="ij")
    # Bumps of 5 cm that do not repeat with the grid, from nothing but products: the same bytes on every machine.
    height = 0.1 * ((x * 7.3) % 1 - 0.5) * ((z * 5.9) % 1 - 0.5) + 0.05
    corners = np.stack([x, height, z], -1).reshape(-1, 3)
    low = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    quads = np.stack([low, low + side + 1, low + side + 2, low + 1], 1)
    w = GlbWriter()
    white = w.material("white", (0.7, 0.7, 0.7))
    lamp = w.material("lamp", (0.0, 0.0, 0.0), emission=(9.0, 9.0, 9.0))
    sides = box_sides((-1, -0.1, -1), (1, 2, 1))
    glow = _horizontal((-0.35, 0.35), (-0.3, 0.3), 1.99, up=False)
    floor = Part(corners, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), material=white)
    w.node("room", mesh=w.mesh("room", [quads_part(sides, white), floor, quads_part([glow], lamp)]))
    return w.to_glb(), {"version": 1, "volumes": [_MIDDLE]}


def many_lamps(emitters: int) -> Example:
    """A closed room of 2 × 2 × 2 m with a square grid of lamps, about so many triangles; the same area of its ceiling for any number."""
    side = max(1, round(math.sqrt(emitters / 2)))
    step = 1.8 / side
    edge = step * math.sqrt(0.5)
    first = -0.9 + step * (0.5 + np.arange(side)) - edge / 2
    glows = [_horizontal((x, x + edge), (z, z + edge), 1.99, up=False) for x in first for z in first]
    w = GlbWriter()
    white = w.material("white", (0.7, 0.7, 0.7))
    lamp = w.material("lamp", (0.0, 0.0, 0.0), emission=(4.0, 4.0, 4.0))
    w.node("room", mesh=w.mesh("room", [quads_part(box_sides((-1, 0, -1), (1, 2, 1)), white), quads_part(glows, lamp)]))
    return w.to_glb(), {"version": 1, "volumes": [_MIDDLE]}


def lamp_corridor(lamps: int) -> Example:
    """A closed corridor, 2 × 2 m and 2 m long for each of its lamps: most light up another part of it than the one that asks."""
    length = 2.0 * lamps
    glows = [_horizontal((-0.1, 0.1), (z - 0.1, z + 0.1), 1.98, up=False) for z in np.arange(1.0, length, 2.0)]
    w = GlbWriter()
    white = w.material("white", (0.7, 0.7, 0.7))
    lamp = w.material("lamp", (0.0, 0.0, 0.0), emission=(20.0, 20.0, 20.0))
    w.node("corridor", mesh=w.mesh("corridor", [quads_part(box_sides((-1, 0, 0), (1, 2, length)), white), quads_part(glows, lamp)]))
    grid = {"name": "corridor", "origin": [-0.4, 0.5, 1.0], "spacing": [0.8, 0.5, length / 16], "counts": [2, 3, 16]}
    return w.to_glb(), {"version": 1, "volumes": [grid]}


# One probe in the middle of a room of 2 m.
_MIDDLE = {"name": "room", "origin": [0.1, 0.9, -0.1], "spacing": [1.0, 1.0, 1.0], "counts": [1, 1, 1]}
