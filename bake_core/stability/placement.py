"""Probes where nobody should put them, and grids of every shape."""

from __future__ import annotations

import math

import numpy as np

from bake_core.examples import closed_box
from bake_core.irradiance import sample
from bake_core.octahedral import texel_directions
from bake_core.stability.case import HALF_ROUNDING, SIGMAS, Baker, Case, Result, at_most, maps, near, one_probe, samples, sky
from bake_core.stability.closed_rooms import furnace_sigma
from bake_core.stability.scenes import box, scene

_TEXELS = 256
_COUNT = 64
# Radiance 2 everywhere inside: albedo ½, emission 1.
_RADIANCE = 2.0


def _texel_tolerance() -> float:
    """4σ of one texel, whose irradiance half of a probe's paths feed."""
    return SIGMAS * furnace_sigma(0.5) / math.sqrt(_TEXELS / 2 * _COUNT) + HALF_ROUNDING


def _on_a_boundary(name: str, at: tuple[float, float, float]) -> Case:
    def run(baker: Baker) -> Result:
        """Rays into the room see 2; those along or out of the walls see 2 or the black outside, as rounding has it."""
        bundle = baker(closed_box(0.5, 1.0), volumes=one_probe(at), stop=samples(_COUNT))
        found = maps(bundle)[0, :, :, 0]
        # ∫ ω dω over the part of the sphere that looks into the room: π over a half, π/√2 along the bisector of a quarter.
        inwards = -np.array(at)
        sides = int(np.abs(inwards).sum())
        vector = _RADIANCE * math.pi / sides**0.5 * inwards / np.linalg.norm(inwards)
        least, most = np.maximum(texel_directions(8) @ vector, 0), _RADIANCE * math.pi
        beyond = max(float((least - found).max()), float(found.max()) - most, 0.0)
        note = "how far a texel is below what the room alone gives, or above 2π Le; 4σ of a texel. Which side a ray along the wall sees is open"
        return at_most(_texel_tolerance() * most, beyond, note)

    return Case(name, run)


def near_a_wall(baker: Baker) -> Result:
    bundle = baker(closed_box(0.5, 1.0), volumes=one_probe((-1 + 1e-6, 0.2, -0.3)), stop=samples(_COUNT))
    return near(2 * math.pi, maps(bundle).mean(), SIGMAS * furnace_sigma(0.5) / math.sqrt(_TEXELS * _COUNT) + HALF_ROUNDING, "mean irradiance, 2π Le; 4σ")


def inside_a_solid(baker: Baker) -> Result:
    glb = scene(box()[:, ::-1], 0.5)
    volumes = [{"origin": [0.1, 0.1, 0.1], "spacing": [3.0] * 3, "counts": [2, 1, 1]}]
    bundle = baker((glb, {"volumes": volumes, "environment": sky(1.0)}), stop=samples(4))
    inside, outside = bundle.volumes[0].states
    return Result(0.0, float(inside) + (1.0 - float(outside)) + float(maps(bundle)[0].max()), 0.0, "probes that are active inside or not outside, and light inside: none")


def _grid(counts: tuple[int, int, int]) -> Case:
    def run(baker: Baker) -> Result:
        bundle = baker(closed_box(0.5, 1.0), volumes=one_probe((-0.6, -0.6, -0.6), 0.3, counts), stop=samples(_COUNT))
        at = np.random.default_rng(0).uniform(-0.99, 0.99, (512, 3))
        normals = np.random.default_rng(1).normal(size=at.shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        found = sample(bundle.volumes, at, normals).irradiance
        return near(2 * math.pi, found, _texel_tolerance(), "the query at 512 points in and around the grid, 2π Le; 4σ of a texel")

    return Case(f"a grid of {'×'.join(map(str, counts))}", run)


CASES = (
    _on_a_boundary("a probe on a surface", (-1, 0, 0)),
    _on_a_boundary("a probe on an edge", (-1, -1, 0)),
    Case("a probe 1e-6 m from a wall", near_a_wall),
    Case("a probe inside a solid", inside_a_solid),
    _grid((1, 1, 1)),
    _grid((1, 4, 1)),
    _grid((2, 1, 2)),
)
