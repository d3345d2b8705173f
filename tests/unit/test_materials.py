"""Lambert about a shading normal reflects its albedo exactly, and is drawn with the density that it claims."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.materials import lambert_cosine, sample_lambert
from tests.unit.test_octahedral import quadrature, sphere
from tests.unit.test_sampling import chi_squared, most, uniform

Array = NDArray[Any]

# Geometric and shading normals at 0°, 20°, 60° and 85° from each other.
PAIRS = [
    ((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)),
    ((0.6, 0.0, -0.8), (0.6, 0.0, -0.8)),
    *(((0.0, 0.6, 0.8), (math.sin(a), 0.6 * math.cos(a), 0.8 * math.cos(a))) for a in np.radians([20, 60, 85])),
]


@numba.njit
def _cosines(w, n):  # type: ignore[no-untyped-def]
    out = np.empty(len(w))
    for i in range(len(w)):
        out[i] = lambert_cosine(w[i, 0], w[i, 1], w[i, 2], n)
    return out


@numba.njit
def _drawn(u, n):  # type: ignore[no-untyped-def]
    out = np.empty((len(u), 3))
    for i in range(len(u)):
        out[i, 0], out[i, 1], out[i, 2] = sample_lambert(float(u[i, 0]), float(u[i, 1]), n)
    return out


@pytest.mark.parametrize(("ng", "ns"), PAIRS)
def test_reflects_exactly_its_albedo(ng: tuple[float, ...], ns: tuple[float, ...]) -> None:
    """∫ (wi·ns)+ + (mirror(wi)·ns)+ dω = π over the half space of ng, whatever the angle: nothing is lost below the surface."""
    directions, omega = quadrature(64, 8)
    found = _cosines(directions.reshape(-1, 3), ng + ns) @ omega.reshape(-1)
    assert found == pytest.approx(math.pi, rel=2e-4)


def test_with_one_normal_it_is_plain_lambert() -> None:
    directions = sphere(500)
    n = (0.48, 0.6, 0.64)
    np.testing.assert_allclose(_cosines(directions, n + n), np.maximum(directions @ n, 0), atol=1e-15)


@pytest.mark.parametrize(("ng", "ns"), PAIRS)
def test_is_drawn_with_its_density(ng: tuple[float, ...], ns: tuple[float, ...]) -> None:
    u = uniform(1 << 17, seed=3)
    w = _drawn(u, ng + ns)
    np.testing.assert_allclose(np.linalg.norm(w, axis=1), 1, atol=1e-6)
    assert (w @ ng >= -1e-12).all()
    # Equal boxes in z and φ, each with its integral of the density.
    boxes, fine = 12, 24
    z = (np.arange(boxes * fine) + 0.5) * 2 / (boxes * fine) - 1
    phi = (np.arange(boxes * fine) + 0.5) * 2 * math.pi / (boxes * fine) - math.pi
    zz, pp = np.meshgrid(z, phi, indexing="ij")
    r = np.sqrt(1 - zz * zz)
    density = _cosines(np.stack([r * np.cos(pp), r * np.sin(pp), zz], -1).reshape(-1, 3), ng + ns) / math.pi
    expected = density.reshape(boxes, fine, boxes, fine).sum((1, 3)) * 4 * math.pi / (boxes * fine) ** 2 * len(u)
    counts, _, _ = np.histogram2d(w[:, 2], np.arctan2(w[:, 1], w[:, 0]), bins=boxes, range=[[-1, 1], [-math.pi, math.pi]])
    full = expected > 5
    assert counts[~full].sum() < 10 + 3 * expected[~full].sum()
    assert chi_squared(counts[full], expected[full]) < most(int(full.sum()))
