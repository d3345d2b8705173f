"""Glossy light that is traced through a bundle, in the verification's picture and along single rays: furnaces, and a mirror's picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bake_core.examples import closed_box, glossy_cornell
from bake_core.scene import Camera
from bake_core.scene_files import load_scene
from bake_core.verification import verify
from tests.baking import THREADS, bake_example

STOP = {"target_error": None, "max_samples": 16}
SIDES = {"radiance": 16, "distance": 32, "normal": 32}


@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_a_furnace_of_metal_shows_itself(roughness: float, tmp_path: Path) -> None:
    """Walls emit 1 and there is no bounce: every ray brings 1, and the picture shows what the metal reflects, whatever its finish."""
    bundle = bake_example(tmp_path, closed_box(0.5, 1.0, 0, metallic=1.0, roughness=roughness), stop=STOP, resolution=SIDES)
    matrix = np.eye(4)
    matrix[:3, 3] = (0.1, 0.2, 0.8)
    camera = Camera("inside", matrix, 1.2)
    report = verify(
        bundle, load_scene(tmp_path / "scene.glb"), [camera], tmp_path / "out", width=32, height=18, samples=16, threads=THREADS
    )
    assert report["cameras"][0]["indirect"]["mean_ratio"] == pytest.approx(1, abs=0.02)
    assert report["glossy"]["mean"] == pytest.approx(1, rel=1e-3)
    assert report["glossy"]["mean_ratio"] == pytest.approx(1, abs=0.02)
    assert report["glossy"]["rays"]["agree"] > 0.99
    assert "Radiance along" in (tmp_path / "out" / "index.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.0, 0.35])
def test_metal_in_a_cornell_box(roughness: float, tmp_path: Path) -> None:
    """Rays meet what they should, and bring what they should in the mean; what is blurred is as wide as a texel of radiance."""
    stop = {"target_error": None, "max_samples": 64}
    bundle = bake_example(tmp_path, glossy_cornell(roughness), stop=stop, resolution={"radiance": 32})
    report = verify(bundle, load_scene(tmp_path / "scene.glb"), None, tmp_path / "out", width=128, height=96, samples=64, threads=THREADS)
    assert report["cameras"][0]["indirect"]["mean_ratio"] == pytest.approx(1, abs=0.05)
    assert report["glossy"]["mean_ratio"] == pytest.approx(1, abs=0.05)
    assert report["glossy"]["rays"]["agree"] > 0.97
