"""What probes gather: irradiance against integrals, distances against geometry, the same bits however the work is split."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.allocation import HALVES, SCRAMBLES, SCRAMBLES_PER_HALF, uniform
from bake_core.capture import Capture, capture_radiance
from bake_core.distances import capture_distance
from bake_core.errors import Cancelled
from bake_core.examples import closed_box, plane_under_sun, square_emitter, two_rooms
from bake_core.octahedral import dir_to_oct, texel_directions
from bake_core.scene import Scene
from bake_core.seen_lights import capture_texel
from bake_core.tracer import Tracer
from tests.scenes import build, load_example, sky, square_scene
from tests.unit.gltf_build import face_normals, world_triangles
from tests.unit.test_octahedral import quadrature

Array = NDArray[Any]
POSITIONS = np.array([[-0.55, -0.45, -0.6], [0.45, 0.55, 0.4], [0.1, 0.2, -0.3], [0.0, 0.0, 0.0], [0.7, -0.7, 0.2]] * 2)


def gather(
    tracer: Tracer, positions: Array, samples: tuple[int, int], *, ids: Array | None = None, threads: int = 1, **capture: Any
) -> Any:
    """(irradiance sums, radiance sums over both halves, rays)."""
    chosen = {"resolution": 16, "irradiance_resolution": 8, "seed": 0, "keep_radiance": False} | capture
    irradiance, radiance, rays = capture_radiance(
        tracer,
        np.ascontiguousarray(positions, np.float64),
        np.arange(len(positions), dtype=np.uint64) if ids is None else ids,
        uniform(len(positions), samples),
        Capture(**chosen),
        threads=threads,
        cancelled=np.zeros(1, np.uint8),
        advance=lambda fraction: None,
    )
    return irradiance, radiance.sum(1), rays


def normals(n: int = 8) -> Array:
    return texel_directions(n).reshape(-1, 3)


def test_half_a_sphere_of_light_in_every_direction() -> None:
    """Over an endless plane of radiance L, E(n) = π L (1 - n.y)/2: for all texels, not only where the closed form is simple."""
    glb, _ = plane_under_sun(albedo=0.5, irradiance=3.0, direction=(0.48, -0.8, 0.36), half_width=1e5)
    tracer = build(load_example(glb))
    e = gather(tracer, np.array([[0.0, 1.0, 0.0]]), (0, 256))[0][0].sum(0) / 256
    truth = 0.5 * 3.0 * 0.8 * (1 - normals()[:, 1]) / 2
    np.testing.assert_allclose(e, np.broadcast_to(truth[:, None], e.shape), atol=2e-3 * truth.max())


# A place between the two emitters of `square_emitter`, off all symmetries.
ASIDE = np.array([0.3, 0.2, -0.4])


def beside_two_emitters() -> tuple[Scene, Array]:
    """The scene, and irradiance at ASIDE for every texel's normal by 200 × 200 points on each emitter, (64,)."""
    scene = load_example(square_emitter()[0])
    s = (np.arange(200) + 0.5) / 200
    u, v = (a.reshape(-1, 1) for a in np.meshgrid(s, s))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    truth = np.zeros(64)
    triangles = world_triangles(scene)
    for t, front in zip(triangles, face_normals(triangles), strict=True):
        d = t[0] + u * (t[1] - t[0]) + v * (t[2] - t[0]) - ASIDE
        squared = (d * d).sum(1)
        w = d / np.sqrt(squared)[:, None]
        # A triangle's area is ½.
        truth += (np.maximum(w @ normals().T, 0) * (np.maximum(-w @ front, 0) / squared)[:, None]).mean(0) / 2
    return scene, truth


def rays(tracer: Tracer, samples: int) -> int:
    count: int = gather(tracer, np.array([[0.1, 0.2, -0.3]]), (0, samples))[2]
    return count


@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_every_ray_is_counted(bounces: int) -> None:
    """By hand, for 256 texels and 8 samples in a sealed box whose paths never end by themselves."""
    paths = 256 * 8
    dark, glowing = (load_example(closed_box(1.0, emission)[0]) for emission in (0.0, 1.0))
    point = {"kind": "point", "position": [0.0, 0.3, 0.0], "intensity": [1.0, 1.0, 1.0]}
    # Nothing shines: a ray to each vertex, but none after the last scatter event, which could find nothing.
    assert rays(build(dark, max_bounces=bounces), 8) == paths * max(bounces, 1)
    # The last ray asks for the sky.
    assert rays(build(dark, max_bounces=bounces, environment=sky()), 8) == paths * (bounces + 1)
    # At every vertex but the probe one towards the lamp, which all of a convex room's walls face.
    assert rays(build(dark, max_bounces=bounces, lights=[point]), 8) == paths * (max(bounces, 1) + bounces)
    # Walls that emit: the last ray looks for them; at each vertex one towards a point of them, unless that lies on the vertex's own wall;
    # from the probe one for every four paths.
    counted = rays(build(glowing, max_bounces=bounces), 8)
    assert paths * (bounces + 1) + paths // 4 + 0.7 * paths * bounces <= counted <= paths * (2 * bounces + 1) + paths // 4


@pytest.mark.parametrize("resolution", [8, 16, 32])
def test_the_size_of_capture_texels_is_not_in_the_result(resolution: int) -> None:
    """Two square emitters from aside, for every normal: the covariance term takes the blur out."""
    scene, truth = beside_two_emitters()
    samples = 256 if resolution == 32 else 1024
    e = gather(build(scene), ASIDE[None] - scene.origin, (0, samples), resolution=resolution)[0][0].sum(0)[:, 0] / samples
    np.testing.assert_allclose(e, truth, atol=5e-3 * truth.max())
    assert e.mean() == pytest.approx(truth.mean(), rel=2e-3)


@pytest.mark.parametrize("samples", [16, 32])
def test_a_first_pass_of_few_samples_is_unbiased(samples: int) -> None:
    """One and two samples a scramble through coarse texels: coefficients from a scramble's own samples would leave one no covariance."""
    scene, truth = beside_two_emitters()
    tracer = build(scene)
    at = ASIDE[None] - scene.origin
    seeds = range(600)
    found = np.array([gather(tracer, at, (0, samples), resolution=4, seed=s)[0][0].sum(0)[:, 0].mean() / samples for s in seeds])
    error = found.std(ddof=1) / math.sqrt(len(found)) / truth.mean()
    assert error < 0.0025
    assert abs(found.mean() / truth.mean() - 1) < 4 * error


@pytest.mark.parametrize("samples", [2, 4, 5, 8, 19])
def test_constant_light_is_exact_from_two_samples_on(samples: int) -> None:
    tracer = build(load_example(two_rooms()[0]), environment=sky(2.5))
    irradiance, radiance, _ = gather(tracer, np.array([[0.0, 50.0, 0.0], [900.0, 0, 0]])[1:], (0, samples), keep_radiance=True)
    # From 900 m away the rooms are one texel's concern.
    e = irradiance.sum(1)[0] / samples
    assert np.median(np.abs(e / (2.5 * math.pi) - 1)) < 1e-6
    assert radiance.shape == (1, 256, 3)
    assert np.median(radiance / samples) == 2.5


def test_scrambles_share_the_samples() -> None:
    """Samples go to both halves in turn, and to each half's scrambles in turn, whatever range they are drawn in."""
    tracer = build(square_scene(), environment=sky())
    for first, end in ((0, 16), (4, 27), (5, 6)):
        sums = gather(tracer, np.array([[0, 500.0, 0]]), (first, end))[0][0]
        whose = [s % HALVES * SCRAMBLES_PER_HALF + s // HALVES % SCRAMBLES_PER_HALF for s in range(first, end)]
        drawn = np.bincount(whose, minlength=SCRAMBLES)
        # A half with nobody beside it is not exact: it would have to correct itself by its own samples.
        exact = 1e-6 if end - first > 1 else 0.02
        np.testing.assert_allclose(np.median(sums, (1, 2)), drawn * math.pi, rtol=exact)


def test_the_same_bits_for_any_threads_and_any_shards() -> None:
    scene = load_example(closed_box(0.6, 1.0)[0])
    tracer = build(scene)
    whole = gather(tracer, POSITIONS, (0, 8), keep_radiance=True)
    for threads in (2, 3, 16):
        again = gather(tracer, POSITIONS, (0, 8), threads=threads, keep_radiance=True)
        assert all(np.array_equal(a, b) for a, b in zip(whole, again, strict=True))
    ids = np.arange(10, dtype=np.uint64)
    for part in (slice(0, 1), slice(3, 10)):
        again = gather(tracer, POSITIONS[part], (0, 8), ids=ids[part], keep_radiance=True)
        assert all(np.array_equal(a[part], b) for a, b in zip(whole[:2], again[:2], strict=True))


def test_probe_number_and_seed_choose_the_samples() -> None:
    tracer = build(load_example(square_emitter()[0]))
    same = np.zeros((2, 3))
    a, b = gather(tracer, same, (0, 4))[0]
    assert not np.array_equal(a, b)
    assert np.array_equal(a, gather(tracer, same[:1], (0, 4))[0][0])
    assert not np.array_equal(a, gather(tracer, same[:1], (0, 4), seed=1)[0][0])
    assert not np.array_equal(a, gather(tracer, same[:1], (0, 4), seed=2**64 - 1)[0][0])


def test_radiance_is_the_mean_over_each_texel() -> None:
    """A probe in front of an emitter: the map is 1 where the emitter covers a texel, 0 beside it, between on its edge."""
    tracer = build(load_example(square_emitter()[0]))
    radiance = gather(tracer, np.zeros((1, 3)), (0, 1024), keep_radiance=True)[1][0, :, 0].reshape(16, 16) / 1024
    # Coverage by 32 × 32 directions a texel: both squares span |y|, |z| < ½ at |x| = 1.
    directions, _ = quadrature(16, 32)
    x, y, z = np.moveaxis(np.abs(directions), -1, 0)
    covered = ((y < x / 2) & (z < x / 2)).mean(-1)
    np.testing.assert_allclose(radiance, covered, atol=0.03)
    assert radiance.mean() == pytest.approx(covered.mean(), rel=2e-3)
    assert radiance.min() == 0 and radiance.max() == 1
    assert ((radiance > 0) & (radiance < 1)).any()


def test_the_edge_of_a_small_lamp_is_sampled_as_a_light() -> None:
    """From beside both squares, whose edges lie in every texel that sees them: capture rays alone err three times as much."""
    tracer = build(load_example(square_emitter()[0]))
    radiance = gather(tracer, np.tile([0.0, 0.0, 1.5], (20, 1)), (0, 64), keep_radiance=True)[1][..., 0] / 64
    directions, _ = quadrature(16, 64)
    x, y, z = np.moveaxis(directions, -1, 0)
    covered = ((abs(y / x) < 0.5) & (abs(1.5 + z / abs(x)) < 0.5)).mean(-1).reshape(-1)
    edge = (covered > 0) & (covered < 1)
    assert math.sqrt(((radiance - covered)[:, edge] ** 2).mean()) < 0.008
    np.testing.assert_allclose(radiance.mean(0), covered, atol=0.006)
    assert not radiance[:, covered == 0].any()


@pytest.mark.parametrize("resolution", [1, 8, 16, 31])
def test_light_falls_into_the_texel_that_its_direction_leads_through(resolution: int) -> None:
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    column, row = np.minimum(((dir_to_oct(directions) + 1) / 2 * resolution).astype(int), resolution - 1).T
    assert [capture_texel(d, resolution**2) for d in directions] == (row * resolution + column).tolist()


def test_cancelling_stops_at_once_and_raises() -> None:
    tracer = build(load_example(closed_box(0.99, 1.0)[0]))
    flag = np.zeros(1, np.uint8)
    gather(tracer, np.zeros((1, 3)), (0, 1))  # compiled before the clock runs
    capture = Capture(16, 8, 0, False)
    timer = threading.Timer(0.3, flag.fill, (1,))
    timer.start()
    began = time.perf_counter()
    with pytest.raises(Cancelled):
        capture_radiance(
            tracer,
            np.zeros((64, 3)),
            np.arange(64, dtype=np.uint64),
            uniform(64, (0, 1024)),
            capture,
            threads=2,
            cancelled=flag,
            advance=lambda fraction: None,
        )
    assert time.perf_counter() - began < 0.3 + 0.5
    timer.join()
    with pytest.raises(Cancelled):
        capture_distance(tracer, np.zeros((1, 3)), 8, cancelled=flag)


@pytest.mark.parametrize(("probes", "threads"), [(1, 1), (2, 2), (64, 2), (9, 2)])
def test_progress_adds_up_to_one(probes: int, threads: int) -> None:
    told: list[float] = []
    tracer = build(square_scene())
    capture = Capture(8, 8, 0, False)
    ids = np.arange(probes, dtype=np.uint64)
    flag = np.zeros(1, np.uint8)
    capture_radiance(
        tracer, np.zeros((probes, 3)), ids, uniform(probes, (0, 4)), capture, threads=threads, cancelled=flag, advance=told.append
    )
    assert sum(told) == pytest.approx(1)


def test_distances_normals_and_sides_in_a_box_and_outside_it() -> None:
    """Slabs: the nearest wall along each texel's direction."""
    tracer = build(load_example(closed_box(0.5, 1.0)[0]))
    inside, outside = np.array([0.3, -0.2, 0.5]), np.array([0.0, 3.0, 0.0])
    distance, normal, back, _ = capture_distance(tracer, np.stack([inside, outside]), 16, cancelled=np.zeros(1, np.uint8))
    d = normals(16)
    d[d == 0] = 1e-300  # a texel's centre on a fold
    steps = (np.sign(d) - inside) / d
    np.testing.assert_allclose(distance[0], steps.min(1), rtol=3e-5)  # a hit is drawn a hair inside its triangle
    np.testing.assert_allclose(normal[0], -np.sign(d) * (steps == steps.min(1, keepdims=True)), atol=1e-6)
    assert not back[0].any()
    # From outside only backs are seen: the walls face inwards.
    hit = np.isfinite(distance[1])
    assert 0 < hit.mean() < 0.3
    np.testing.assert_array_equal(back[1], hit)
    assert not normal[1][~hit].any()
    # The normal looks at the probe, front or back.
    assert ((normal[1] * d).sum(1)[hit] < 0).all()


def test_backs_of_double_sided_surfaces_are_no_backs() -> None:
    for double_sided in (False, True):
        tracer = build(square_scene(double_sided=double_sided))
        distance, _, back, _ = capture_distance(tracer, np.array([[0.0, -0.5, 0.0]]), 16, cancelled=np.zeros(1, np.uint8))
        assert np.isfinite(distance).any()
        assert back.any() != double_sided
