"""Probes where nobody should put them, and grids of every shape."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bake_core.examples import closed_box
from bake_core.irradiance import sample
from bake_core.stability.case import HALF_ROUNDING, SIGMAS, Baker, Case, Result, maps, near, one_probe, samples, sky
from bake_core.stability.closed_rooms import furnace_sigma
from bake_core.stability.scenes import box, scene

_TEXELS = 256
_COUNT = 64


def _texel_tolerance() -> float:
    """4σ of one texel, whose irradiance half of a probe's paths feed."""
    return SIGMAS * furnace_sigma(0.5) / math.sqrt(_TEXELS / 2 * _COUNT) + HALF_ROUNDING


def _on_a_boundary(name: str, at: tuple[float, float, float]) -> Case:
    """Probes exactly on a wall or an edge, the last of them in the middle of the room."""
    low = (min(at[0], 0.0), min(at[1], 0.0), min(at[2], 0.0))
    counts = (1 + (low[0] < 0), 1 + (low[1] < 0), 1 + (low[2] < 0))

    def run(baker: Baker) -> Result:
        bundle = baker(closed_box(0.5, 1.0), volumes=one_probe(low, 1.0, counts), stop=samples(_COUNT))
        points = np.random.default_rng(0).uniform(-0.99, 0.0, (512, 3))
        found = sample(bundle.volumes, points, _normals()).irradiance
        share = float(bundle.volumes[0].backface[0])
        note = (
            "the query at 512 points between it and a probe in the open, 2π Le; 4σ of a texel. A ray that starts in a wall meets it there: "
            f"the probe sees {share:.0%} of backs, counts as inside a solid, and is left out"
        )
        return near(2 * math.pi, found, _texel_tolerance(), note)

    return Case(name, run)


def _normals() -> NDArray[np.float64]:
    """512 directions, every which way."""
    n = np.random.default_rng(1).normal(size=(512, 3))
    return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))


def near_a_wall(baker: Baker) -> Result:
    bundle = baker(closed_box(0.5, 1.0), volumes=one_probe((-1 + 1e-6, 0.2, -0.3)), stop=samples(_COUNT))
    return near(
        2 * math.pi,
        maps(bundle).mean(),
        SIGMAS * furnace_sigma(0.5) / math.sqrt(_TEXELS * _COUNT) + HALF_ROUNDING,
        "mean irradiance, 2π Le; 4σ",
    )


def inside_a_solid(baker: Baker) -> Result:
    glb = scene(box()[:, ::-1], 0.5)
    volumes = [{"origin": [0.1, 0.1, 0.1], "spacing": [3.0] * 3, "counts": [2, 1, 1]}]
    bundle = baker((glb, {"volumes": volumes, "environment": sky(1.0)}), stop=samples(4))
    inside, outside = bundle.volumes[0].states
    return Result(
        0.0,
        float(inside) + (1.0 - float(outside)) + abs(len(maps(bundle)) - 1.0),
        0.0,
        "probes that are active inside or not outside, and tiles but that of the one outside: none",
    )


def _grid(counts: tuple[int, int, int]) -> Case:
    def run(baker: Baker) -> Result:
        bundle = baker(closed_box(0.5, 1.0), volumes=one_probe((-0.6, -0.6, -0.6), 0.3, counts), stop=samples(_COUNT))
        at = np.random.default_rng(0).uniform(-0.99, 0.99, (512, 3))
        found = sample(bundle.volumes, at, _normals()).irradiance
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
