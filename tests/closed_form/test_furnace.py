"""A closed box of albedo a whose walls emit Le: irradiance is π·Le/(1-a) everywhere, times (1-a^(k+1)) at k bounces."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bake_core.examples import closed_box
from tests.baking import bake_example, maps


@pytest.mark.parametrize(
    ("albedo", "bounces"),
    [(0.5, None), (0.9, None), pytest.param(0.99, None, marks=pytest.mark.slow), (0.5, 0), (0.5, 1), (0.9, 4), (0.99, 30)],
)
def test_irradiance_is_the_closed_form(tmp_path: Path, albedo: float, bounces: int | None) -> None:
    emission = 0.7
    bundle = bake_example(tmp_path, closed_box(albedo, emission, bounces))
    texels = maps(bundle)
    # The scene holds float32, so that is the albedo that was asked about.
    a = float(np.float32(albedo))
    expected = math.pi * float(np.float32(emission)) / (1 - a) * (1 if bounces is None else 1 - a ** (bounces + 1))
    assert abs(texels.mean() / expected - 1) < 1e-3
    assert np.abs(texels / expected - 1).max() < 5e-3


def test_sky_over_a_white_slab(tmp_path: Path) -> None:
    """Albedo 1 under radiance 1: radiance is 1 in every direction, so irradiance is π to the last bit that float32 has."""
    from bake_core.gltf.writer import GlbWriter, Part

    w = GlbWriter()
    square = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float64)
    slab = w.mesh("slab", [Part(square, np.array([[0, 1, 2], [0, 2, 3]]), material=w.material("white", (1, 1, 1), double_sided=True))])
    w.node("slab", mesh=slab)
    spec = {
        "volumes": [{"origin": [-1, -1, -1], "spacing": [1, 0.7, 1], "counts": [3, 3, 3]}],
        "environment": {"kind": "constant", "radiance": [1, 1, 1]},
    }
    texels = maps(bake_example(tmp_path, (w.to_glb(), spec)))
    np.testing.assert_allclose(texels, math.pi, rtol=1e-6)
