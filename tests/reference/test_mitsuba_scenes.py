"""Textures, a smooth metal and an equirectangular sky against pictures by Mitsuba 3, where the models of both match."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.environment import beside
from bake_core.gltf.reader import load_scene
from bake_core.gltf.writer import look_at
from bake_core.images import write_exr
from bake_core.picture import path_trace_picture
from bake_core.prepared import prepare
from bake_core.scene import Camera
from bake_core.spec import parse_spec
from tests.baking import THREADS
from tests.reference.mitsuba_scenes import EYE, HEIGHT, RUNS, SAMPLES, TARGET, WIDTH, YFOV, reference, scene, sky_image

F64 = NDArray[np.float64]
TURN = 0.7


def ours(folder: Path, glb: bytes) -> F64:
    """(RUNS, HEIGHT, WIDTH, 3)."""
    (folder / "scene.glb").write_bytes(glb)
    theta, phi = (np.arange(512) + 0.5) / 512 * math.pi, ((np.arange(1024) + 0.5) / 1024 - 0.5) * 2 * math.pi
    # A sky turned by an angle about +Y holds at azimuth φ what the world sees at φ - angle.
    write_exr(folder / "sky.exr", sky_image(theta, phi - TURN), ("R", "G", "B"))
    document = {
        "volumes": [{"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}],
        "environment": {"kind": "equirect", "image": "sky.exr", "rotation_y": TURN},
    }
    tracer = prepare(load_scene(folder / "scene.glb"), parse_spec(document), beside(folder)).tracer
    camera = Camera("", look_at(EYE, TARGET), math.radians(YFOV))
    pictures = [
        path_trace_picture(tracer, camera, WIDTH, HEIGHT, samples=SAMPLES, seed=run, max_bounces=4, threads=THREADS).whole
        for run in range(RUNS)
    ]
    return np.stack(pictures).astype(np.float64)


def tiled(picture: F64) -> F64:
    """Means over tiles."""
    means: F64 = picture.reshape(HEIGHT // 16, 16, WIDTH // 16, 16, 3).mean((1, 3))
    return means


@pytest.mark.slow
@pytest.mark.parametrize("metal", [False, True], ids=["diffuse", "metal"])
def test_texture_metal_and_sky(tmp_path: Path, metal: bool) -> None:
    runs = ours(tmp_path, scene(metal)[0])
    with np.load(reference(metal)) as f:
        b, variance = f["mean"].astype(np.float64), f["variance"].astype(np.float64)
    a = runs.mean(0)
    noise = np.sqrt(runs.var(0, ddof=1) / RUNS + variance)
    z = (a - b) / (noise + 1e-3 * b)
    # Tiles of 16 × 16 pixels: one shows the sphere, one the sky, others the floor, one with the sphere's own glitter on it.
    level = b.mean((0, 1))
    tiles, bound = np.abs(tiled((a - b) / level)), 4 * np.sqrt(tiled((noise / level) ** 2)) / 16
    report = (
        f"Z has rms {np.sqrt((z**2).mean()):.3f}, {(np.abs(z) > 4).mean():.2%} beyond 4; tiles differ by {tiles.max():.3%} of the mean "
        f"at most, a noise of {bound.max() / 4:.3%} in the noisiest; pictures by {a.mean() / b.mean() - 1:+.3%}"
    )
    print(report)
    assert np.sqrt((z**2).mean()) < 1.25 and (np.abs(z) > 4).mean() < 0.01, report
    assert (tiles < np.maximum(bound, 2e-3)).all() and abs(a.mean() / b.mean() - 1) < 1e-3, report
