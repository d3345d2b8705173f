"""Rooms that keep their light: albedos up to exactly 1, sealed and nearly sealed."""

from __future__ import annotations

import math

import numpy as np

from bake_core.errors import SceneError
from bake_core.examples import closed_box, quads_part
from bake_core.gltf.writer import GlbWriter
from bake_core.stability.case import HALF_ROUNDING, SIGMAS, Baker, Case, Result, maps, near, one_probe, samples, sky
from bake_core.stability.scenes import box, box_with_hole, scene
from bake_core.transport import ROULETTE_DARK_VERTICES, ROULETTE_THROUGHPUT

# Capture texels of a diffuse scene, a path each a sample.
_TEXELS = 256


def furnace_sigma(albedo: float) -> float:
    """Bound of one path's relative σ in a closed box of albedo a that emits.

    Roulette below a throughput of τ adds τ²a to the relative variance. At each vertex light is estimated by the surface's and the lights'
    own sampling, each at most Le by the balance heuristic and Le on average together, which Bhatia and Davis 2000 ("A better bound on the
    variance") limits to a variance of Le²: weighted by a^2i and summed, (1 - a)/(1 + a) of the whole's square.
    """
    return math.sqrt(ROULETTE_THROUGHPUT**2 * albedo + (1 - albedo) / (1 + albedo))


def _furnace(albedo: float, count: int) -> Case:
    def run(baker: Baker) -> Result:
        bundle = baker(closed_box(albedo, 0.7), stop=samples(count))
        a = float(np.float32(albedo))
        paths = 8 * _TEXELS * count
        expected = math.pi * float(np.float32(0.7)) / (1 - a)
        tolerance = SIGMAS * furnace_sigma(a) / math.sqrt(paths) + HALF_ROUNDING
        return near(expected, maps(bundle).mean(), tolerance, f"mean irradiance, π Le/(1 − a); 4σ of {paths} paths, and half floats")

    return Case(f"albedo {albedo} in a sealed box that emits", run, slow=albedo > 0.99)


_PROBES = one_probe((-0.55, -0.45, -0.6), 1.0, (2, 2, 2))


def _nearly_closed(albedo: float, count: int) -> Case:
    """A window of 1e-2 m² in walls that give back what they absorb: radiance is 1 everywhere, whatever the room's shape."""

    def run(baker: Baker) -> Result:
        glb = scene(box_with_hole(0.05), albedo, 1 - albedo)
        bundle = baker((glb, {"volumes": _PROBES, "environment": sky(1.0)}), stop=samples(count))
        paths = 8 * _TEXELS * count
        tolerance = SIGMAS * furnace_sigma(albedo) / math.sqrt(paths) + HALF_ROUNDING
        note = f"mean irradiance, π L where walls emit (1 − a) L and the sky is L; 4σ of {paths} paths"
        return near(math.pi, maps(bundle).mean(), tolerance, note)

    return Case(f"albedo {albedo} in a box with a window", run)


def _white_with_window(share: float, count: int) -> Case:
    """Walls of exactly 1: radiance is 1 everywhere, though a path takes 1/share vertices to find the window."""

    def run(baker: Baker) -> Result:
        glb = scene(box_with_hole(math.sqrt(24 * share) / 2), 1.0)
        bundle = baker((glb, {"volumes": _PROBES, "environment": sky(1.0)}), stop=samples(count))
        # A path leaves at each vertex with the window's share of the walls, x in 64 vertices; beyond those its weight grows as (m/64)².
        x = ROULETTE_DARK_VERTICES * share
        variance = math.exp(-x) * (2 / x + 2 / x**2)
        paths = 8 * _TEXELS * count
        tolerance = SIGMAS * math.sqrt(variance / paths) + HALF_ROUNDING
        each = f"{math.sqrt(variance):.2g}"
        note = f"mean irradiance, π L; 4σ of {paths} paths whose σ is {each} of it by roulette in the dark: what a room this closed loses"
        return near(math.pi, maps(bundle).mean(), tolerance, note)

    return Case(f"albedo 1 in a box with a window of {share:g} of its walls", run, slow=share < 0.01)


def white_sealed_dark(baker: Baker) -> Result:
    """Walls that absorb nothing, light outside only."""
    lit = {"environment": sky(1e6), "lights": [{"kind": "point", "position": [3, 0, 0], "intensity": [1e6] * 3}]}
    bundle = baker(closed_box(1.0, 0.0), **lit, stop=samples(16))
    return Result(0.0, float(maps(bundle).max()), 0.0, "largest irradiance: no ray gets in, and paths end")


def _endless(name: str, emission: float, **changes: object) -> Case:
    def run(baker: Baker) -> Result:
        try:
            bundle = baker(closed_box(1.0, emission), **changes, stop=samples(16))
        except SceneError as e:
            return Result("scene.light_never_ends", e.slug, 0.0, "refused before the first pass: no finite answer")
        return Result("scene.light_never_ends", float(maps(bundle).mean()), 0.0, "a figure where none is true")

    return Case(name, run)


def white_sealed_with_a_lamp(baker: Baker) -> Result:
    """A lamp in the middle of the sealed white box, itself as white."""
    w = GlbWriter()
    # Double-sided: a back would be black, take what meets it, and make the answer finite.
    wall, lamp = w.material("wall", (1.0,) * 3), w.material("lamp", (1.0,) * 3, emission=(1.0,) * 3, double_sided=True)
    glow = np.array([[-0.2, 0.3, -0.2], [0.2, 0.3, -0.2], [0.2, 0.3, 0.2], [-0.2, 0.3, 0.2]])
    w.node(mesh=w.mesh("room", [quads_part(list(box()), wall), quads_part([glow], lamp)]))
    try:
        bundle = baker((w.to_glb(), {"volumes": _PROBES}), stop=samples(16))
    except SceneError as e:
        return Result("scene.light_never_ends", e.slug, 0.0, "refused before the first pass: no finite answer")
    return Result("scene.light_never_ends", float(maps(bundle).mean()), 0.0, "a figure where none is true")


def white_sealed_with_bounces(baker: Baker) -> Result:
    """The same box, its bounces limited: π Le (k + 1)."""
    k, count = 16, 64
    bundle = baker(closed_box(1.0, 0.7, k), stop=samples(count))
    paths = 8 * _TEXELS * count
    tolerance = SIGMAS * math.sqrt(k) / (k + 1) / math.sqrt(paths) + HALF_ROUNDING
    expected = math.pi * float(np.float32(0.7)) * (k + 1)
    return near(
        expected, maps(bundle).mean(), tolerance, f"mean irradiance, π Le (k + 1) at k = {k}; 4σ of {paths} paths of at most Le a vertex"
    )


def white_slab_in_the_plane(baker: Baker) -> Result:
    """A white slab of no thickness under a white sky, probes in its very plane, a hair beside it, and in line with its edges."""
    square = [[[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]]
    offsets = (0.0, 1e-6, -1e-6, 0.1)
    volumes = [{"name": f"y{i}", "origin": [-2, y, -1], "spacing": [1, 1, 1], "counts": [2, 1, 3]} for i, y in enumerate(offsets)]
    bundle = baker((scene(square, 1.0, double_sided=True), {"volumes": volumes, "environment": sky(1.0)}), stop=samples(16))
    found = np.concatenate([maps(bundle, volume=i).ravel() for i in range(len(offsets))])
    return near(math.pi, found, HALF_ROUNDING, "every texel: π L, no path carries more or less; half floats")


CASES = (
    _furnace(0.99, 8),
    _furnace(0.999, 2),
    _nearly_closed(0.99, 8),
    _nearly_closed(0.999, 2),
    _white_with_window(1e-2, 64),
    _white_with_window(1e-3, 512),
    Case("albedo 1, sealed, light outside only", white_sealed_dark),
    _endless("albedo 1, sealed, walls that emit", 0.7),
    _endless("albedo 1, sealed, a point light inside", 0.0, lights=[{"kind": "point", "position": [0, 0, 0], "intensity": [1.0] * 3}]),
    Case("albedo 1, sealed, a lamp inside", white_sealed_with_a_lamp),
    Case("albedo 1, sealed, 16 bounces", white_sealed_with_bounces),
    Case("a grazing slab of albedo 1", white_slab_in_the_plane),
)
