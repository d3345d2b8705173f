"""The light tree: its chances are those that it says, none that a point may get light of is left out, and the light stays what it was."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.examples import lamp_corridor
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.kernels import entry_kernel
from bake_core.light_tree import FEWEST_EMITTERS, emitter_share, importance, pick_emitter
from bake_core.tracer import Tracer
from tests.baking import prepared, traced
from tests.reference.light_tree_table import lamps_on_a_ceiling, race
from tests.scenes import QUAD, SQUARE, add_square, build

Array = NDArray[Any]


@entry_kernel
def _pick(t, p, w, emitter, share):  # type: ignore[no-untyped-def]
    for i in range(w.shape[0]):
        emitter[i], share[i], _ = pick_emitter(t, (p[0], p[1], p[2]), w[i])


@entry_kernel
def _shares(t, p, item, triangle, share):  # type: ignore[no-untyped-def]
    for i in range(share.shape[0]):
        share[i] = emitter_share(t, item[i], triangle[i], (p[0], p[1], p[2]))


@entry_kernel
def _importances(nodes, p, found):  # type: ignore[no-untyped-def]
    for i in range(found.shape[0]):
        found[i] = importance(nodes, i, (p[0], p[1], p[2]))


def lamps_about() -> Tracer:
    """Lamps of all sizes, turned anyhow; some shine from both sides, one hardly at all; a mesh of two of them stands in three places."""
    rng = np.random.default_rng(7)
    w = GlbWriter()
    for i in range(20):
        matrix = np.eye(4)
        axis, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix[:3, :3], matrix[:3, 3] = axis * rng.uniform(0.1, 2), rng.uniform(-5, 5, 3)
        add_square(
            w, f"lamp {i}", (0.0,) * 3, matrix=matrix, emission=(float(rng.uniform(0.1, 5)) if i else 1e-24,) * 3, double_sided=i % 5 == 0
        )
    glow = w.material("glow", (0.0,) * 3, emission=(2.0,) * 3)
    dark = w.material("dark", (0.5,) * 3)
    mesh = w.mesh("two", [Part(SQUARE, QUAD, material=dark), Part(SQUARE + [0, 1, 0], QUAD, material=glow)])
    # Mirrored, flattened to nothing, and enlarged.
    for scale, at in (((-1, 1, 1), (7, 0, 0)), ((0, 1, 1), (0, 7, 0)), ((3, 3, 3), (-9, 0, 0))):
        matrix = np.diag([*map(float, scale), 1.0])
        matrix[:3, 3] = at
        w.node(mesh=mesh, matrix=matrix)
    return build(w)


POINTS = np.random.default_rng(3).uniform(-8, 8, (64, 3))


@pytest.fixture(scope="module")
def about() -> Tracer:
    return lamps_about()


def items_of(tracer: Tracer) -> tuple[Array, Array, Array]:
    """Every pair of an item and one of its triangles, and which emitter the tree takes it for."""
    t = tracer.tables
    assert t.tree is not None
    first = t.item_first_triangle
    ends = np.append(np.unique(first), len(t.corners))
    pairs = [(item, k) for item, at in enumerate(first) for k in range(at, ends[np.searchsorted(ends, at, side="right")])]
    item, triangle = np.array(pairs).T
    rank = t.tree.lookup[len(first) + triangle]
    emitter = np.where(rank < 0, -1, t.tree.lookup[np.where(rank < 0, 0, t.tree.lookup[item] + rank)])
    return item, triangle, emitter


def powers(tracer: Tracer) -> Array:
    """Of emitters, as the tree has them."""
    t = tracer.tables
    assert t.tree is not None
    found: Array = t.tree.nodes[len(t.tree.nodes) // 2 :, 9][: len(t.emitters.cdf)]
    assert found == pytest.approx(np.diff(t.emitters.cdf, prepend=0.0) * t.emitters.total, rel=1e-9, abs=1e-12 * t.emitters.total)
    return found


def test_every_emitter_is_found_again_by_the_item_and_the_triangle_that_a_ray_meets(about: Tracer) -> None:
    item, triangle, emitter = items_of(about)
    t = about.tables
    known = emitter >= 0
    assert sorted(emitter[known]) == list(range(len(t.emitters.cdf)))
    corners = t.corners[triangle[known], :9].reshape(-1, 3, 3).astype(np.float64)
    m = t.item_transform[item[known]]
    placed = np.einsum("nij,nkj->nki", m[:, :, :3], corners) + m[:, None, :, 3]
    assert placed == pytest.approx(t.emitters.vertices[emitter[known]])


def test_a_point_picks_each_emitter_as_often_as_a_ray_that_meets_it_is_told(about: Tracer) -> None:
    item, triangle, emitter = items_of(about)
    t, power = about.tables, powers(about)
    w = (np.arange(1 << 14) + 0.5) / (1 << 14)
    for p in POINTS:
        picked, share, told = np.zeros(len(w), np.int64), np.zeros(len(w)), np.zeros(len(item))
        _pick(t, p, w, picked, share)
        _shares(t, p, item, triangle, told)
        assert np.isfinite(told).all() and (told[emitter < 0] == 0).all()
        chance = np.zeros(len(power))
        chance[emitter[emitter >= 0]] = told[emitter >= 0] * power[emitter[emitter >= 0]]
        # A node of which a point may get something may have two of which it gets nothing.
        lit = share > 0
        assert lit.mean() == pytest.approx(chance.sum(), abs=2 * len(power) / len(w))
        assert share[lit] == pytest.approx((chance / power)[picked[lit]])
        # As an integral by the midpoint rule: no emitter's part of [0, 1) is off by more than a step at either end.
        assert np.abs(np.bincount(picked[lit], minlength=len(power)) / len(w) - chance).max() <= 2 / len(w)


def test_no_emitter_that_faces_a_point_is_left_out(about: Tracer) -> None:
    """Importance, of every node above an emitter too, is no less than each of its corners says."""
    t, power = about.tables, powers(about)
    assert t.tree is not None
    nodes, e = t.tree.nodes, t.emitters
    leaf = len(nodes) // 2
    for p in POINTS:
        found = np.zeros(len(nodes))
        _importances(nodes, p, found)
        towards = ((p - e.vertices) * e.normal[:, None]).sum(2)
        most = np.where(e.double_sided[:, None], np.abs(towards), towards).max(1)
        for i in range(len(power)):
            node = leaf + i
            for _ in range(leaf.bit_length()):
                distance = max(float(np.linalg.norm(p - nodes[node, :3])), nodes[node, 3])
                least = power[i] * min(max(most[i], 0) / distance, 1) / distance**2
                assert found[node] >= least * (1 - 1e-9), (p, i, node)
                node = (node - 1) // 2


def test_the_light_stays_what_it_was_and_its_noise_does_not() -> None:
    """Along a corridor: the mean agrees within its noise, the squared error is far less. In a small room of many lamps nothing is lost."""
    for example, least in ((lamp_corridor(64), 20.0), (lamps_on_a_ceiling(98), 1.5)):
        found = race(example, 32)
        assert abs(found.difference) < 4, found
        assert found.variances > least, found


def test_few_emitters_have_no_tree() -> None:
    """And the plan says so."""
    for lamps in (FEWEST_EMITTERS // 2 - 1, FEWEST_EMITTERS // 2):
        p = prepared(lamp_corridor(lamps), integrator="path")
        has = 2 * lamps >= FEWEST_EMITTERS
        assert (p.tracer.tables.tree is not None) is has
        assert ("code for light tree" in [x.what for x in p.left_out]) is not has


@pytest.mark.slow
def test_the_light_cache_learns_by_the_tree_too() -> None:
    p = prepared(lamp_corridor(16), integrator="cache")
    assert p.light is not None
    by_power = p.traced_with(replace(p.tracer, tables=p.tracer.tables._replace(tree=None)))
    tree, power = (traced(x, (16, 32)) for x in (p, by_power))
    errors = tree.error(), power.error()
    assert errors[0] is not None and errors[1] is not None and errors[0] < 0.5 * errors[1]
    assert tree.mean().mean() == pytest.approx(power.mean().mean(), rel=0.02)
