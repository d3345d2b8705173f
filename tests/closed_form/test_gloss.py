"""What is glossy and white reflects exactly all of the light: a material of metallic 0 or 1 and base colour 1, of any roughness."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bake_core.examples import closed_box
from bake_core.stability.materials import white_sphere
from tests.baking import bake_example, maps

ROUGHNESSES = (0.0, 0.05, 0.2, 0.5, 1.0)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_a_white_sphere_cannot_be_seen_under_a_white_sky(tmp_path: Path, metallic: float, roughness: float) -> None:
    bundle = bake_example(tmp_path, white_sphere(metallic, roughness))
    irradiance, radiance = maps(bundle), maps(bundle, "radiance")
    assert abs(irradiance.mean() / math.pi - 1) < 1e-3
    assert np.abs(irradiance / math.pi - 1).max() < 5e-3
    assert abs(radiance.mean() - 1) < 1e-3


@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.05), (0.0, 0.5), (1.0, 0.05), (1.0, 0.5), (1.0, 1.0)])
def test_a_closed_white_box_with_some_bounces(tmp_path: Path, metallic: float, roughness: float) -> None:
    """Walls of reflectance 1 that emit Le: after k bounces π·Le·(k + 1)."""
    example = closed_box(1.0, 0.7, 3, metallic=metallic, roughness=roughness)
    bundle = bake_example(tmp_path, example, resolution={"radiance": 16}, outputs=["irradiance"])
    expected = math.pi * float(np.float32(0.7)) * 4
    texels = maps(bundle)
    assert abs(texels.mean() / expected - 1) < 2e-3
    assert np.abs(texels / expected - 1).max() < 2e-2
