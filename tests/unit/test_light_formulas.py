"""Punctual lights against KHR_lights_punctual, written out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from bake_core.kernels import entry_kernel
from bake_core.lights import light_table, toward_light
from bake_core.scene import LIGHT_DIRECTIONAL, LIGHT_POINT, LIGHT_SPOT, Lights


@entry_kernel
def _toward(table: Any, x: Any, y: Any, z: Any, out: Any) -> None:
    out[0], out[1], out[2], out[3], out[4] = toward_light(table, 0, x, y, z)


def toward(at: tuple[float, float, float], kind: int, *, inner: float = 0.0, outer: float = math.pi, reach: float = math.inf) -> Any:
    """Direction, distance and gain of a light at (0, 2, 0) that shines downwards."""
    lights = Lights(
        kind=np.array([kind], np.int32),
        position=np.array([[0, 2, 0]], np.float32),
        direction=np.array([[0, -1, 0]], np.float32),
        value=np.ones((1, 3), np.float32),
        cos_inner=np.array([math.cos(inner)], np.float32),
        cos_outer=np.array([math.cos(outer)], np.float32),
        range=np.array([reach], np.float32),
    )
    out = np.zeros(5)
    _toward(light_table(lights, np.array([[-1.0] * 3, [1.0] * 3])), *at, out)
    return out


def test_point() -> None:
    x, y, z, distance, gain = toward((3, 2, 4), LIGHT_POINT)
    assert (x, y, z) == pytest.approx((-0.6, 0, -0.8)) and distance == pytest.approx(5) and gain == pytest.approx(1 / 25)


@pytest.mark.parametrize(("distance", "window"), [(1.0, 1 - 1 / 256), (2.0, 1 - 1 / 16), (3.9, 1 - (3.9 / 4) ** 4), (4.0, 0), (5.0, 0)])
def test_range(distance: float, window: float) -> None:
    """(1 - (d/range)⁴)+ / d²; a directional light has none."""
    assert toward((0, 2 - distance, 0), LIGHT_POINT, reach=4)[4] == pytest.approx(window / distance**2, abs=1e-12)
    assert toward((0, 2 - distance, 0), LIGHT_SPOT, inner=0.1, outer=0.2, reach=4)[4] == pytest.approx(window / distance**2, abs=1e-12)
    assert toward((0, 2 - distance, 0), LIGHT_DIRECTIONAL)[4] == 1


@pytest.mark.parametrize(("inner", "outer"), [(0.0, 0.5), (0.3, 0.5), (0.499, 0.5), (0.0, math.pi / 2), (0.01, 0.02)])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.8, 0.99])
def test_cones(inner: float, outer: float, share: float) -> None:
    """((cosθ - cos outer) / (cos inner - cos outer))² between the cones, narrow or not."""
    angle = inner + share * (outer - inner)
    gain = toward((2 * math.sin(angle), 2 - 2 * math.cos(angle), 0), LIGHT_SPOT, inner=inner, outer=outer)[4] * 4
    ramp = (math.cos(angle) - math.cos(outer)) / (math.cos(inner) - math.cos(outer))
    # The cones' cosines are float32.
    assert gain == pytest.approx(ramp**2, abs=3e-7 / (math.cos(inner) - math.cos(outer)) + 1e-9)


def test_inside_and_outside_of_a_cone() -> None:
    for angle, gain in ((0.2, 1), (0.29, 1), (0.51, 0), (1.5, 0), (3.0, 0)):
        at = (2 * math.sin(angle), 2 - 2 * math.cos(angle), 0)
        assert toward(at, LIGHT_SPOT, inner=0.3, outer=0.5)[4] * 4 == pytest.approx(gain, abs=1e-6)


def test_cones_that_float32_cannot_tell_apart_make_a_hard_edge() -> None:
    edge = 0.5
    inside, outside = (toward((2 * math.sin(a), 2 - 2 * math.cos(a), 0), LIGHT_SPOT, inner=edge, outer=edge)[4] for a in (0.499, 0.501))
    assert inside * 4 == pytest.approx(1) and outside == 0


def test_at_the_light_itself_there_is_none() -> None:
    assert toward((0, 2, 0), LIGHT_POINT)[4] == 0
