"""Rays written down are the rays that were traced, and Embree gives the same answers to them again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bake_core.bench.throughput import logging_tracer, trace_once
from bake_core.examples import cornell
from bake_core.prepared import Prepared, prepare
from bake_core.ray_log import ANY, FIRST_OF_PACKET, NEAREST, OF_PACKET, RayLog, coherent_order, new_log, replay
from bake_core.spec import parse_spec
from tests.scenes import load_example


def traced(probes: NDArray[np.int64], size: int) -> tuple[Prepared, RayLog]:
    """Some probes of the Cornell box, traced with room for so many rays."""
    glb, document = cornell()
    prepared = prepare(load_example(glb), parse_spec({**document, "resolution": {"radiance": 4, "irradiance": 2}}))
    log = new_log(size)
    trace_once(prepared, logging_tracer(prepared.tracer, log), probes, 1)
    return prepared, log


def test_embree_answers_logged_rays_as_it_did() -> None:
    probes = np.arange(8)
    _, counted = traced(probes, 0)
    prepared, log = traced(probes, int(counted.asked[0]))
    assert log.asked[0] == counted.asked[0] > 8 * 4 * 4 * 16
    assert {NEAREST, ANY, FIRST_OF_PACKET, OF_PACKET} == set(log.kinds.tolist())
    for threads in (1, 3):
        np.testing.assert_array_equal(replay(prepared.tracer.tables.handle, log.rays, log.kinds, threads=threads), log.found)
    # A packet's rays find what they find alone.
    alone = np.where(log.kinds == ANY, ANY, NEAREST).astype(np.uint8)
    np.testing.assert_array_equal(replay(prepared.tracer.tables.handle, log.rays, alone), log.found)
    # The first ray is a probe's own.
    np.testing.assert_allclose(log.rays[0, :3], prepared.positions[0], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(log.rays[log.kinds != ANY, 4:7], axis=1), 1, rtol=1e-6)


def test_a_full_log_counts_on() -> None:
    _, counted = traced(np.arange(4), 0)
    _, log = traced(np.arange(4), 100)
    _, whole = traced(np.arange(4), int(counted.asked[0]))
    assert log.asked[0] == counted.asked[0]
    np.testing.assert_array_equal(log.rays, whole.rays[:100])


def test_an_order_is_one_of_all_rays_octant_by_octant() -> None:
    random = np.random.default_rng(0)
    rays = random.normal(size=(1000, 8)).astype(np.float32)
    order = coherent_order(rays)
    np.testing.assert_array_equal(np.sort(order), np.arange(1000))
    octants = (rays[order, 4:7] < 0) @ [1, 2, 4]
    assert (np.diff(octants) >= 0).all()
    # Neighbours in it are nearer to each other than others are.
    steps = np.linalg.norm(np.diff(rays[order, :3], axis=0), axis=1)
    assert np.median(steps) < 0.6 * np.median(np.linalg.norm(rays[1:, :3] - rays[:-1, :3], axis=1))
