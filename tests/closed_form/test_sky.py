"""Irradiance under an image of the sky: the sum over its texels, however small its sun is."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.bundle import Bundle
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.images import write_exr
from bake_core.octahedral import texel_directions
from tests.baking import bake_example, maps

HEIGHT, WIDTH = 64, 128
ROW, COLUMN = 20, 90


def sun(background: float = 0.0) -> NDArray[np.float32]:
    """One bright texel, 1/10,000 of the sphere."""
    texels = np.full((HEIGHT, WIDTH, 3), background, np.float32)
    texels[ROW, COLUMN] = (9000, 8000, 7000)
    return texels


def sun_direction(turn: float) -> NDArray[np.float64]:
    theta, phi = (ROW + 0.5) * math.pi / HEIGHT, ((COLUMN + 0.5) / WIDTH - 0.5) * 2 * math.pi - turn
    return np.array([math.sin(theta) * math.sin(phi), math.cos(theta), -math.sin(theta) * math.cos(phi)])


def sun_solid_angle() -> float:
    return (math.cos(ROW * math.pi / HEIGHT) - math.cos((ROW + 1) * math.pi / HEIGHT)) * 2 * math.pi / WIDTH


def bake_plane(folder: Path, texels: NDArray[np.float32], albedo: float, **spec: Any) -> Bundle:
    """A plane of 200 m, a probe 1 m above it."""
    write_exr(folder / "sky.exr", texels, ("R", "G", "B"))
    w = GlbWriter()
    plane = np.array([[-100, 0, 100], [100, 0, 100], [100, 0, -100], [-100, 0, -100]], np.float64)
    part = Part(plane, np.array([[0, 1, 2], [0, 2, 3]]), material=w.material("plane", (albedo,) * 3))
    w.node("plane", mesh=w.mesh("plane", [part]))
    document = {
        "volumes": [{"origin": [0, 1, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}],
        "environment": {"kind": "equirect", "image": "sky.exr", "rotation_y": 0.4},
        "stop": {"target_error": None, "max_samples": 64},
    }
    return bake_example(folder, (w.to_glb(), document), **spec)


def test_a_small_sun_is_no_noise(tmp_path: Path) -> None:
    """Where the plane does not see the probe: straight light of a sun of 0.02 rad, within what the sun's own width costs."""
    normals = texel_directions(8).reshape(-1, 3)
    cosine = normals @ sun_direction(0.4)
    irradiance = maps(bake_plane(tmp_path, sun(), 0.0)).reshape(-1, 3)
    expected = np.maximum(cosine, 0)[:, None] * sun_solid_angle() * np.array([9000, 8000, 7000])
    facing = cosine > 0.1
    np.testing.assert_allclose(irradiance[facing], expected[facing], rtol=3e-3)
    # Where a normal's horizon cuts the sun's capture texel, its exact cosine and its samples' differ, by what their number leaves.
    assert np.abs(irradiance[cosine < -0.1]).max() < 1e-5 * expected.max()


def test_a_plane_under_a_small_sun(tmp_path: Path) -> None:
    """The plane's radiance is a E / π, and what faces it gets a E: every vertex draws the sun as a light."""
    bundle = bake_plane(tmp_path, sun(), 0.5, max_bounces=1, resolution={"irradiance": 16})
    irradiance = maps(bundle)[0]
    normals = texel_directions(16)
    down = irradiance[normals[..., 1] < -0.9]
    share = (1 - normals[normals[..., 1] < -0.9][:, 1]) / 2
    sun_below = np.maximum(normals[normals[..., 1] < -0.9] @ sun_direction(0.4), 0)
    assert not sun_below.any()
    expected = 0.5 * sun_direction(0.4)[1] * sun_solid_angle() * 9000
    np.testing.assert_allclose(down[:, 0], expected * share, rtol=5e-3)


@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 1.0), (1.0, 0.1), (0.0, 0.3)])
def test_an_even_image_is_a_constant_sky(tmp_path: Path, metallic: float, roughness: float) -> None:
    """A white sphere under an image of ones: sampled as lights and by reflection, π all the same."""
    from bake_core.stability.materials import white_sphere

    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3), np.float32), ("R", "G", "B"))
    bundle = bake_example(tmp_path, white_sphere(metallic, roughness), environment={"kind": "equirect", "image": "sky.exr"})
    assert abs(maps(bundle).mean() / math.pi - 1) < 1e-3
    assert abs(maps(bundle, "radiance").mean() - 1) < 2e-3
    assert bundle.manifest["spec"]["environment"]["image"].startswith("sha256:")


def test_the_same_image_elsewhere_is_the_same_bake(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one = bake_plane(tmp_path / "a", sun(0.2), 0.5, stop={"target_error": None, "max_samples": 4})
    two = bake_plane(tmp_path / "b", sun(0.2), 0.5, stop={"target_error": None, "max_samples": 4}, threads=1)
    assert one.manifest == two.manifest
