"""Very many of a thing: instances, lights, emissive triangles."""

from __future__ import annotations

import math

import numpy as np

from bake_core.gltf.writer import GlbWriter, Part
from bake_core.stability.case import HALF_ROUNDING, SIGMAS, Baker, Case, Result, maps, near, one_probe, samples, sky
from bake_core.stability.closed_rooms import furnace_sigma
from bake_core.stability.scenes import sphere


def instances(baker: Baker) -> Result:
    """100,000 white shards under a white sky."""
    w = GlbWriter()
    shard = Part([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], material=w.material("white", (1.0,) * 3, double_sided=True))
    mesh = w.mesh("shard", [shard])
    random = np.random.default_rng(2)
    places = random.uniform(-10, 10, (100_000, 3))
    turns = random.normal(size=(100_000, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    for place, turn in zip(places.tolist(), turns.tolist(), strict=True):
        w.node(mesh=mesh, translation=place, rotation=turn, scale=(0.01, 0.01, 0.01))
    bundle = baker((w.to_glb(), {"volumes": one_probe((-4, -4, -4), 8.0, (2, 2, 2)), "environment": sky(1.0)}), stop=samples(8))
    return near(math.pi, maps(bundle), HALF_ROUNDING, "every texel: π L, no path carries more or less; half floats")


def lights_and_emitters(baker: Baker) -> Result:
    """64 point lights in the middle of a ball of 102,400 triangles, all of which shine; 640 of them have no area."""
    albedo, emission, intensity, count, segments = 0.5, 1.0, 1 / 64, 64, 320
    points, triangles = sphere(segments)
    w = GlbWriter()
    material = w.material("glow", (albedo,) * 3, emission=(emission,) * 3)
    w.node(mesh=w.mesh("ball", [Part(points, triangles[:, ::-1], material=material)]))
    lights = [{"kind": "point", "position": [0, 0, 0], "intensity": [intensity] * 3}] * 64
    bundle = baker((w.to_glb(), {"volumes": one_probe((0.2, -0.3, 0.1)), "lights": lights}), stop=samples(count))
    # Lights give the wall E = 64 I/R², of which a E/π goes out; that and the emission go round 1/(1 - a) times. Probes see all of it.
    expected = math.pi * (emission + albedo * 64 * intensity / math.pi) / (1 - albedo)
    paths = 256 * count
    # The facets lie up to h²/8 nearer than R, h their longest side, √2 times 2π/segments: E is greater by twice that.
    facets = 2 * 2 * (2 * math.pi / segments) ** 2 / 8
    tolerance = SIGMAS * furnace_sigma(albedo) / math.sqrt(paths) + HALF_ROUNDING + facets
    return near(
        expected, maps(bundle).mean(), tolerance, f"mean irradiance, (π Le + a·64 I/R²)/(1 − a); 4σ of {paths} paths, and the ball's facets"
    )


CASES = (
    Case("100,000 instances", instances, slow=True),
    Case("64 lights and 100,000 emissive triangles", lights_and_emitters, slow=True),
)
