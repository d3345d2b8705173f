"""Textures, a smooth metal and an equirectangular sky against Mitsuba 3 itself, where the models of both match.

Set OCTOBAKE_MITSUBA to a Python that has `mitsuba` (3.9) installed, in an environment of its own.
"""

from __future__ import annotations

import math
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.bake import prepare
from bake_core.environment import beside
from bake_core.gltf.reader import load_scene
from bake_core.gltf.writer import GlbWriter, Part, look_at
from bake_core.images import write_exr
from bake_core.picture import path_trace_picture
from bake_core.scene import Camera
from bake_core.spec import parse_spec
from tests.baking import THREADS
from tests.pictures import png

F64 = NDArray[np.float64]
TURN = 0.7
# Independent runs of both, from whose spread noise is known.
RUNS, SAMPLES = 8, 256
WIDTH, HEIGHT = 64, 48
EYE, TARGET, YFOV = (1.5, 1.1, 2.2), (0.1, 0.5, 0.0), 50.0


def sky(direction: F64) -> F64:
    """Smooth, without any symmetry, and with a hazy sun: the same for both whatever either does between its texels."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    sun = 40 * np.exp(((direction @ np.array([0.48, 0.6, 0.64])) - 1) / 0.02)
    return np.stack([0.6 + 0.3 * x + sun, 0.7 + 0.2 * y * z + 0.9 * sun, 1.0 + 0.4 * z * x + 0.7 * sun], -1)


def sky_image(theta: F64, phi: F64) -> NDArray[np.float32]:
    """Of polar angles from +Y, and azimuths from -Z towards +X."""
    t, p = np.meshgrid(theta, phi, indexing="ij")
    return sky(np.stack([np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], -1)).astype(np.float32)


def faceted_sphere(center: tuple[float, float, float], radius: float) -> tuple[F64, NDArray[np.int64]]:
    theta, phi = np.linspace(0, math.pi, 13), np.linspace(0, 2 * math.pi, 25)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], -1).reshape(-1, 3) * radius + center
    a = (np.arange(12)[:, None] * 25 + np.arange(24)).ravel()
    triangles = np.concatenate([np.stack([a, a + 25, a + 1], 1), np.stack([a + 1, a + 25, a + 26], 1)])
    v = points[triangles]
    solid = np.linalg.norm(np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]), axis=1) > 1e-12
    return points, triangles[solid]


def scene(metal: bool) -> tuple[bytes, dict[str, Any]]:
    """A floor with a texture of 8 × 8 texels and a sphere on it: for us, and for Mitsuba."""
    codes = np.random.default_rng(2).integers(30, 250, (8, 8, 3)).astype(np.uint8)
    encoded = codes / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    floor = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]], np.float64)
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float64)
    square = np.array([[0, 1, 2], [0, 2, 3]])
    points, triangles = faceted_sphere((0.1, 0.65, -0.1), 0.6)
    w = GlbWriter()
    color = (1.0, 1.0, 1.0) if metal else (0.7, 0.3, 0.5)
    tiles = w.material("tiles", double_sided=True, base_color_texture=w.texture(png(codes), nearest=True))
    ball = w.material("ball", color, metallic=float(metal), roughness=0.1 if metal else 1.0, double_sided=True)
    w.node("floor", mesh=w.mesh("floor", [Part(floor, square, uvs=[uvs], material=tiles)]))
    w.node("ball", mesh=w.mesh("ball", [Part(points, triangles, material=ball)]))
    # Their rows run from pole to pole, the first texel's left edge is at -Z.
    theirs = {
        "names": np.array(["floor", "ball"]),
        "floor.positions": floor,
        "floor.indices": square,
        "floor.uvs": uvs,
        "floor.texture": linear,
        "ball.positions": points,
        "ball.indices": triangles,
        "ball.uvs": np.zeros((len(points), 2)),
        "ball.color": np.array(color),
        "sky": sky_image(np.linspace(0, math.pi, 512), (np.arange(1024) + 0.5) / 1024 * 2 * math.pi),
        "max_depth": 5,
    }
    if metal:
        # At alpha 0.01 one bounce loses less than 0.1 %, and so what several give back.
        theirs["ball.alpha"] = np.array(0.01)
    return w.to_glb(), theirs


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


def mitsubas(folder: Path, interpreter: str, given: dict[str, Any]) -> F64:
    """The same by Mitsuba."""
    view: dict[str, Any] = {"eye": np.array(EYE), "target": np.array(TARGET), "yfov": YFOV, "size": np.array([HEIGHT, WIDTH])}
    np.savez(folder / "in.npz", samples=np.array(SAMPLES), runs=np.array(RUNS), **view, **given)
    script = Path(__file__).with_name("render_with_mitsuba.py")
    subprocess.run([interpreter, script, folder / "in.npz", folder / "out.npz"], check=True, timeout=600)
    with np.load(folder / "out.npz") as f:
        return np.asarray(f["radiance"], np.float64)


def tiled(picture: F64) -> F64:
    """Means over tiles."""
    means: F64 = picture.reshape(HEIGHT // 16, 16, WIDTH // 16, 16, 3).mean((1, 3))
    return means


@pytest.mark.slow
@pytest.mark.parametrize("metal", [False, True], ids=["diffuse", "metal"])
def test_texture_metal_and_sky(tmp_path: Path, metal: bool) -> None:
    interpreter = os.environ.get("OCTOBAKE_MITSUBA")
    if not interpreter:
        pytest.skip("OCTOBAKE_MITSUBA names no Python with Mitsuba 3 in it")
    glb, given = scene(metal)
    a, b = ours(tmp_path, glb), mitsubas(tmp_path, interpreter, given)
    noise = np.sqrt(a.var(0, ddof=1) / RUNS + b.var(0, ddof=1) / RUNS)
    z = (a.mean(0) - b.mean(0)) / (noise + 1e-3 * b.mean(0))
    # Tiles of 16 × 16 pixels: one shows the sphere, one the sky, others the floor, one with the sphere's own glitter on it.
    level = b.mean((0, 1, 2))
    tiles, bound = np.abs(tiled((a.mean(0) - b.mean(0)) / level)), 4 * np.sqrt(tiled((noise / level) ** 2)) / 16
    report = (
        f"Z has rms {np.sqrt((z**2).mean()):.3f}, {(np.abs(z) > 4).mean():.2%} beyond 4; tiles differ by {tiles.max():.3%} of the mean "
        f"at most, a noise of {bound.max() / 4:.3%} in the noisiest; pictures by {a.mean() / b.mean() - 1:+.3%}"
    )
    print(report)
    assert np.sqrt((z**2).mean()) < 1.25 and (np.abs(z) > 4).mean() < 0.01, report
    assert (tiles < np.maximum(bound, 2e-3)).all() and abs(a.mean() / b.mean() - 1) < 1e-3, report
