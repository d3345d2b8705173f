"""Path-traced irradiance at surface points against closed forms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.environment import Environment, make_sky
from bake_core.errors import Cancelled
from bake_core.examples import closed_box, plane_under_sun, two_rooms
from bake_core.gltf.writer import GlbWriter
from bake_core.receiver_comparison import compare_receivers, measure_receivers
from bake_core.receiver_irradiance import irradiance_at
from bake_core.receivers import Receivers, draw_receivers, stands_of
from bake_core.scene import Scene
from bake_core.spec import parse_spec
from bake_core.tracer import Tracer
from tests.baking import bake_example
from tests.receivers import volume
from tests.scenes import SQUARE, add_square, build, load, polygon_irradiance, sky
from tests.unit.gltf_build import load_glb

Array = NDArray[Any]
OVER = volume([-2, 0.5, -2], [1, 1, 1], [5, 1, 5])


def floor(**material: Any) -> GlbWriter:
    w = GlbWriter()
    add_square(w, "floor", matrix=np.diag([20.0, 1, 20, 1]), **material)
    return w


def measured(
    scene: Scene, tracer: Tracer, count: int = 64, samples: int = 256, boxes: Any = None, threads: int = 1
) -> tuple[Receivers, Array, Array]:
    """Receivers around zero, their irradiance, and its standard error."""
    r = draw_receivers(scene, tracer, [OVER], count, 3, boxes=boxes)
    estimates = irradiance_at(tracer, stands_of(tracer, r.places), samples=samples, scrambles=4, seed=5, threads=threads)
    return r, estimates.mean(0), estimates.std(0, ddof=1) / 2


def test_an_even_sky_over_a_plane_is_exact() -> None:
    scene = load(floor())
    _, e, error = measured(scene, build(scene, environment=sky(2.0)))
    np.testing.assert_allclose(e, 2 * math.pi, rtol=1e-12)
    assert error.max() < 1e-12


@pytest.mark.parametrize("max_bounces", [0, 1, 3, None])
def test_furnace(tmp_path: Path, max_bounces: int | None) -> None:
    """π Le (1 - a^(k+1)) / (1 - a) on every wall of a sealed box: the closed form of the probes."""
    scene = load_glb(closed_box(0.5, 1.0)[0], tmp_path)
    r, e, error = measured(scene, build(scene, max_bounces=max_bounces), samples=512)
    expected = math.pi * (1 - (0.5 ** (max_bounces + 1) if max_bounces is not None else 0)) / 0.5
    assert e.mean() == pytest.approx(expected, rel=2e-3)
    np.testing.assert_allclose(e, expected, rtol=0.05)
    assert error.mean() < 0.01 * expected
    assert len(r) == 64


@pytest.mark.parametrize(("height", "double_sided"), [(0.3, False), (1.0, True), (6.0, False)])
def test_a_square_emitter_over_a_floor(height: float, double_sided: bool) -> None:
    """Lambert's polygon formula at every receiver: near, where the cosine finds the lamp, and far, where only light samples do."""
    w = floor(color=(0.0, 0.0, 0.0))
    lamp = np.diag([1.0, -1, -1, 1])
    lamp[1, 3] = height
    add_square(w, "lamp", (0, 0, 0), matrix=lamp, emission=(3.0, 2.0, 1.0), double_sided=double_sided)
    scene = load(w)
    r, e, error = measured(scene, build(scene), samples=4096, boxes=[[[-2, -0.1, -2], [2, 0.1, 2]]])
    truth = np.array([polygon_irradiance(SQUARE + [0, height, 0], p, [0, 1, 0]) for p in r.positions])
    for channel, le in enumerate((3.0, 2.0, 1.0)):
        z = (e[:, channel] - le * truth) / np.maximum(error[:, channel], 1e-4 * le * truth)
        # Student's t of three degrees of freedom has tails: its mean is what is sharp.
        assert abs(z.mean()) < 4 * math.sqrt(3 / len(z))
        np.testing.assert_allclose(e[:, channel], le * truth, rtol=0.02)


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_one_bright_side_of_an_image_of_the_sky(turn: float) -> None:
    """A lune of a quarter turn, from the zenith to the horizon: E = L · (Δφ / 2π) · π on a floor, the lune's share of a whole sky."""
    texels = np.zeros((8, 16, 3), np.float32)
    texels[:4, 5:9] = (4, 2, 1)
    scene = load(floor(color=(0.0, 0.0, 0.0)))
    tracer = Tracer.build(
        scene, parse_spec({"volumes": [{"fit": "scene", "counts": [2, 1, 2]}]}), Environment(np.zeros(3), make_sky(texels, turn))
    )
    _, e, error = measured(scene, tracer, samples=1024)
    np.testing.assert_allclose(e, np.broadcast_to(np.array([4, 2, 1]) * math.pi / 4, e.shape), rtol=0.02)
    assert e.mean(0) == pytest.approx(np.array([4, 2, 1]) * math.pi / 4, rel=1e-3)
    assert error.max() < 0.05


def test_a_sun_is_no_irradiance_of_the_query(tmp_path: Path) -> None:
    """What comes straight from it is left out, and a plane does not light itself."""
    scene = load_glb(plane_under_sun()[0], tmp_path)
    _, e, _ = measured(scene, build(scene))
    assert not e.any()


def test_a_sealed_room_is_dark_and_counts(tmp_path: Path) -> None:
    scene = load_glb(two_rooms()[0], tmp_path)
    dark = volume([0.5, 0.5, -1.5], [1, 1, 1], [4, 3, 4])
    tracer = build(scene)
    r = draw_receivers(scene, tracer, [dark], 200, 1, boxes=np.array([[[0.005, -1, -3], [5, 4, 3]]]))
    assert (len(r), r.behind, r.unseen) == (200, 0, 0)
    assert not irradiance_at(tracer, stands_of(tracer, r.places), samples=16, scrambles=2, seed=0).any()


def test_threads_change_no_bit_and_seeds_do() -> None:
    w = floor()
    lamp = np.diag([1.0, -1, -1, 1])
    lamp[1, 3] = 1
    add_square(w, "lamp", matrix=lamp, emission=(1.0,) * 3)
    scene = load(w)
    tracer = build(scene, environment=sky())
    one, two = (measured(scene, tracer, 200, 16, threads=n)[1] for n in (1, 2))
    assert one.tobytes() == two.tobytes()
    r = draw_receivers(scene, tracer, [OVER], 50, 3)
    a, b = (irradiance_at(tracer, stands_of(tracer, r.places), samples=16, scrambles=1, seed=s) for s in (1, 2))
    assert (a != b).any()


def test_cancelling_and_progress() -> None:
    scene = load(floor())
    tracer = build(scene, environment=sky())
    r = draw_receivers(scene, tracer, [OVER], 100, 3)
    told: list[float] = []
    irradiance_at(tracer, stands_of(tracer, r.places), samples=1, scrambles=1, seed=0, advance=told.append)
    assert sum(told) >= 1
    with pytest.raises(Cancelled):
        irradiance_at(tracer, stands_of(tracer, r.places), samples=1, scrambles=1, seed=0, cancelled=np.ones(1, np.uint8))


def test_a_furnace_bundle_is_right_at_every_receiver(tmp_path: Path) -> None:
    """Probes and reference are estimated apart from one another, and both are π Le / (1 - a)."""
    example = closed_box(0.5, 1.0)
    bundle = bake_example(tmp_path, example, stop={"target_error": None, "max_samples": 16})
    scene = load_glb(example[0], tmp_path)
    receivers, answers, estimates = measure_receivers(scene, build(scene), bundle.volumes, samples=64, threads=2)
    figures = compare_receivers(answers, estimates)
    assert len(receivers) == 2048
    assert figures.mean_ratio == pytest.approx(1, abs=2e-3)
    assert figures.relmse is not None and abs(figures.relmse) < 1e-4
    assert figures.p95 == pytest.approx(figures.reference_p95, rel=0.2)
