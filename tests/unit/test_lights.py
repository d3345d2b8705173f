"""Punctual and directional lights over a plane, through the path-traced picture, against their definitions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.gltf.writer import GlbWriter, look_at
from bake_core.picture import Picture, path_trace_picture
from tests.scenes import add_square, build, camera_at

Array = NDArray[Any]
ALBEDO = (0.8, 0.5, 0.25)
SIDE = 16  # pixels
WIDTH = 2.0  # metres that the picture spans
PLANE = np.diag([4.0, 1, 4, 1])


def plane() -> GlbWriter:
    w = GlbWriter()
    add_square(w, "plane", ALBEDO, matrix=PLANE)
    return w


def seen(writer: GlbWriter, samples: int = 64, **spec: Any) -> Picture:
    """The plane from far above: rays all but parallel."""
    camera = camera_at((0, 50, 0), (0, 0, 0), width=WIDTH)
    return path_trace_picture(build(writer, **spec), camera, SIDE, SIDE, samples=samples, seed=1, threads=1)


def expected(irradiance: Any) -> Array:
    """Radiance of each pixel, (SIDE, SIDE, 3): a mean over 8×8 points of albedo/π times `irradiance(points)` (n, 3)."""
    fine = SIDE * 8
    c = ((np.arange(fine) + 0.5) / fine - 0.5) * WIDTH
    camera = look_at((0, 50, 0), (0, 0, 0))
    u, v = np.meshgrid(c, -c)
    points = u[..., None] * camera[:3, 0] + v[..., None] * camera[:3, 1]
    e = irradiance(points.reshape(-1, 3)).reshape(SIDE, 8, SIDE, 8).mean((1, 3))
    return np.asarray(e[..., None] * np.array(ALBEDO) / math.pi)


def inverse_square(points: Array, position: Array) -> Array:
    """cosθ/d² on the plane."""
    d = position - points
    squared = (d * d).sum(-1)
    return np.asarray(d[:, 1] / squared**1.5)


def check(picture: Picture, truth: Array) -> None:
    assert not picture.indirect.any() and not picture.emission.any()
    np.testing.assert_array_equal(picture.hit, 1)
    np.testing.assert_allclose(picture.direct, truth, rtol=5e-3, atol=1e-3 * truth.max())
    assert picture.direct.mean((0, 1)) == pytest.approx(truth.mean((0, 1)), rel=1e-3)


def test_directional_light_of_the_gltf_and_of_the_spec() -> None:
    """Both at once; the spec's direction need not be a unit vector. Their sum is estimated by choosing one, so it is noisy."""
    w = plane()
    w.node(light=w.light("directional", (1, 1, 1), 3.0), matrix=look_at((0, 1, 0), (0.48, 0.2, 0.36)))
    light = {"kind": "directional", "direction": [3.0, -4.0, 0.0], "irradiance": [2.0, 2.0, 2.0]}
    truth = expected(lambda p: np.full(len(p), 3.0 * 0.8))
    check(seen(w), truth)
    check(seen(plane(), lights=[light]), truth * (2.0 * 0.8) / (3.0 * 0.8))
    both = seen(w, 256, lights=[light]).direct
    assert both.mean((0, 1)) == pytest.approx(truth.mean((0, 1)) * (1 + 2 / 3), rel=5e-3)


@pytest.mark.parametrize("position", [(0.3, 1.0, -0.2), (1.5, 0.25, 1.5), (0.0, 30.0, 0.0)])
def test_point_light(position: tuple[float, float, float]) -> None:
    spec = {"kind": "point", "position": list(position), "intensity": [7.0, 7.0, 7.0]}
    truth = expected(lambda p: 7.0 * inverse_square(p, np.array(position)))
    check(seen(plane(), 256, lights=[spec]), truth)
    w = plane()
    w.node(light=w.light("point", intensity=7.0), translation=position)
    check(seen(w, 256), truth)


def test_a_range_ends_a_light_smoothly() -> None:
    """KHR_lights_punctual: times max(0, 1 - (d/range)⁴)."""
    position, reach = np.array([0.0, 1.0, 0.0]), 1.25
    w = plane()
    w.node(light=w.light("point", intensity=5.0, range=reach), translation=position.tolist())

    def irradiance(p: Array) -> Array:
        d = np.linalg.norm(position - p, axis=1)
        return np.asarray(5.0 * inverse_square(p, position) * np.maximum(0, 1 - (d / reach) ** 4))

    truth = expected(irradiance)
    picture = seen(w, 256)
    check(picture, truth)
    assert not picture.direct[truth == 0].any() and (truth == 0).any()


@pytest.mark.parametrize(("inner", "outer"), [(0.0, 0.7), (0.3, 0.6), (0.5, 0.501)])
def test_spot_light(inner: float, outer: float) -> None:
    """The squared ramp between the cosines of the two angles; all inside, nothing outside."""
    position, axis = np.array([0.2, 1.0, 0.1]), np.array([-0.28, -0.96, 0.0])
    spec = {"kind": "spot", "position": position.tolist(), "direction": axis.tolist(), "intensity": [4.0] * 3}
    spec |= {"inner_angle": inner, "outer_angle": outer}

    def irradiance(p: Array) -> Array:
        d = p - position
        cosine = d @ axis / np.linalg.norm(d, axis=1)
        scale = 1 / max(0.001, math.cos(inner) - math.cos(outer))
        ramp = np.clip((cosine - math.cos(outer)) * scale, 0, 1)
        return np.asarray(4.0 * inverse_square(p, position) * ramp * ramp)

    truth = expected(irradiance)
    picture = seen(plane(), 1024, lights=[spec])
    if outer - inner > 0.01:  # a sharp edge inside pixels is known to the picture's samples only so well
        check(picture, truth)
    assert picture.direct.mean((0, 1)) == pytest.approx(truth.mean((0, 1)), rel=5e-3)
    w = plane()
    w.node(light=w.light("spot", intensity=4.0, inner=inner, outer=outer), matrix=look_at(position.tolist(), (position + axis).tolist()))
    np.testing.assert_allclose(seen(w, 1024).direct, picture.direct, rtol=1e-3, atol=2e-3 * truth.max())


def test_many_lights_of_very_different_strength_add_up() -> None:
    """One is chosen at a time, by strength: unbiased, and one that emits nothing is never chosen."""
    random = np.random.default_rng(5)
    lights, total = [], np.zeros((SIDE, SIDE, 3))
    for strength in (0.0, 0.01, 0.1, 1.0, 5.0, 0.0):
        position = random.uniform([-1, 0.8, -1], [1, 2, 1])
        lights.append({"kind": "point", "position": position.tolist(), "intensity": [strength] * 3})
        total += expected(lambda p, at=position, s=strength: s * inverse_square(p, at))
    picture = seen(plane(), 512, lights=lights)
    assert picture.direct.mean((0, 1)) == pytest.approx(total.mean((0, 1)), rel=3e-3)
    np.testing.assert_allclose(picture.direct, total, rtol=0.1)


def test_light_from_below_does_not_come_through() -> None:
    lights = [
        {"kind": "point", "position": [0.1, -1, 0], "intensity": [9.0] * 3},
        {"kind": "directional", "direction": [0, 1, 0.1], "irradiance": [9.0] * 3},
    ]
    assert not seen(plane(), 8, lights=lights).direct.any()


def test_a_surface_between_casts_a_shadow_from_both_its_sides() -> None:
    """A single-sided square, face up and face down: shadow rays are blocked by both."""
    lights = [{"kind": "directional", "direction": [0, -1, 0], "irradiance": [1.0] * 3}]
    for turn in (1.0, -1.0):
        w = plane()
        # Above the camera: it shades, and is not in the picture.
        add_square(w, "roof", matrix=np.diag([0.8, turn, turn * 0.8, 1]) + np.array([[0, 0, 0, 0], [0, 0, 0, 60.0], [0] * 4, [0] * 4]))
        lit = seen(w, 64, lights=lights).direct[..., 0] > 0.5 * ALBEDO[0] / math.pi
        assert not lit[5:11, 5:11].any() and lit[:4].all() and lit[-4:].all() and lit[:, :4].all() and lit[:, -4:].all()


def test_no_light_at_all_is_exactly_black() -> None:
    picture = seen(plane(), 16)
    assert not picture.whole.any()
    np.testing.assert_array_equal(picture.hit, 1)
