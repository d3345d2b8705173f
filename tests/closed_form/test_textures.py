"""Textures, holes and textured emitters against what they must add up to."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.gltf.writer import GlbWriter, Part
from bake_core.octahedral import texel_directions
from bake_core.texture_tables import srgb_to_linear
from tests.baking import bake_example, maps
from tests.pictures import png

FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
FLOOR = np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
CEILING = FLOOR[::-1]


def square(w: GlbWriter, name: str, corners: NDArray[np.float64], material: int, repeat: float = 1, **more: Any) -> None:
    w.node(name, mesh=w.mesh(name, [Part(corners, FACES, material=material, uvs=[UV * repeat], **more)]))


def probe(at: list[float], **more: Any) -> dict[str, Any]:
    return {
        "volumes": [{"origin": at, "spacing": [1, 1, 1], "counts": [1, 1, 1]}],
        "stop": {"target_error": None, "max_samples": 256},
        **more,
    }


def checker(n: int, low: int, high: int) -> NDArray[np.uint8]:
    pattern = np.indices((n, n)).sum(0) % 2
    return np.where(pattern, high, low).astype(np.uint8)[..., None].repeat(3, 2)


def bake(folder: Path, w: GlbWriter, spec: dict[str, Any], **more: Any) -> NDArray[np.float64]:
    folder.mkdir(exist_ok=True)
    return maps(bake_example(folder, (w.to_glb(), spec), **more))


def stripes(holes: int, of: int) -> bytes:
    """An image whose first `holes` columns of `of` are cut out."""
    pixels = np.zeros((1, of, 4), np.uint8)
    pixels[:, holes:, 3] = 255
    return png(pixels)


def screen(w: GlbWriter, kind: str) -> tuple[int, dict[str, Any]]:
    """A black material that lets a quarter of the light through, and what its vertices need for that."""
    black: dict[str, Any] = {"base_color": (0, 0, 0), "double_sided": True}
    if kind == "mask":
        return w.material(kind, alpha_mode="MASK", base_color_texture=w.texture(stripes(1, 4), nearest=True), **black), {}
    if kind == "blend":
        return w.material(kind, alpha_mode="BLEND", alpha=0.75, **black), {}
    colors = np.ones((4, 4))
    colors[:, 3] = 0.9375
    return w.material(kind, alpha_mode="BLEND", alpha=0.8, **black), {"colors": colors}


@pytest.mark.parametrize("kind", ["mask", "blend", "blend by vertices"])
def test_a_screen_lets_a_quarter_through_to_the_eye(tmp_path: Path, kind: str) -> None:
    """Under a wide screen and an emissive ceiling of radiance 1, irradiance from above is π/4."""
    w = GlbWriter()
    square(w, "lamp", CEILING * 400 + [0, 2, 0], w.material("lamp", (0, 0, 0), emission=(1, 1, 1)))
    material, more = screen(w, kind)
    square(w, "screen", FLOOR * 300 + [0, 1, 0], material, 4000, **more)
    # At 256 samples, whether rays pass is left to chance by 1.2 % of irradiance.
    texels = bake(tmp_path, w, probe([0.1, 0.7, 0.1], stop={"target_error": None, "max_samples": 4096}))
    up = texel_directions(8).reshape(-1, 3)[:, 1]
    best = int(np.argmax(up))
    # A tilted texel sees (1 + cosθ)/2 of the plane.
    assert texels.reshape(-1, 3)[best] == pytest.approx([math.pi / 4 * (1 + up[best]) / 2] * 3, rel=0.01)


@pytest.mark.parametrize("kind", ["mask", "blend", "blend by vertices"])
def test_a_screen_lets_a_quarter_of_the_sun_through(tmp_path: Path, kind: str) -> None:
    """A floor of albedo a under a screen under a sun of irradiance E reflects a·E/4 to a probe between them."""
    w = GlbWriter()
    square(w, "floor", FLOOR * 300, w.material("floor", (0.5, 0.5, 0.5)))
    material, more = screen(w, kind)
    square(w, "screen", FLOOR * 400 + [0, 1, 0], material, 4000, **more)
    sun = {"kind": "directional", "direction": [0, -1, 0], "irradiance": [3, 3, 3]}
    # Of the quarter that one in four rays makes, 200,000 of them know 0.4 %.
    texels = bake(tmp_path, w, probe([0.1, 0.5, 0.1], lights=[sun], stop={"target_error": None, "max_samples": 2048}))
    down = texel_directions(8).reshape(-1, 3)[:, 1]
    worst = int(np.argmin(down))
    assert texels.reshape(-1, 3)[worst] == pytest.approx([0.5 * 3 / 4 * (1 - down[worst]) / 2] * 3, rel=0.015)


def test_an_unlit_checker_is_its_mean_in_linear_light(tmp_path: Path) -> None:
    """Codes 40 and 220 average to the mean of what they decode to, not to what their mean decodes to."""
    w = GlbWriter()
    texture = w.texture(png(checker(64, 40, 220)), nearest=True)
    square(w, "sign", CEILING * 300 + [0, 1, 0], w.material("sign", (0.5, 1, 1), unlit=True, base_color_texture=texture), 100)
    texels = bake(tmp_path, w, probe([0, 0, 0]))
    mean = srgb_to_linear(np.array([40, 220]) / 255).mean() * math.pi
    up = texel_directions(8).reshape(-1, 3)[:, 1]
    best = int(np.argmax(up))
    share = (1 + up[best]) / 2
    assert texels.reshape(-1, 3)[best] == pytest.approx([mean / 2 * share, mean * share, mean * share], rel=0.01)


def test_a_checkered_floor_reflects_its_mean(tmp_path: Path) -> None:
    w = GlbWriter()
    texture = w.texture(png(checker(32, 0, 255)))
    square(w, "floor", FLOOR * 300, w.material("floor", base_color_texture=texture), 300)
    texels = bake(tmp_path, w, probe([0, 1, 0], lights=[{"kind": "directional", "direction": [0, -1, 0], "irradiance": [2, 2, 2]}]))
    down = texel_directions(8).reshape(-1, 3)[:, 1]
    worst = int(np.argmin(down))
    assert texels.reshape(-1, 3)[worst] == pytest.approx([0.5 * 2 * (1 - down[worst]) / 2] * 3, rel=0.01)


@pytest.mark.parametrize("slot", ["base_color_texture", "metallic_roughness_texture", "emissive_texture"])
def test_a_texture_of_one_color_is_a_factor(tmp_path: Path, slot: str) -> None:
    """The same samples, so the same answer but for rounding."""
    codes = np.array([255, 128, 64], np.uint8)
    linear = srgb_to_linear(codes / 255)

    def scene(textured: bool) -> NDArray[np.float64]:
        w = GlbWriter()
        look: dict[str, Any]
        if textured:
            look = {slot: w.texture(png(np.broadcast_to(codes, (4, 4, 3)))), "metallic": 1.0 if slot.startswith("metal") else 0.0}
            look |= {"emission": (2, 2, 2)} if slot == "emissive_texture" else {}
        elif slot == "base_color_texture":
            look = {"base_color": linear.tolist()}
        elif slot == "emissive_texture":
            look = {"emission": (2 * linear).tolist()}
        else:
            look = {"metallic": 64 / 255, "roughness": 128 / 255}
        square(w, "floor", FLOOR, w.material("floor", **({"base_color": (0.5, 0.5, 0.5)} if slot != "base_color_texture" else {}) | look))
        square(w, "lamp", CEILING + [0, 2, 0], w.material("lamp", emission=(1, 1, 1)))
        spec = probe([0.2, 1, 0.1], outputs=["irradiance"], resolution={"radiance": 16})
        return bake(tmp_path / str(textured), w, {**spec, "stop": {"target_error": None, "max_samples": 16}})

    np.testing.assert_allclose(scene(True), scene(False), rtol=2e-4, atol=1e-6)


@pytest.mark.parametrize("how", ["texture", "mask"])
def test_a_half_black_emitter_is_half_an_emitter(tmp_path: Path, how: str) -> None:
    """An emitter whose texture, or what is left of it, is bright on one side only, against a smaller one: seen directly and by a floor."""

    def scene(whole: bool) -> NDArray[np.float64]:
        w = GlbWriter()
        square(w, "floor", FLOOR * 3, w.material("floor", (0.8, 0.8, 0.8)))
        corners = CEILING + [0.3, 1.5, 0.2]
        if not whole:
            square(w, "lamp", corners, w.material("lamp", (0, 0, 0), emission=(5, 4, 3)))
        else:
            # The outer three quarters of a square twice as large are dark.
            pixels = np.zeros((4, 4, 4), np.uint8)
            pixels[1:3, 1:3] = 255
            texture = w.texture(png(pixels), nearest=True)
            slot: dict[str, Any] = {"emissive_texture": texture}
            if how == "mask":
                slot = {"base_color_texture": texture, "alpha_mode": "MASK"}
            big = (CEILING * 2) + [0.3, 1.5, 0.2]
            square(w, "lamp", big, w.material("lamp", (0, 0, 0), emission=(5, 4, 3), **slot))
        return bake(tmp_path / str(whole), w, probe([0, 0.5, 0]))

    np.testing.assert_allclose(scene(True), scene(False), rtol=0.02, atol=0.02)


def test_unlit_is_emission_times_vertex_color(tmp_path: Path) -> None:
    def scene(unlit: bool) -> NDArray[np.float64]:
        w = GlbWriter()
        square(w, "floor", FLOOR * 3, w.material("floor", (0.8, 0.8, 0.8)))
        if unlit:
            look, colors = w.material("sign", (1, 0.5, 0.25), unlit=True), np.full((4, 3), 0.5)
            square(w, "sign", CEILING + [0, 2, 0], look, colors=colors)
        else:
            square(w, "sign", CEILING + [0, 2, 0], w.material("sign", (0, 0, 0), emission=(0.5, 0.25, 0.125)))
        return bake(tmp_path / str(unlit), w, probe([0.1, 1, 0]), stop={"target_error": None, "max_samples": 16})

    np.testing.assert_allclose(scene(True), scene(False), rtol=1e-5)


def test_holes_are_the_same_on_any_number_of_threads(tmp_path: Path) -> None:
    w = GlbWriter()
    material, more = screen(w, "blend")
    square(w, "screen", FLOOR, material, **more)
    square(w, "lamp", CEILING + [0, 1, 0], w.material("lamp", emission=(1, 1, 1)))
    example = (w.to_glb(), probe([0, -0.5, 0], stop={"target_error": None, "max_samples": 8}))
    for threads in (1, 3):
        (tmp_path / str(threads)).mkdir()
        bake_example(tmp_path / str(threads), example, threads=threads, shards=threads)
    names = sorted(p.name for p in (tmp_path / "1" / "bundle").rglob("*.exr"))
    assert names
    for name in names:
        assert (tmp_path / "1" / "bundle" / name).read_bytes() == (tmp_path / "3" / "bundle" / name).read_bytes()
