"""Scenes for us and for Mitsuba 3, where the models of both match, and what Mitsuba makes of them.

`python -m tests.reference.mitsuba_scenes PYTHON` renders them anew, by a Python that has `mitsuba` (3.9.1) installed in an environment of
its own, into the files that tests read.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.gltf.writer import GlbWriter, Part
from tests.pictures import png

F64 = NDArray[np.float64]
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


def mitsubas(folder: Path, interpreter: str, given: dict[str, Any]) -> F64:
    """The same by Mitsuba."""
    view: dict[str, Any] = {"eye": np.array(EYE), "target": np.array(TARGET), "yfov": YFOV, "size": np.array([HEIGHT, WIDTH])}
    np.savez(folder / "in.npz", samples=np.array(SAMPLES), runs=np.array(RUNS), **view, **given)
    script = Path(__file__).with_name("render_with_mitsuba.py")
    subprocess.run([interpreter, script, folder / "in.npz", folder / "out.npz"], check=True, timeout=600)
    with np.load(folder / "out.npz") as f:
        return np.asarray(f["radiance"], np.float64)


def reference(metal: bool) -> Path:
    """Where Mitsuba's picture lies: `mean` (h, w, 3) and `variance`, that of the mean, both float32."""
    return Path(__file__).with_name(f"mitsuba_{'metal' if metal else 'diffuse'}.npz")


def record(interpreter: str) -> None:
    """Render all references."""
    for metal in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            runs = mitsubas(Path(folder), interpreter, scene(metal)[1])
        mean, variance = runs.mean(0).astype(np.float32), (runs.var(0, ddof=1) / RUNS).astype(np.float32)
        np.savez_compressed(reference(metal), mean=mean, variance=variance)


if __name__ == "__main__":
    record(sys.argv[1])
