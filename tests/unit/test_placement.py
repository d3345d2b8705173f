"""Where probes stand: grids given outright, fitted to a scene and fitted to a node."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.errors import SpecError
from bake_core.gltf.writer import GlbWriter
from bake_core.placement import Volume, place
from bake_core.scene import Scene
from bake_core.spec import parse_spec
from tests.scenes import add_square, load

Array = NDArray[Any]


def room() -> Scene:
    """Bounds (1, 2, 3) to (5, 4, 13)."""
    w = GlbWriter()
    for y in (2.0, 4.0):
        matrix = np.diag([4.0, 1.0, 10.0, 1.0])
        matrix[:3, 3] = 3, y, 8
        add_square(w, f"at {y}", matrix=matrix)
    return load(w)


def one(scene: Scene, **volume: Any) -> Volume:
    (placed,) = place(scene, parse_spec({"volumes": [volume]}))
    return placed


def test_given_outright() -> None:
    v = one(room(), origin=[1, 2, 3], spacing=[0.5, 1, 2], counts=[2, 3, 4])
    assert (v.name, v.counts, v.probe_count) == ("v0", (2, 3, 4), 24)
    positions = v.positions()
    for flat in range(24):
        i, j, k = flat % 2, flat // 2 % 3, flat // 6
        np.testing.assert_array_equal(positions[flat], [1 + 0.5 * i, 2 + j, 3 + 2 * k])
    assert v.distance_limit == pytest.approx(1.5 * math.sqrt(0.25 + 1 + 4))


def test_fit_scene_with_counts_spans_the_bounds_grown_by_one_percent_a_side() -> None:
    v = one(room(), fit="scene", counts=[5, 3, 11])
    np.testing.assert_allclose(v.origin, [1 - 0.04, 2 - 0.02, 3 - 0.1], rtol=1e-12)
    np.testing.assert_allclose(v.positions()[-1], [5 + 0.04, 4 + 0.02, 13 + 0.1], rtol=1e-12)


def test_fit_scene_with_spacing_covers_the_grown_bounds_and_is_centred() -> None:
    v = one(room(), fit="scene", spacing=[1, 2, 3])
    size = np.array([4, 2, 10]) * 1.02
    expected = np.ceil(size / [1, 2, 3]) + 1
    assert v.counts == tuple(expected)
    np.testing.assert_allclose((v.origin + v.positions()[-1]) / 2, [3, 3, 8], rtol=1e-12)
    assert (v.origin <= [0.96, 1.98, 2.9]).all() and (v.positions()[-1] >= [5.04, 4.02, 13.1]).all()


def test_a_size_that_spacing_divides_takes_no_probe_too_many() -> None:
    """4.08 m at 0.408 m is 10 cells, whatever float64 makes of the quotient."""
    v = one(room(), fit="scene", spacing=[4.08 / 10, 2.04 / 7, 10.2 / 30])
    assert v.counts == (11, 8, 31)


def test_one_probe_on_an_axis_stands_in_the_middle() -> None:
    v = one(room(), fit="scene", counts=[1, 1, 3])
    np.testing.assert_allclose(v.positions()[:, :2], [[3, 3]] * 3)
    assert (v.spacing > 0).all()


def test_a_flat_scene_is_fitted_all_the_same() -> None:
    w = GlbWriter()
    add_square(w)
    v = one(load(w), fit="scene", counts=[2, 2, 2])
    assert (v.spacing > 0).all() and np.isfinite(v.positions()).all()
    v = one(load(w), fit="scene", spacing=[0.5, 0.5, 0.5])
    assert v.counts[1] == 1 and v.origin[1] == 0


def test_fit_scene_without_geometry_is_refused() -> None:
    w = GlbWriter()
    w.node("empty")
    with pytest.raises(SpecError) as caught:
        one(load(w), fit="scene", counts=[2, 2, 2])
    assert (caught.value.slug, caught.value.where) == ("spec.no_geometry", "volumes[0]")


def noded(matrix: Array, name: str = "grid") -> Scene:
    w = GlbWriter()
    w.node(name, matrix=matrix)
    add_square(w)
    return load(w)


def turned(axis: int, quarter: int) -> Array:
    """A turn by quarters of a circle about an axis, exact."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter % 4]
    m = np.eye(4)
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    m[a, a], m[a, b], m[b, a], m[b, b] = c, -s, s, c
    return m


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_fit_node_follows_quarter_turns(axis: int, quarter: int) -> None:
    """First and last probes on the faces of the node's cube; counts go with the node's axes, spacing and order with the world's."""
    size, counts = np.array([2.0, 4.0, 6.0]), (2, 3, 4)
    matrix = np.eye(4)
    matrix[:3, 3] = 10, 20, 30
    matrix = matrix @ turned(axis, quarter) @ np.diag([*size, 1])
    v = one(noded(matrix), fit="node", node="grid", counts=list(counts))
    local = (np.linalg.inv(matrix) @ np.concatenate([v.positions(), np.ones((24, 1))], 1).T).T[:, :3]
    np.testing.assert_allclose(local.min(0), -0.5, atol=1e-6)
    np.testing.assert_allclose(local.max(0), 0.5, atol=1e-6)
    # The node's own lattice, as a set.
    lattice = np.stack(np.meshgrid(*(np.linspace(-0.5, 0.5, n) for n in counts), indexing="ij"), -1).reshape(-1, 3)
    assert {tuple(p) for p in np.round(local, 5)} == {tuple(p) for p in np.round(lattice, 5)}
    assert (v.spacing > 0).all()
    np.testing.assert_allclose(v.origin, v.positions().min(0))


def test_fit_node_with_a_mirrored_node_and_one_probe_on_an_axis() -> None:
    matrix = np.diag([-2.0, 3.0, 4.0, 1.0])
    matrix[:3, 3] = 1, 1, 1
    v = one(noded(matrix), fit="node", node="grid", counts=[3, 1, 2])
    np.testing.assert_allclose(v.origin, [0, 1, -1], atol=1e-6)
    np.testing.assert_allclose(v.positions()[-1], [2, 1, 3], atol=1e-6)


@pytest.mark.parametrize(
    "linear",
    [
        [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]],  # turned by 37°
        [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]],  # sheared
        [[1, 0, 0], [0, 0, 0], [0, 0, 1]],  # no size
        [[0.9999, -0.01, 0], [0.01, 0.9999, 0], [0, 0, 1]],  # turned by half a degree
    ],
)
def test_fit_node_refuses_other_turns_and_shears(linear: list[list[float]]) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    with pytest.raises(SpecError) as caught:
        one(noded(matrix), fit="node", node="grid", counts=[2, 2, 2])
    assert (caught.value.slug, caught.value.where) == ("spec.node_not_aligned", "volumes[0].node")


def test_fit_node_needs_one_node_of_that_name() -> None:
    with pytest.raises(SpecError) as caught:
        one(noded(np.eye(4)), fit="node", node="gird", counts=[2, 2, 2])
    assert caught.value.slug == "spec.unknown_node" and "'grid'" in caught.value.message
    w = GlbWriter()
    w.node("grid")
    w.node("grid")
    add_square(w)
    with pytest.raises(SpecError) as caught:
        one(load(w), fit="node", node="grid", counts=[2, 2, 2])
    assert caught.value.slug == "spec.unknown_node" and "2 nodes" in caught.value.message


def test_too_many_probes_together_or_fitted() -> None:
    grid = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [4096, 1024, 4]}
    with pytest.raises(SpecError) as caught:
        place(room(), parse_spec({"volumes": [grid, grid]}))
    assert caught.value.slug == "spec.too_many_probes"
    for spacing in ([1e-3, 1e-3, 1e-3], [1e-12, 1, 1], [1e-300, 1e-300, 1e-300]):
        with pytest.raises(SpecError) as caught:
            one(room(), fit="scene", spacing=spacing)
        assert caught.value.slug == "spec.too_many_probes" and "volumes" in caught.value.where
