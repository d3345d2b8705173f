"""Very many of a thing: instances, lights, emissive triangles."""

from __future__ import annotations

import math

import numpy as np

from bake_core.gltf.writer import GlbWriter, Part
from bake_core.octahedral import texel_directions, texel_solid_angles
from bake_core.stability.case import HALF_ROUNDING, SIGMAS, Baker, Case, Result, maps, near, one_probe, samples, sky
from bake_core.stability.closed_rooms import furnace_sigma
from bake_core.stability.scenes import sphere

_TEXELS = 256


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
    """64 point lights of many strengths in a ball of 102,400 triangles, all of which shine; 640 of them have no area.

    At the ball's middle the mean over all normals of irradiance is a quarter of all radiance that arrives (a receiver's cosine has that
    mean over the sphere). The wall's mean is known wherever lights stand: they give it 4π Σ I over 4π R².
    """
    albedo, emission, count, segments = 0.5, 1.0, 64, 320
    points, triangles = sphere(segments)
    w = GlbWriter()
    material = w.material("glow", (albedo,) * 3, emission=(emission,) * 3)
    w.node(mesh=w.mesh("ball", [Part(points, triangles[:, ::-1], material=material)]))
    random = np.random.default_rng(3)
    strength = random.uniform(0.2, 1.0, 64)
    strength /= strength.sum()
    # Within a quarter of the radius, so that no light is more than (1/0.75)² as strong on the wall as one in the middle.
    places = random.normal(size=(64, 3))
    places *= 0.25 * random.uniform(0, 1, (64, 1)) / np.linalg.norm(places, axis=1, keepdims=True)
    lights = [
        {"kind": "point", "position": at, "intensity": [intensity] * 3}
        for at, intensity in zip(places.tolist(), strength.tolist(), strict=True)
    ]
    bundle = baker((w.to_glb(), {"volumes": one_probe((0.0, 0.0, 0.0)), "lights": lights}), stop=samples(count))
    weight = texel_solid_angles(8).reshape(8, 8, 1) / (4 * math.pi)
    found = (maps(bundle)[0] * weight).sum((0, 1))
    # Of lights and emission a part goes round 1/(1 - a) times; the probe sees all of it.
    expected = math.pi * (emission + albedo / math.pi) / (1 - albedo)
    paths = _TEXELS * count
    # The facets lie up to h²/8 nearer than R, h their longest side, √2 times 2π/segments: E is greater by twice that.
    facets = 2 * 2 * (2 * math.pi / segments) ** 2 / 8
    # The mean over texels weighs directions unevenly by this much at most; it matters to what is uneven, the lights' part of the light.
    cosines = np.maximum(texel_directions(8).reshape(-1, 3) @ texel_directions(16).reshape(-1, 3).T, 0)
    uneven = float(np.abs(4 * (cosines * weight.reshape(-1, 1)).sum(0) - 1).max())
    share = (albedo / math.pi) / (emission + albedo / math.pi)
    tolerance = SIGMAS * furnace_sigma(albedo) / math.sqrt(paths) + HALF_ROUNDING + facets + uneven * share * (1 / 0.75**2 - 1)
    return near(
        expected,
        found,
        tolerance,
        f"mean irradiance over the sphere, (π Le + a Σ I/R²)/(1 − a); 4σ of {paths} paths; facets; texels",
    )


CASES = (
    Case("100,000 instances", instances, slow=True),
    Case("64 lights and 100,000 emissive triangles", lights_and_emitters, slow=True),
)
