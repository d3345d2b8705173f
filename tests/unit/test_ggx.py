"""The microfacet model on its own: its tables against quadrature, its energy, and sampling against density."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba import uint32, uint64

from bake_core.ggx import read_albedo, read_average
from bake_core.ggx_albedo import AlbedoTable, albedo_table, single_scatter_albedo, table_coordinate, table_cosine
from bake_core.kernels import entry_kernel, kernel
from bake_core.materials import gloss, sample_gloss, scattered
from bake_core.sampling import reverse_bits, sobol_pair


class Tables(NamedTuple):
    """As much of a scene as these kernels look at."""

    gloss: AlbedoTable


TABLES = Tables(albedo_table())
FLAT = (0.0, 0.0, 1.0, 0.0, 0.0, 1.0)
# A shading normal 0.6 rad from the geometric one.
TILTED = (0.0, 0.0, 1.0, math.sin(0.6), 0.0, math.cos(0.6))


@entry_kernel
def _read(g: Any, cosines: Any, roughness: Any, out: Any) -> None:
    for i in range(cosines.shape[0]):
        out[i, 0], out[i, 1] = read_albedo(g, cosines[i], roughness)


@entry_kernel
def _reflected(t: Any, base: Any, metallic: Any, roughness: Any, d: Any, n: Any, count: Any, out: Any) -> None:
    """Mean and largest weight of samples; the directions' histogram over 8 × 16 cells of cosine to ng and azimuth."""
    look = gloss(t, base, metallic, roughness, d[0], d[1], d[2], n)
    for i in range(count):
        u, v = sobol_pair(reverse_bits(uint32(i)), uint64(77))
        x, y, z = sample_gloss(t, look, float(u), float(v), n)
        r, g, b, pdf = scattered(t, True, look, x, y, z, n)
        out[0] += r / pdf / count
        out[1] += g / pdf / count
        out[2] += b / pdf / count
        out[3] = max(out[3], r / pdf)
        out[4 + _cell(x, y, z)] += 1 / count


@kernel
def _cell(x: Any, y: Any, z: Any) -> Any:
    row = min(int(z * 8), 7)
    return row * 16 + min(int((math.atan2(y, x) / (2 * math.pi) + 0.5) * 16), 15)


@entry_kernel
def _integrated(t: Any, base: Any, metallic: Any, roughness: Any, d: Any, n: Any, side: Any, out: Any) -> None:
    """∫ f cosθ and ∫ pdf over the hemisphere, by even points in cosine and azimuth: no sampling of ours in it."""
    look = gloss(t, base, metallic, roughness, d[0], d[1], d[2], n)
    weight = 2 * math.pi / (side * side)
    for i in range(side):
        z = (i + 0.5) / side
        r = math.sqrt(1 - z * z)
        for j in range(side):
            phi = 2 * math.pi * (j + 0.5) / side
            x, y = r * math.cos(phi), r * math.sin(phi)
            fr, fg, fb, pdf = scattered(t, True, look, x, y, z, n)
            out[0] += fr * weight
            out[1] += fg * weight
            out[2] += fb * weight
            out[3] += pdf * weight
            out[4 + _cell(x, y, z)] += pdf * weight


def ray(cosine: float) -> tuple[float, float, float]:
    """A ray that comes in under this cosine to +Z."""
    return -math.sqrt(1 - cosine * cosine), 0.0, -cosine


def reflected(base: tuple[float, float, float], metallic: float, roughness: float, cosine: float, n: Any, count: int = 1 << 14) -> Any:
    out = np.zeros(4 + 128)
    _reflected(TABLES, base, metallic, roughness, ray(cosine), n, count, out)
    return out


def test_table_coordinates_are_inverse() -> None:
    mu = np.linspace(0, 1, 101)
    for roughness in (0.01, 0.3, 1.0):
        np.testing.assert_allclose(table_cosine(table_coordinate(mu, roughness), roughness), mu, atol=1e-14)


@pytest.mark.parametrize(("roughness", "tolerance"), [(0.013, 1e-3), (0.05, 6e-4), (0.127, 4e-4), (0.333, 4e-4), (0.71, 4e-4), (1.0, 4e-4)])
def test_table_is_the_integral(roughness: float, tolerance: float) -> None:
    """At places between its entries, against a finer quadrature than the one that made it."""
    cosines = np.concatenate([np.linspace(0.003, 1, 15), np.geomspace(1e-4, 0.1, 8)])
    out = np.empty((len(cosines), 2))
    _read(albedo_table(), cosines, roughness, out)
    e, b = single_scatter_albedo(cosines, roughness, (700, 300))
    np.testing.assert_allclose(out[:, 0], e, atol=tolerance)
    np.testing.assert_allclose(out[:, 1], b, atol=tolerance)


@pytest.mark.parametrize("roughness", [0.02, 0.1, 0.45, 0.99])
def test_averages_are_those_of_the_table(roughness: float) -> None:
    """What is left for the diffuse base integrates to 1, so a white dielectric is white."""
    t = (np.arange(20000) + 0.5) / 20000
    out = np.empty((len(t), 2))
    _read(albedo_table(), t**2, roughness, out)
    measured = (out * (4 * t**3)[:, None]).mean(0)
    np.testing.assert_allclose(np.array(read_average(albedo_table(), roughness)), measured, atol=2e-5)


@pytest.mark.parametrize("n", [FLAT, TILTED], ids=["flat", "tilted"])
@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0])
def test_white_reflects_all(n: Any, metallic: float, roughness: float) -> None:
    """At every angle, the shading normal tilted away from the surface or not, behind it too; and no sample weighs much more than 1."""
    for cosine in (0.01, 0.1, 0.3, 0.7, 1.0):
        out = reflected((1.0, 1.0, 1.0), metallic, roughness, cosine, n, 1 << 15)
        np.testing.assert_allclose(out[:3], 1, atol=1e-3)
        assert out[3] < 6


def test_colours_saturate_and_black_reflects_only_its_surface() -> None:
    """A metal colours light once a bounce; a black dielectric reflects 4 % at normal incidence, nearly all at a grazing one."""
    smooth, rough = (reflected((0.8, 0.4, 0.1), 1.0, r, 1.0, FLAT) for r in (0.1, 1.0))
    np.testing.assert_allclose(smooth[:3], (0.8, 0.4, 0.1), rtol=1e-2)
    assert rough[0] < smooth[0] and rough[1] / rough[0] < 0.93 * smooth[1] / smooth[0]
    np.testing.assert_allclose(reflected((0.0, 0.0, 0.0), 0.0, 0.0, 1.0, FLAT)[:3], 0.04, rtol=1e-3)
    assert reflected((0.0, 0.0, 0.0), 0.0, 0.0, 0.001, FLAT)[0] > 0.98


@pytest.mark.parametrize("n", [FLAT, TILTED], ids=["flat", "tilted"])
@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.4), (1.0, 0.4), (0.5, 0.7), (0.0, 1.0), (1.0, 1.0)])
def test_samples_follow_their_density(n: Any, metallic: float, roughness: float) -> None:
    """The pdf integrates to 1, cell by cell to what is drawn; the value to what the samples' weights say."""
    for cosine in (0.2, 0.9):
        drawn, even = reflected((0.9, 0.5, 0.2), metallic, roughness, cosine, n, 1 << 16), np.zeros(4 + 128)
        _integrated(TABLES, (0.9, 0.5, 0.2), metallic, roughness, ray(cosine), n, 768, even)
        assert even[3] == pytest.approx(1, abs=2e-3)
        np.testing.assert_allclose(even[:3], drawn[:3], atol=2e-3)
        np.testing.assert_allclose(drawn[4:], even[4:], atol=1.5e-3)
