"""Texture look-up against numpy: codes, pyramids, wrap modes, filters, transforms, levels."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.gltf.writer import CLAMP, MIRRORED, REPEAT, GlbWriter, Part
from bake_core.kernels import entry_kernel
from bake_core.scene import Image, Scene
from bake_core.texture_tables import TextureTable, linear_to_srgb, pyramid, srgb_to_linear, texture_table
from bake_core.textures import look_up, sample_alpha, sample_texture
from tests.pictures import png
from tests.unit.gltf_build import load_glb

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
CORNERS = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
FACES = [0, 1, 2, 0, 2, 3]


@entry_kernel
def look(x: Any, k: int, u: Any, v: Any, level: int, out: Any) -> None:
    for i in range(u.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = sample_texture(x, k, u[i], v[i], level)
        out[i, 3] = sample_alpha(x, k, u[i], v[i])


@entry_kernel
def look_at_triangle(x: Any, k: int, triangle: int, b1: float, b2: float, share: float, out: Any) -> None:
    out[0], out[1], out[2] = look_up(x, k, triangle, b1, b2, share)


def sampled(table: TextureTable, uv: NDArray[np.float64], k: int = 0, level: int = 0) -> NDArray[np.float64]:
    out = np.zeros((len(uv), 4))
    look(table, k, np.ascontiguousarray(uv[:, 0]), np.ascontiguousarray(uv[:, 1]), level, out)
    return out


def textured(
    folder: Path, pixels: NDArray[Any], *, slot: str = "base_color_texture", info: dict[str, Any] | None = None, **sampler: Any
) -> Scene:
    w = GlbWriter()
    texture = w.texture(png(pixels), **sampler)
    if info:
        texture = w.transformed(texture, **info)
    look: dict[str, Any] = {slot: texture, **({"emission": (1, 1, 1)} if slot == "emissive_texture" else {})}
    material = w.material("m", **look)
    w.node(mesh=w.mesh("square", [Part(SQUARE, FACES, uvs=[CORNERS], material=material)]))
    return load_glb(w.to_glb(), folder)


def table_of(scene: Scene) -> TextureTable:
    table = texture_table(scene)
    assert table is not None
    return table


def noise(width: int, height: int, dtype: Any = np.uint8, channels: int = 4) -> NDArray[Any]:
    return np.random.default_rng(width * 1000 + height).integers(0, np.iinfo(dtype).max, (height, width, channels), dtype, endpoint=True)


def wrapped(i: NDArray[np.int64], n: int, mode: int) -> NDArray[np.int64]:
    if mode == REPEAT:
        return np.mod(i, n)
    if mode == CLAMP:
        return np.clip(i, 0, n - 1)
    # A triangle wave, as a list of what the image and its mirror image hold.
    return np.concatenate([np.arange(n), np.arange(n)[::-1]])[np.mod(i, 2 * n)]


def reference(linear: NDArray[np.float64], uv: NDArray[np.float64], wrap: tuple[int, int], nearest: bool) -> NDArray[np.float64]:
    height, width = linear.shape[:2]
    x, y = uv[:, 0] * width, uv[:, 1] * height
    if nearest:
        return linear[wrapped(np.floor(y).astype(int), height, wrap[1]), wrapped(np.floor(x).astype(int), width, wrap[0])]
    out = np.zeros((len(uv), linear.shape[2]))
    left, top = np.floor(x - 0.5), np.floor(y - 0.5)
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - (x - 0.5 - left)) * np.abs(1 - dy - (y - 0.5 - top))
            row, column = wrapped((top + dy).astype(int), height, wrap[1]), wrapped((left + dx).astype(int), width, wrap[0])
            out += weight[:, None] * linear[row, column]
    return out


def test_srgb_is_the_standard() -> None:
    # IEC 61966-2-1: the two pieces, their join, and the ends.
    np.testing.assert_allclose(srgb_to_linear(np.array([0, 0.04045, 0.5, 1.0])), [0, 0.04045 / 12.92, 0.21404114048223255, 1], rtol=1e-12)
    values = np.linspace(0, 1, 65536)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-7)


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("wrap", [(REPEAT, REPEAT), (MIRRORED, CLAMP), (CLAMP, MIRRORED)])
def test_wrap_and_filter_agree_with_numpy(wrap: tuple[int, int], nearest: bool, tmp_path: Path) -> None:
    pixels = noise(5, 3)
    uv = np.random.default_rng(1).uniform(-3, 4, (2000, 2))
    found = sampled(table_of(textured(tmp_path, pixels, wrap=wrap, nearest=nearest)), uv)
    linear = np.concatenate([srgb_to_linear(pixels[..., :3] / 255), pixels[..., 3:] / 255], 2)
    np.testing.assert_allclose(found, reference(linear, uv, wrap, nearest), atol=1e-6)


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 1), (np.uint8, 2), (np.uint8, 3), (np.uint16, 4)])
def test_every_kind_of_png_is_exact_at_its_texels(dtype: Any, channels: int, tmp_path: Path) -> None:
    pixels = noise(4, 4, dtype, channels)
    centres = (np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2) + 0.5) / 4
    value = pixels.reshape(16, -1) / np.iinfo(dtype).max
    color = srgb_to_linear(value[:, : 3 if channels > 2 else 1]) * np.ones(3)
    alpha = value[:, -1] if channels in (2, 4) else np.ones(16)
    found = sampled(table_of(textured(tmp_path, pixels)), centres)
    np.testing.assert_allclose(found, np.column_stack([color, alpha]), rtol=1e-6, atol=1e-9)


def test_metallic_roughness_is_linear_and_emission_is_srgb(tmp_path: Path) -> None:
    pixels = np.full((2, 2, 3), 128, np.uint8)
    at = np.array([[0.5, 0.5]])
    linear = sampled(table_of(textured(tmp_path, pixels, slot="metallic_roughness_texture")), at)
    np.testing.assert_allclose(linear[0, :3], 128 / 255, rtol=1e-12)
    emission = sampled(table_of(textured(tmp_path, pixels, slot="emissive_texture")), at)
    np.testing.assert_allclose(emission[0, :3], srgb_to_linear(np.array(128 / 255)), rtol=1e-6)


@pytest.mark.parametrize("size", [(8, 8), (1, 7), (7, 1), (5, 3), (13, 6), (1, 1)])
@pytest.mark.parametrize("srgb", [False, True])
def test_every_level_keeps_the_mean(size: tuple[int, int], srgb: bool) -> None:
    levels = pyramid(Image("i", noise(*size)), srgb, 0.0)
    assert levels[-1].shape[:2] == (1, 1)
    assert [max(1, n // 2) for n in levels[0].shape[:2]] == list(levels[min(1, len(levels) - 1)].shape[:2])
    linear = [level[..., :3] / 65535 for level in levels]
    means = np.array([(srgb_to_linear(v) if srgb else v).mean((0, 1)) for v in linear])
    # Half a code of 16 bits, a level at most.
    np.testing.assert_allclose(means, np.broadcast_to(means[0], means.shape), atol=4e-5)


@pytest.mark.parametrize("cutoff", [0.5, -1.0])
def test_what_is_cut_out_does_not_color_what_is_left(cutoff: float) -> None:
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[::2] = (255, 0, 0, 255)
    pixels[1::2] = (0, 255, 0, 0)
    for level in pyramid(Image("i", pixels), True, cutoff)[1:]:
        assert (level[..., 0] == 65535).all()
        assert (level[..., 1] < 65535 * linear_to_srgb(np.array(1e-4))).all()
        assert (np.abs(level[..., 3].astype(int) - 32768) <= 1).all()


def test_texture_transform_is_the_matrix_of_the_extension(tmp_path: Path) -> None:
    info = {"offset": [0.25, -0.5], "rotation": 0.7, "scale": [2.0, 0.5]}
    scene = textured(tmp_path, noise(4, 4), info=info)
    c, s = math.cos(0.7), math.sin(0.7)
    translation = np.array([[1, 0, 0.25], [0, 1, -0.5], [0, 0, 1]])
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(scene.textures[0].transform, (translation @ rotation @ np.diag([2, 0.5, 1]))[:2], rtol=1e-12)


def test_texture_transform_of_the_specification_s_example(tmp_path: Path) -> None:
    """Offset (0, 1), a quarter turn, scale ½: 'only the lower left quadrant of the source image, rotated clockwise 90°'."""
    scene = textured(tmp_path, noise(4, 4), info={"offset": [0, 1], "rotation": 1.57079632679, "scale": [0.5, 0.5]})
    m = np.array(scene.textures[0].transform)
    found = np.array(CORNERS) @ m[:, :2].T + m[:, 2]
    # Image coordinates have v = 1 at the bottom. Its top left corner stands where the quadrant's bottom left was.
    np.testing.assert_allclose(found, [[0.0, 1.0], [0.0, 0.5], [0.5, 0.5], [0.5, 1.0]], atol=1e-9)


def test_sets_of_coordinates_are_those_that_textures_name(tmp_path: Path) -> None:
    w = GlbWriter()
    base = w.texture(png(noise(2, 2))) | {"texCoord": 1}
    glow = w.transformed(w.texture(png(noise(2, 2))), texCoord=2)
    material = w.material("m", base_color_texture=base, emissive_texture=glow, emission=(1, 1, 1))
    sets = [np.full((4, 2), i) for i in range(3)]
    parts = [Part(SQUARE, FACES, uvs=sets, material=material), Part(SQUARE, FACES, material=w.material("plain"))]
    w.node(mesh=w.mesh("m", parts))
    scene = load_glb(w.to_glb(), tmp_path)
    assert [t.uv_set for t in scene.textures] == [0, 1]
    np.testing.assert_array_equal(np.unique(scene.uvs[:4], axis=0), [[1, 1, 2, 2]])
    assert not scene.uvs[4:].any() and scene.uvs.shape == (8, 4)


@pytest.mark.parametrize("share", [0.0, 1 / 4**3, 1 / 4, 1.0, 100.0])
def test_a_level_is_no_wider_than_what_a_ray_stands_for(share: float, tmp_path: Path) -> None:
    """Half the square is one triangle with half the texels: `share` of it in an image of 64²."""
    pixels = np.kron(noise(2, 2), np.ones((32, 32, 1), np.uint8))
    table = table_of(textured(tmp_path, pixels, nearest=True))
    out = np.zeros(3)
    look_at_triangle(table, 0, 0, 0.5, 0.25, share, out)
    levels = pyramid(Image("i", pixels), True, 0.0)
    texels = 64 * 64 / 2 * share
    level = min(max(0, math.floor(math.log(texels, 4))) if texels > 1 else 0, 6)
    n = levels[level].shape[0]
    expected = srgb_to_linear(levels[level][int(0.25 * n), min(int(0.75 * n), n - 1), :3] / 65535)
    np.testing.assert_allclose(out, expected, rtol=1e-6)


def test_wild_coordinates_do_no_harm(tmp_path: Path) -> None:
    table = table_of(textured(tmp_path, noise(4, 4), wrap=(MIRRORED, CLAMP)))
    wild = np.array([[1e300, 0], [np.inf, np.nan], [-1e15, 1e300], [-3e8, -1e11]])
    found = sampled(table, wild)
    assert ((found >= 0) & (found <= 1)).all()
