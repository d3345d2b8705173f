"""What is glossy and white reflects exactly all of the light: a material of metallic 0 or 1 and base colour 1, of any roughness."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.examples import Example, closed_box
from bake_core.gltf.writer import GlbWriter, Part
from tests.baking import bake_example, maps

ROUGHNESSES = (0.0, 0.05, 0.2, 0.5, 1.0)


def sphere(segments: int = 24) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """A coarse unit sphere, its indices, and its smooth normals: far from its faces', so that shading normals are tested too."""
    theta = np.linspace(0, math.pi, segments // 2 + 1)
    phi = np.linspace(0, 2 * math.pi, segments + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], 2).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(segments // 2), np.arange(segments), indexing="ij")
    a = (row * (segments + 1) + column).ravel()
    b = a + segments + 1
    triangles = np.concatenate([np.stack([a, b, a + 1], 1), np.stack([a + 1, b, b + 1], 1)])
    return points, triangles, points


def white_sphere(metallic: float, roughness: float, segments: int = 24) -> Example:
    """A white sphere under a sky of radiance 1, with probes around it: irradiance is π everywhere, radiance 1."""
    w = GlbWriter()
    points, triangles, normals = sphere(segments)
    material = w.material("white", (1, 1, 1), metallic=metallic, roughness=roughness)
    w.node("sphere", mesh=w.mesh("sphere", [Part(points, triangles, normals=normals, material=material)]))
    spec = {
        "volumes": [{"origin": [-1.2, -1.2, -1.2], "spacing": [2.4, 2.4, 2.4], "counts": [2, 2, 2]}],
        "environment": {"kind": "constant", "radiance": [1, 1, 1]},
        "outputs": ["irradiance", "radiance"],
        "resolution": {"radiance": 16},
        "stop": {"target_error": None, "max_samples": 256},
    }
    return w.to_glb(), spec


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
