"""A small scene with everything that a bake can trace: textures, holes, veils, gloss, a textured lamp, an unlit sign, and a sky."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bake_core.gltf.writer import GlbWriter, Part, look_at
from bake_core.images import write_exr
from tests.pictures import png
from tests.scenes import QUAD

SCENE, SKY = "pavilion.glb", "sky.exr"
# Each corner's, in the order of a quad's corners.
_UVS = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], np.float64)


def pavilion() -> bytes:
    """A floor of 4 × 4 m, a back wall of metal, two instances of a fence that is cut out, a pane that is half there, a lamp and a sign."""
    w = GlbWriter()
    y, x = np.mgrid[0:64, 0:64]
    checker = np.where(((x // 8 + y // 8) % 2)[..., None], [230, 200, 160], [40, 60, 90])
    rough = np.stack([0 * x, 40 + 3 * x, 255 - 2 * y], -1)
    bars = np.stack([0 * x + 120, 0 * x + 160, 0 * x + 90, np.where(x % 16 < 6, 255, 0)], -1)
    glow = np.stack([4 * x, 2 * y, 0 * x + 60], -1)
    tiles = w.transformed(w.texture(png(checker.astype(np.uint8))), scale=[3, 3], rotation=0.3)
    floor = w.material("floor", base_color_texture=tiles)
    metal = w.material("metal", (0.95, 0.9, 0.8), metallic=1.0, metallic_roughness_texture=w.texture(png(rough.astype(np.uint8))))
    fence = w.material("fence", alpha_mode="MASK", double_sided=True, base_color_texture=w.texture(png(bars.astype(np.uint8))))
    pane = w.material("pane", (0.4, 0.6, 0.9), roughness=0.3, alpha=0.5, alpha_mode="BLEND", double_sided=True)
    lamp = w.material("lamp", (0, 0, 0), emission=(12, 12, 12), emissive_texture=w.texture(png(glow.astype(np.uint8))))
    sign = w.material("sign", (0.9, 0.2, 0.1), unlit=True)

    def quad(name: str, corners: Sequence[Sequence[float]], material: int) -> int:
        return w.mesh(name, [Part(np.array(corners, np.float64), QUAD, material=material, uvs=[_UVS])])

    w.node("floor", mesh=quad("floor", [[-2, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]], floor))
    w.node("wall", mesh=quad("wall", [[-2, 2, -2], [-2, 0, -2], [2, 0, -2], [2, 2, -2]], metal))
    rails = quad("fence", [[0, 1, -2], [0, 0, -2], [0, 0, 2], [0, 1, 2]], fence)
    w.node("left", mesh=rails, translation=(-1.9, 0, 0))
    w.node("right", mesh=rails, translation=(1.9, 0, 0), scale=(1, 1.5, 1))
    w.node("pane", mesh=quad("pane", [[-1, 1.5, 0.5], [-1, 0, 0.5], [1, 0, 0.5], [1, 1.5, 0.5]], pane))
    w.node("lamp", mesh=quad("lamp", [[-0.4, 2, -0.4], [0.4, 2, -0.4], [0.4, 2, 0.4], [-0.4, 2, 0.4]], lamp))
    w.node("sign", mesh=quad("sign", [[1, 1.5, -1.9], [1, 1, -1.9], [1.5, 1, -1.9], [1.5, 1.5, -1.9]], sign))
    w.node("sun", light=w.light("directional", (1, 0.9, 0.8), 5.0), matrix=look_at((0, 0, 0), (-0.48, -0.8, -0.36)))
    return w.to_glb()


def write_pavilion(folder: Path) -> Path:
    """Write scene and sky; the scene's path."""
    sky = np.full((16, 32, 3), 0.1, np.float32)
    sky[:8] = [0.4, 0.6, 1.0]
    sky[3, 20] = [300, 270, 220]
    write_exr(folder / SKY, sky, ("R", "G", "B"))
    path = folder / SCENE
    path.write_bytes(pavilion())
    return path


def pavilion_spec(image: str = SKY, probes: tuple[int, int, int] = (3, 3, 3), **more: Any) -> dict[str, Any]:
    """Its spec with all outputs, of exactly 20 samples unless told otherwise; `image` is the sky's name or digest."""
    grid = {"name": "pavilion", "origin": [-1.7, 0.2, -1.6], "spacing": [3.4 / (probes[0] - 1), 0.7, 1.6], "counts": list(probes)}
    return {
        "volumes": [grid],
        "environment": {"kind": "equirect", "image": image, "rotation_y": 0.7, "scale": 1.2},
        "resolution": {"radiance": 16, "distance": 16, "normal": 16, "visibility": 8},
        "stop": {"target_error": None, "max_samples": 20},
        **more,
    }
