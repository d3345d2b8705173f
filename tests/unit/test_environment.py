"""Skies: where their texels lie, how directions are drawn from them, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.environment import Sky, beside, exactly, make_sky, read_environment, sample_sky, sky_radiance
from bake_core.errors import SpecError
from bake_core.images import write_exr
from bake_core.kernels import entry_kernel
from bake_core.sampling import reverse_bits, sobol_pair
from bake_core.spec import EquirectEnvironment

F32 = NDArray[np.float32]


@entry_kernel
def _look(sky: Any, directions: Any, out: Any) -> None:
    for i in range(directions.shape[0]):
        radiance, pdf = sky_radiance(sky, directions[i, 0], directions[i, 1], directions[i, 2])
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = radiance[0], radiance[1], radiance[2], pdf


@entry_kernel
def _draw(sky: Any, out: Any) -> None:
    for i in range(out.shape[0]):
        u, v = sobol_pair(reverse_bits(uint32(i)), uint64(5))
        radiance, d, pdf = sample_sky(sky, float(u), float(v))
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = radiance[0], radiance[1], radiance[2], pdf
        out[i, 4], out[i, 5], out[i, 6] = d[0], d[1], d[2]


def sky_of(texels: F32, turn: float = 0.0) -> Sky:
    sky = make_sky(texels, turn)
    assert sky is not None
    return sky


def look(sky: Sky, directions: Any) -> NDArray[np.float64]:
    out = np.zeros((len(directions), 4))
    _look(sky, np.asarray(directions, np.float64), out)
    return out


def noise(height: int = 12, width: int = 20) -> F32:
    """Uneven, some texels and one whole row black."""
    texels = np.random.default_rng(3).gamma(0.3, 1.0, (height, width, 3)).astype(np.float32)
    texels[4] = 0
    texels[:, -3:] = 0
    return texels


def test_the_middle_faces_minus_z_and_its_right_is_plus_x() -> None:
    texels = np.zeros((4, 8, 3), np.float32)
    texels[..., 0], texels[..., 1] = np.mgrid[0:4, 0:8]
    axes = {(1, 1, -10): 4, (10, 1, 1): 6, (-1, 1, -10): 3, (-10, 1, -1): 2, (1, 1, 10): 7, (-1, 1, 10): 0}
    for direction, column in axes.items():
        red, green, _, _ = look(sky_of(texels), [np.array(direction) / np.linalg.norm(direction)])[0]
        assert (red, green) == (1, column), direction
    assert look(sky_of(texels), [(0, 1, 0), (0, -1, 0)])[:, 0].tolist() == [0, 3]


def test_a_turn_is_counter_clockwise_seen_from_above() -> None:
    """By a quarter: what was at -Z is at -X."""
    texels = np.zeros((2, 4, 3), np.float32)
    texels[:, 2] = 1
    tilted = np.array([-1, 0.1, -1])
    assert look(sky_of(texels, 0.0), [(0.1, 0.1, -0.99)])[0, 0] == 1
    assert look(sky_of(texels, math.pi / 2), [(-0.99, 0.1, -0.1)])[0, 0] == 1
    assert look(sky_of(texels, 1.0), [tilted / np.linalg.norm(tilted)])[0, 0] == 1


def test_what_is_drawn_is_what_is_seen_with_the_same_density() -> None:
    sky = sky_of(noise(), 0.7)
    out = np.zeros((4096, 7))
    _draw(sky, out)
    np.testing.assert_allclose(np.linalg.norm(out[:, 4:], axis=1), 1, rtol=1e-12)
    seen = look(sky, out[:, 4:])
    # A direction drawn on the very border of a texel may be seen in its neighbour.
    same = (np.abs(seen - out[:, :4]) <= 1e-9 * out[:, :4]).all(1)
    assert same.mean() > 0.999
    assert (out[:, 3] > 0).all()


def test_density_integrates_to_one_and_sums_are_exact() -> None:
    texels = noise()
    sky = sky_of(texels)
    height, width = texels.shape[:2]
    edges = np.cos(np.arange(height + 1) * math.pi / height)
    solid = ((edges[:-1] - edges[1:]) * 2 * math.pi / width)[:, None, None]
    theta = (np.arange(height) + 0.5) * math.pi / height
    phi = ((np.arange(width) + 0.5) / width - 0.5) * 2 * math.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    centres = np.stack([np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], 2).reshape(-1, 3)
    seen = look(sky, centres).reshape(height, width, 4)
    np.testing.assert_array_equal(seen[..., :3], texels)
    assert (seen[..., 3:] * solid).sum() == pytest.approx(1, abs=1e-6)
    # Radiance summed over channels is the density's own shape: one sample gives the whole sum.
    out = np.zeros((16, 7))
    _draw(sky, out)
    np.testing.assert_allclose(out[:, :3].sum(1) / out[:, 3], (texels * solid).sum(), rtol=1e-4)


def test_a_black_sky_is_none() -> None:
    assert make_sky(np.zeros((4, 8, 3), np.float32), 0.0) is None


def read(folder: Path, image: str, **more: Any) -> Sky:
    environment, named = read_environment(EquirectEnvironment(kind="equirect", image=image, **more), beside(folder))
    assert isinstance(named, EquirectEnvironment) and named.image.startswith("sha256:")
    assert environment.sky is not None and not environment.constant.any()
    return environment.sky


@pytest.mark.parametrize("name", ["sky.exr", "sky.hdr", "a-blob"])
def test_exr_and_hdr_are_read(tmp_path: Path, name: str) -> None:
    """By their first bytes: a blob has no suffix."""
    texels = np.exp2(np.arange(4 * 8 * 3).reshape(4, 8, 3) % 5).astype(np.float32)
    if name.endswith(".hdr"):
        rows = b"".join(bytes([*(int(c) * 8 for c in texel), 128 + 5]) for texel in texels.reshape(-1, 3))
        (tmp_path / name).write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n" + rows)
    else:
        write_exr(tmp_path / "written.exr", texels, ("R", "G", "B"))
        (tmp_path / "written.exr").rename(tmp_path / name)
    np.testing.assert_allclose(read(tmp_path, name, scale=0.5).texels, texels / 2, rtol=0.01)


@pytest.mark.parametrize(
    ("value", "slug"), [(math.nan, "spec.image_not_finite"), (math.inf, "spec.image_not_finite"), (-0.5, "spec.image_negative")]
)
def test_what_is_no_radiance_is_refused_with_its_place(tmp_path: Path, value: float, slug: str) -> None:
    texels = np.ones((4, 8, 3), np.float32)
    texels[2, 5, 1] = value
    write_exr(tmp_path / "sky.exr", texels, ("R", "G", "B"))
    with pytest.raises(SpecError) as e:
        read(tmp_path, "sky.exr")
    assert e.value.slug == slug and "row 2, column 5, G" in e.value.where


def test_other_faults(tmp_path: Path) -> None:
    write_exr(tmp_path / "sky.exr", np.full((4, 8, 3), 1e10, np.float32), ("R", "G", "B"))
    write_exr(tmp_path / "depth.exr", np.ones((4, 8, 1), np.float32), ("Z",))
    whole = (tmp_path / "sky.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.exr").write_text("no image")
    faults = {
        "none.exr": "spec.image_not_found",
        "sha256:00": "spec.image_not_found",
        ".": "spec.image_not_found",
        "text.exr": "spec.image_unreadable",
        "cut.exr": "spec.image_unreadable",
        "depth.exr": "spec.image_unreadable",
    }
    for image, slug in faults.items():
        with pytest.raises(SpecError) as e:
            read(tmp_path, image)
        assert e.value.slug == slug, image
        assert str(tmp_path) not in str(e.value)
    with pytest.raises(SpecError, match="beyond float32"):
        read(tmp_path, "sky.exr", scale=1e30, rotation_y=1.0)


def test_a_bundle_s_sky_must_be_that_one(tmp_path: Path) -> None:
    for name, value in (("one.exr", 1.0), ("two.exr", 2.0)):
        write_exr(tmp_path / name, np.full((4, 8, 3), value, np.float32), ("R", "G", "B"))
    _, named = read_environment(EquirectEnvironment(kind="equirect", image="one.exr"), beside(tmp_path))
    assert read_environment(named, exactly(tmp_path / "one.exr"))[1] == named
    for other, slug in (("two.exr", "spec.other_image"), ("none.exr", "spec.image_not_found")):
        with pytest.raises(SpecError) as e:
            read_environment(named, exactly(tmp_path / other))
        assert e.value.slug == slug
