"""The irradiance query against what can be said without it: constants, single probes, symmetry, dead probes, leaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bake_core import irradiance
from bake_core.bundle import VolumeData
from bake_core.octahedral import texel_directions
from tests.conformance import synthetic


def filled(volume: VolumeData, output: str, texels: np.ndarray) -> VolumeData:
    """The volume with an atlas replaced: texels (probes, n, n, channels) or what broadcasts to it."""
    n, channels = volume.atlases[output].interior, volume.atlases[output].texels.shape[-1]
    whole = np.broadcast_to(texels, (len(volume.states), n, n, channels))
    counts = (int(volume.counts[0]), int(volume.counts[1]), int(volume.counts[2]))
    return replace(volume, atlases={**volume.atlases, output: synthetic.atlas(output, whole, counts)})


def in_the_open(counts: tuple[int, int, int] = (3, 3, 3), n: int = 8) -> VolumeData:
    """Spacing 1, every probe sees everything."""
    volume = synthetic.volume("open", (0, 0, 0), (1, 1, 1), counts, n=n)
    return filled(volume, "walls", np.array([0.0]))


def test_the_same_light_everywhere_is_answered_everywhere() -> None:
    volumes = tuple(filled(v, "irradiance", np.array([3.0, 1.0, 0.25])) for v in synthetic.volumes())
    positions, normals, wo = synthetic.points(500)
    found = irradiance.sample(volumes, positions, normals, wo)
    alive = found.weights.any(-1)
    assert alive.mean() > 0.5  # one cell of the synthetic volumes holds dead probes only
    np.testing.assert_allclose(found.irradiance[alive], np.broadcast_to([3.0, 1.0, 0.25], (alive.sum(), 3)), rtol=1e-12)
    np.testing.assert_allclose(found.weights[alive].sum(-1), 1, rtol=1e-12)


def test_at_a_probe_the_answer_is_the_probes_own() -> None:
    """Whatever its neighbours hold, and although its walls say that it is not seen."""
    volume = synthetic.volume("v", (-1, 2, 5), (0.5, 2, 1), (3, 4, 2), seed=4)
    index = np.stack(np.unravel_index(np.arange(24), (2, 4, 3))[::-1], -1)
    found = irradiance.sample((volume,), volume.origin + volume.spacing * index, np.tile([0.0, 0.6, 0.8], (24, 1)))
    np.testing.assert_array_equal(found.probes[np.arange(24), found.weights.argmax(-1)], np.arange(24))
    np.testing.assert_array_equal(found.weights.max(-1), 1)


def test_a_tent_stands_on_its_probe_and_ends_at_the_lattice_points_about_its_own() -> None:
    random = np.random.default_rng(3)
    offset = random.uniform(-0.45, 0.45, (200, 3))
    np.testing.assert_allclose(irradiance.tent(offset, offset), 1, rtol=1e-15)
    points = random.uniform(-1, 1, (200, 3))
    np.testing.assert_allclose(irradiance.tent(points, 0 * offset), (1 - np.abs(points)).prod(-1), rtol=1e-12)
    for axis in range(3):
        for side in (-1.0, 1.0):
            edge = np.where(np.arange(3) == axis, side, points)
            np.testing.assert_allclose(irradiance.tent(edge, offset), 0, atol=1e-15)


def test_answers_of_moved_probes_change_without_a_step_from_cell_to_cell() -> None:
    """On both sides of every lattice plane, as close as numbers go; at a lattice point its own probe answers alone."""
    volume = in_the_open((4, 4, 4))
    random = np.random.default_rng(4)
    volume = filled(volume, "irradiance", random.uniform(1, 2, (64, 1, 1, 3)))
    volume = replace(volume, offsets=random.uniform(-0.45, 0.45, (64, 3)).astype(np.float32))
    planes = random.integers(1, 3, (300, 1))
    points = np.where(np.arange(3) == random.integers(0, 3, (300, 1)), planes, random.uniform(0, 3, (300, 3)))
    up = np.tile([0.0, 1.0, 0.0], (300, 1))
    below, above = (irradiance.sample((volume,), points + step, up).irradiance for step in (-1e-9, 1e-9))
    np.testing.assert_allclose(below, above, rtol=1e-7)
    np.testing.assert_allclose(irradiance.sample((volume,), [[1.0, 2.0, 1.0]], [[0.0, 1.0, 0.0]]).weights.max(), 1, rtol=1e-12)


def test_in_the_open_light_that_varies_linearly_is_interpolated_linearly() -> None:
    """With a normal across the gradient, facing weights of the two sides are alike and only the trilinear weights differ."""
    volume = in_the_open((3, 1, 1))
    volume = filled(volume, "irradiance", np.arange(3.0).reshape(3, 1, 1, 1) + 1)
    x = np.linspace(0, 2, 21)
    positions = np.stack([x, np.zeros(21), np.zeros(21)], -1)
    found = irradiance.sample((volume,), positions, np.tile([0.0, 1.0, 0.0], (21, 1)))
    np.testing.assert_allclose(found.irradiance[:, 0], x + 1, rtol=1e-12)


def test_a_wall_between_probes_keeps_the_other_sides_light_out() -> None:
    """A wall at x = 0.5 seen from x = 0 and x = 1; dark to the left, lit to the right. Plain trilinear would give half."""
    volume = in_the_open((2, 2, 2), n=16)
    towards = texel_directions(16)
    lit = np.array([0.0, 1.0] * 4).reshape(8, 1, 1, 1)
    side = np.where(lit > 0, -1.0, 1.0)
    cosine = np.maximum(side[..., 0] * towards[..., 0], 1e-6)
    distance = np.minimum(0.5 / cosine, volume.distance_limit)
    volume = filled(volume, "irradiance", lit)
    volume = filled(volume, "walls", 1 / (distance * np.abs(towards).sum(-1))[..., None])
    leaked = irradiance.sample((volume,), [[0.499, 0.5, 0.5]], [[-1.0, 0.0, 0.0]]).irradiance[0, 0]
    assert 0 < leaked < 1e-4
    away = irradiance.sample(
        (replace(volume, atlases={"irradiance": volume.atlases["irradiance"]}),), [[0.499, 0.5, 0.5]], [[0.0, 1.0, 0.0]]
    )
    assert away.irradiance[0, 0] == pytest.approx(0.499, abs=1e-3)


def test_dead_probes_have_no_weight_and_a_dead_cell_is_dark() -> None:
    volume = in_the_open((2, 2, 2))
    states = np.array([1, 0, 1, 0, 0, 0, 0, 0], np.uint8)
    found = irradiance.sample((replace(volume, states=states),), [[0.3, 0.4, 0.6]], [[0.0, 1.0, 0.0]])
    assert set(np.flatnonzero(found.weights[0])) == {0, 2}
    assert found.weights.sum() == pytest.approx(1)
    dark = irradiance.sample((replace(volume, states=np.zeros(8, np.uint8)),), [[0.3, 0.4, 0.6]], [[0.0, 1.0, 0.0]])
    assert not dark.weights.any()
    assert not dark.irradiance.any()


def test_exactly_at_a_dead_probe_its_neighbours_answer() -> None:
    """Trilinear weights leave only the dead probe there; the answer must not be black on a set of points of measure zero."""
    volume = in_the_open((2, 2, 2))
    volume = filled(replace(volume, states=np.array([0, 1, 1, 1, 1, 1, 1, 1], np.uint8)), "irradiance", np.array(2.0))
    found = irradiance.sample((volume,), [[0.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    np.testing.assert_allclose(found.irradiance[0], 2)


def test_points_outside_are_answered_by_the_nearest_cell_of_the_nearest_volume() -> None:
    a, b = in_the_open(), replace(in_the_open(), origin=np.array([10.0, 0, 0]))
    found = irradiance.sample((a, b), np.array([[5.5, 1, 1], [6.5, 1, 1], [1, 1, -1e9], [11, 1, 1]]), np.tile([0.0, 1.0, 0.0], (4, 1)))
    np.testing.assert_array_equal(found.volume, [0, 1, 0, 1])
    np.testing.assert_array_equal(found.probes[0][found.weights[0] > 0], [14])
    np.testing.assert_array_equal(found.probes[2][found.weights[2] > 0], [4])


def test_where_volumes_overlap_the_finest_answers_and_the_first_of_equals() -> None:
    whole, part = in_the_open(), replace(in_the_open((2, 2, 2)), origin=np.array([0.5, 0.5, 0.5]))
    inside = np.array([[0.75, 0.75, 0.75], [0.25, 0.25, 0.25]])
    np.testing.assert_array_equal(irradiance.select_volume((part, whole), inside), [0, 1])
    np.testing.assert_array_equal(irradiance.select_volume((whole, part), inside), [0, 0])
    fine = replace(part, spacing=np.full(3, 0.5))
    np.testing.assert_array_equal(irradiance.select_volume((whole, fine), inside), [1, 0])


def test_a_fine_volume_fades_into_the_coarse_one_around_it() -> None:
    """The fine one holds 2, the coarse one 1; half a fine spacing beyond the fine box nothing is left of it, and there is no step."""
    coarse = filled(in_the_open((5, 5, 5)), "irradiance", np.array(1.0))
    fine = filled(in_the_open((3, 3, 3)), "irradiance", np.array(2.0))
    fine = replace(fine, origin=np.full(3, 1.0), spacing=np.full(3, 0.5))
    x = np.linspace(0, 4, 401)
    positions = np.stack([x, np.full(401, 1.5), np.full(401, 1.5)], -1)
    for volumes in ((coarse, fine), (fine, coarse)):
        found = irradiance.sample(volumes, positions, np.tile([0.0, 1.0, 0.0], (401, 1)))
        expected = 1 + np.clip(np.minimum(x - 0.75, 2.25 - x) / 0.25, 0, 1)
        np.testing.assert_allclose(found.irradiance[:, 0], expected, rtol=1e-12)
        np.testing.assert_allclose(found.weights.sum(-1), 1, rtol=1e-12)
        assert found.weights.shape == (401, 16)
        assert set(found.volume) == {0, 1}


def test_a_volume_with_no_probe_about_a_point_leaves_it_to_the_next() -> None:
    """All of the fine one's probes are inside geometry: the coarse one has the whole answer, wherever the fine one fades."""
    coarse = filled(in_the_open((5, 5, 5)), "irradiance", np.array(1.0))
    fine = synthetic.volume("fine", (1, 1, 1), (0.5, 0.5, 0.5), (3, 3, 3), seed=1, inactive=tuple(range(27)))
    x = np.linspace(0, 4, 41)
    positions = np.stack([x, np.full(41, 1.5), np.full(41, 1.5)], -1)
    found = irradiance.sample((coarse, fine), positions, np.tile([0.0, 1.0, 0.0], (41, 1)))
    np.testing.assert_allclose(found.irradiance, 1, rtol=1e-15)
    assert found.weights.shape == (41, 8)
    assert not found.volumes.any()


def test_neighbours_fade_into_each_other_and_the_nearest_answers_beyond_both() -> None:
    """Two volumes side by side: the first has its own box, the second's half a spacing beyond it changes hands without a step."""
    a = filled(in_the_open((3, 3, 3)), "irradiance", np.array(1.0))
    b = replace(filled(in_the_open((3, 3, 3)), "irradiance", np.array(3.0)), origin=np.array([2.0, 0, 0]))
    x = np.array([1.0, 2.0, 2.25, 2.5, 4.0, 4.4, 9.0, -9.0])
    found = irradiance.sample((a, b), np.stack([x, np.ones(8), np.ones(8)], -1), np.tile([0.0, 1.0, 0.0], (8, 1)))
    np.testing.assert_allclose(found.irradiance[:, 0], [1, 1, 2, 3, 3, 3, 3, 1], rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e6])
def test_the_answer_does_not_depend_on_the_unit_of_length(scale: float) -> None:
    volume = synthetic.volume("v", (-1, 0, 0), (1, 1, 1), (3, 3, 3), seed=5)
    scaled = replace(
        volume,
        origin=volume.origin * scale,
        spacing=volume.spacing * scale,
        distance_limit=volume.distance_limit * scale,
    )
    positions = np.stack([synthetic.sequence(100, k * 100) for k in range(3)], -1) * 2 - [1, 0, 0]
    normals = np.tile([0.36, 0.48, 0.8], (100, 1))
    here, there = irradiance.sample((volume,), positions, normals), irradiance.sample((scaled,), positions * scale, normals)
    np.testing.assert_allclose(here.irradiance, there.irradiance, rtol=1e-4)


def test_irradiance_follows_the_normal_and_errs_as_bilinear_interpolation_does() -> None:
    """E = π (1 + n.y / 2): off the octahedron's folds the error falls with the square of a texel's width, at the folds with the width."""
    _, normals, _ = synthetic.points(300)
    worst, typical = [], []
    for n in (8, 16, 32):
        volume = in_the_open((2, 2, 2), n=n)
        volume = filled(volume, "irradiance", np.pi * (1 + texel_directions(n)[None, :, :, 1:2] / 2))
        found = irradiance.sample((volume,), np.tile([0.3, 0.4, 0.6], (len(normals), 1)), normals)
        error = np.abs(found.irradiance[:, 0] - np.pi * (1 + normals[:, 1] / 2)) / np.pi
        worst.append(error.max())
        typical.append(np.median(error))
    assert worst[0] < 0.04
    assert worst[0] > 1.5 * worst[1] > 2.25 * worst[2]
    assert typical[0] > 2.5 * typical[1] > 6.25 * typical[2]


def test_a_point_half_a_spacing_outside_is_still_covered() -> None:
    volume = in_the_open((3, 1, 1))
    points = [[-0.5, 0, 0], [2.5, 0.5, -0.5], [-0.6, 0, 0], [1, 0.6, 0], [1, 0, np.nan]]
    assert irradiance.covered((volume,), points).tolist() == [True, True, False, False, False]
