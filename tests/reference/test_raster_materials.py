"""Textures, holes, gloss and unlit surfaces in the rasterised picture: closed forms, and small pictures beside the path tracer's."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.gltf.writer import CLAMP, MIRRORED, REPEAT, GlbWriter, Part
from bake_core.scene import Scene
from tests.pictures import png
from tests.reference.small_pictures import QUAD, SQUARE, both, constant_volume, eye, raster, scene_of, spec_of

CORNERS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float64)
BLACK = constant_volume((0, 0, 0))


def floor(folder: Path, material: dict[str, Any], *, size: float = 2.0, texture: NDArray[Any] | None = None, **how: Any) -> Scene:
    """A square on the ground; `texture` fills the slot that `how` names, with the rest of `how` for the sampler and the square."""
    w = GlbWriter()
    slot, repeat, colors = how.pop("slot", "base_color_texture"), how.pop("repeat", 1.0), how.pop("colors", None)
    look = dict(material)
    if texture is not None:
        look[slot] = w.transformed(w.texture(png(texture), **how), scale=[repeat, repeat], rotation=0.3, offset=[0.1, 0.2])
    part = Part(SQUARE * size, QUAD, colors=colors, uvs=[CORNERS], material=w.material("floor", **look))
    w.node(mesh=w.mesh("floor", [part]))
    return scene_of(folder, w)


def checks(rng: np.random.Generator, side: int = 8) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (side, side, 4), np.uint8)


@pytest.mark.parametrize("metallic", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.7, 1.0])
def test_white_reflects_all_of_even_light(tmp_path: Path, metallic: float, roughness: float) -> None:
    """Whatever the finish: its diffuse and its specular part add up to 1."""
    scene = floor(tmp_path, {"metallic": metallic, "roughness": roughness}, size=30)
    picture = raster(scene, spec_of(), eye((0, 1, 0), (0, 0.2, -2)), constant_volume((math.pi, 2 * math.pi, 1)))
    lit = picture.hit == 1
    np.testing.assert_allclose(picture.indirect[lit], np.broadcast_to([1, 2, 1 / math.pi], (int(lit.sum()), 3)), rtol=2e-3)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.15, 0.5, 1.0])
def test_a_gloss_under_a_lamp_is_the_path_tracers(tmp_path: Path, metallic: float, roughness: float) -> None:
    """One light is the whole of direct light, so the path tracer's pictures have no noise but what filters a pixel's area."""
    scene = floor(tmp_path, {"base_color": (0.9, 0.5, 0.1), "metallic": metallic, "roughness": roughness})
    lamp = {"kind": "point", "position": [0.5, 1.2, -0.6], "intensity": [3, 3, 3]}
    # The sharpest highlight is a few pixels wide: as many frames as paths, so that what is left is the formulas'.
    picture, traced = both(scene, spec_of([lamp]), eye((0, 0.8, 2.2), (0, 0, 0)), frames=256)
    full = (picture.hit == 1) & (traced.hit == 1)
    np.testing.assert_allclose(picture.direct[full], traced.direct[full], rtol=0.02, atol=0.002 * float(traced.direct.max()))


@pytest.mark.parametrize("nearest", [False, True], ids=["linear", "nearest"])
@pytest.mark.parametrize("wrap", [REPEAT, MIRRORED, CLAMP])
@pytest.mark.parametrize("slot", ["base_color_texture", "metallic_roughness_texture", "emissive_texture"])
def test_a_texture_is_looked_up_as_the_path_tracer_does(tmp_path: Path, slot: str, wrap: int, nearest: bool) -> None:
    material = {"metallic": 0.5, "roughness": 0.9, "emission": (4, 5, 6) if slot == "emissive_texture" else (0, 0, 0)}
    pixels = checks(np.random.default_rng(3))
    scene = floor(tmp_path, material, texture=pixels, slot=slot, repeat=3.0, wrap=(wrap, REPEAT), nearest=nearest)
    sun = {"kind": "directional", "direction": [0.3, -1, 0.2], "irradiance": [3, 3, 3]}
    picture, traced = both(scene, spec_of([sun]), eye((0, 2, 2.2), (0, 0, 0)), samples=64)
    for part in ("emission", "direct"):
        a, b = getattr(picture, part), getattr(traced, part)
        # Edges of texels and of coarser levels fall elsewhere among 16 samples than among 64.
        assert np.abs(a - b).mean() <= 0.01 * b.max(), part
        assert (np.abs(a - b).max(-1) > 0.1 * b.max()).mean() < 0.02, part


def test_minified_textures_are_averages(tmp_path: Path) -> None:
    """A fine checker of black and white far away is even: the mean in linear light."""
    pixels = np.full((256, 256, 4), 255, np.uint8)
    pixels[..., :3] = 255 * (np.indices((256, 256)).sum(0) % 2)[..., None]
    scene = floor(tmp_path, {}, size=20, texture=pixels, repeat=40.0)
    picture = raster(scene, spec_of(), eye((0, 15, 15), (0, 0, 0)), constant_volume((math.pi,) * 3))
    inside = picture.indirect[picture.hit == 1]
    np.testing.assert_allclose(inside, 0.5, atol=0.02)


def test_what_is_cut_out_is_a_hole_for_eyes_and_for_light(tmp_path: Path) -> None:
    """A masked sheet above a floor: seen through, and shone through, where the path tracer does."""
    pixels = np.full((16, 16, 4), 255, np.uint8)
    pixels[..., 3] = 255 * np.kron([[1, 0, 1, 0], [0, 1, 1, 0], [0, 1, 0, 1], [1, 1, 0, 0]], np.ones((4, 4)))
    w = GlbWriter()
    leaf = w.material(
        "leaf", (0.2, 0.8, 0.1), alpha_mode="MASK", double_sided=True, base_color_texture=w.texture(png(pixels), nearest=True)
    )
    w.node(mesh=w.mesh("sheet", [Part(SQUARE + [0, 0.6, 0], QUAD, uvs=[CORNERS], material=leaf)]))
    w.node(mesh=w.mesh("floor", [Part(SQUARE * 2, QUAD, material=w.material("floor"))]))
    sun = {"kind": "directional", "direction": [0.4, -1, 0.3], "irradiance": [3, 2, 1]}
    picture, traced = both(scene_of(tmp_path, w), spec_of([sun]), eye((0.5, 1.6, 3), (0, 0.3, 0)))
    assert np.abs(picture.hit - traced.hit).mean() < 2e-3
    assert picture.direct.mean() == pytest.approx(traced.direct.mean(), rel=0.01)
    assert (np.abs(picture.direct - traced.direct).max(-1) > 0.1 * traced.direct.max()).mean() < 0.04


@pytest.mark.parametrize("sheets", [1, 2])
@pytest.mark.parametrize("alpha", [0.25, 0.6])
def test_what_is_blended_is_there_by_its_alpha(tmp_path: Path, alpha: float, sheets: int) -> None:
    """Sheets that fill the picture, one behind the other: 1 - (1 - alpha)^n of the rays meet any."""
    w = GlbWriter()
    # The factor times the vertices' own.
    glass = w.material("glass", alpha=0.8, alpha_mode="BLEND", double_sided=True)
    veil = np.column_stack([np.ones((4, 3)), np.full(4, alpha / 0.8)])
    for i in range(sheets):
        # Looked at away from the diagonal, where two triangles with thresholds of their own share pixels.
        w.node(mesh=w.mesh("sheet", [Part(SQUARE * 9 + [0.3 * i, -0.2 * i, 0.5 * i], QUAD, colors=veil, material=glass)]))
    hit = raster(scene_of(tmp_path, w), spec_of(), eye((4, 3, 4), (4, 0, 3.9)), BLACK).hit
    expected = 1 - (1 - alpha) ** sheets
    if sheets == 1:
        # One surface's thresholds are even steps, so every pixel knows its alpha to one of 16 frames.
        assert np.abs(hit - expected).max() <= 1 / 16
    # Of two, each pixel pairs steps at random: at most as uneven as 16 coins, over 96 × 54 pixels. Four standard errors.
    assert hit.mean() == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / 16 / hit.size))


def test_a_blended_sheet_shades_by_its_alpha(tmp_path: Path) -> None:
    w = GlbWriter()
    glass = w.material("glass", alpha=0.5, alpha_mode="BLEND", double_sided=True)
    w.node(mesh=w.mesh("sheet", [Part(SQUARE * 0.8 + [0, 1.2, 0], QUAD, material=glass)]))
    w.node(mesh=w.mesh("floor", [Part(SQUARE * 2, QUAD, material=w.material("floor"))]))
    sun = {"kind": "directional", "direction": [0, -1, 0], "irradiance": [math.pi] * 3}
    # From below the sheet.
    picture, traced = both(scene_of(tmp_path, w), spec_of([sun]), eye((0, 0.9, 1.8), (0, 0, 0.2)))
    under = (traced.hit == 1) & (np.abs(traced.direct[..., 0] - 0.5) < 0.15)
    assert under.sum() > 100
    assert picture.direct[under].mean() == pytest.approx(0.5, abs=0.03)


def test_unlit_surfaces_show_their_colour(tmp_path: Path) -> None:
    colors = np.tile([0.5, 1.0, 0.25, 1.0], (4, 1))
    scene = floor(tmp_path, {"base_color": (0.8, 0.4, 0.2), "unlit": True}, colors=colors, size=20)
    sun = {"kind": "directional", "direction": [0, -1, 0], "irradiance": [1, 1, 1]}
    picture = raster(scene, spec_of([sun]), eye((0, 1, 0), (0, 0, -0.5)), constant_volume((1, 1, 1)))
    np.testing.assert_allclose(picture.emission, np.broadcast_to([0.4, 0.4, 0.05], picture.emission.shape), rtol=1e-5)
    assert not picture.direct.any() and not picture.indirect.any()
