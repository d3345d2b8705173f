"""Geometry that rays slip through or stick to: coincident and crossing walls, slivers, needles, triangles without area."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bake_core.gltf.writer import GlbWriter, Part
from bake_core.stability.case import HALF_ROUNDING, SIGMAS, Baker, Case, Result, maps, near, one_probe, samples, sky
from bake_core.stability.closed_rooms import furnace_sigma
from bake_core.stability.scenes import box, box_with_hole, scene

_TEXELS = 256
F64 = NDArray[np.float64]


def _furnace(baker: Baker, glb: bytes, what: str, count: int = 32) -> Result:
    """A sealed room of albedo ½ and emission 1 around eight probes: 2π."""
    bundle = baker((glb, {"volumes": one_probe((-0.55, -0.45, -0.6), 1.0, (2, 2, 2))}), stop=samples(count))
    tolerance = SIGMAS * furnace_sigma(0.5) / math.sqrt(8 * _TEXELS * count) + HALF_ROUNDING
    return near(2 * math.pi, maps(bundle).mean(), tolerance, f"mean irradiance, 2π Le; 4σ. {what}")


def coincident_walls(baker: Baker) -> Result:
    """Every wall of a white box with a window twice, under a white sky."""
    walls = box_with_hole(0.4)
    example = (
        scene(np.concatenate([walls, walls]), 1.0),
        {"volumes": one_probe((-0.55, -0.45, -0.6), 1.0, (2, 2, 2)), "environment": sky(1.0)},
    )
    single = baker((scene(walls, 1.0), example[1]), stop=samples(16))
    truth = maps(single).mean()
    return near(
        float(truth),
        maps(baker(example, stop=samples(16))).mean(),
        2 * HALF_ROUNDING,
        "mean irradiance, that of single walls with the same samples; half floats",
    )


def crossing_walls(baker: Baker) -> Result:
    """Six squares of 3 m whose middles bound a box of 2 m: they cross at its edges, and stand out beyond them."""
    walls = box()
    centre = walls.mean(1, keepdims=True)
    return _furnace(baker, scene(centre + (walls - centre) * 1.5, 0.5, 1.0), "Light leaks in or out at no crossing")


def slivers(baker: Baker) -> Result:
    """Each wall has a strip of 2e-8 m in its middle: two triangles of aspect 1e8."""
    edges = (-1.0, 0.0, 2e-8, 1.0)
    parts = []
    for a, b, c, d in box():
        for low, high in pairwise(edges):
            s, t = (low + 1) / 2, (high + 1) / 2
            # Exactly 2e-8 where the lerp would round it away.
            strip = np.stack([_between(a, b, s, low), _between(a, b, t, high), _between(d, c, t, high), _between(d, c, s, low)])
            parts.append(strip)
    return _furnace(baker, scene(np.stack(parts), 0.5, 1.0), "Triangles of aspect 1e8 in every wall")


def _between(a: F64, b: F64, share: float, along: float) -> F64:
    """A point of an edge from -1 to 1 along one axis, either way round."""
    axis = int(np.abs(b - a).argmax())
    point = a + share * (b - a)
    point[axis] = along * np.sign(b - a)[axis]
    return np.asarray(point)


def without_area(baker: Baker) -> Result:
    """Emissive triangles of which two or three corners are one, corners in a line, and corners with denormal coordinates."""
    w = GlbWriter()
    material = w.material("wall", (0.5,) * 3, emission=(1.0,) * 3)
    walls = box().reshape(-1, 3)
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    points = np.array([[0, 0, 0], [0.5, 0, 0], [0.25, 0, 0], [1e-40, 0, 0], [0, 1e-40, 0], [0, 0, 1e-42]])
    flat = np.array([[0, 0, 0], [0, 1, 1], [0, 1, 2], [3, 4, 5], [0, 3, 4]]) + len(walls)
    indices = np.concatenate([*(quad + 4 * i for i in range(6)), flat])
    w.node(mesh=w.mesh("box", [Part(np.concatenate([walls, points]), indices, material=material)]))
    return _furnace(baker, w.to_glb(), "Triangles without area neither shine nor block")


def needles(baker: Baker) -> Result:
    """A million white needles, 1 m long and 1 µm wide, every which way through 64 m³, under a white sky."""
    count = 1_000_000
    random = np.random.default_rng(1)
    a = random.uniform(-2, 2, (count, 3))
    along = random.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, random.normal(size=(count, 3)))
    across *= 1e-6 / np.linalg.norm(across, axis=1, keepdims=True)
    w = GlbWriter()
    material = w.material("needle", (1.0,) * 3, double_sided=True)
    corners = np.stack([a, a + along, a + across], 1).reshape(-1, 3)
    w.node(mesh=w.mesh("needles", [Part(corners, material=material)]))
    bundle = baker((w.to_glb(), {"volumes": one_probe((0.1, 0.2, 0.3)), "environment": sky(1.0)}), stop=samples(8))
    return near(math.pi, maps(bundle), HALF_ROUNDING, "every texel: π L, no path carries more or less; half floats")


CASES = (
    Case("coincident walls", coincident_walls),
    Case("interpenetrating walls", crossing_walls),
    Case("slivers of aspect 1e8", slivers),
    Case("triangles of zero area", without_area),
    Case("1,000,000 needle triangles", needles, slow=True),
)
