"""Receivers are uniform over the area that can be seen, and nowhere else."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.errors import Cancelled
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.receivers import Receivers, draw_receivers, volume_boxes
from bake_core.scene import Scene
from bake_core.surface_sampling import Places, SurfaceSampler
from tests.pictures import png
from tests.receivers import volume
from tests.scenes import QUAD, SQUARE, add_square, build, load

Array = NDArray[Any]
EVERYWHERE = np.array([[[-1e9] * 3, [1e9] * 3]])


def box_part(low: tuple[float, float, float], high: tuple[float, float, float], material: int, *, inwards: bool = False) -> Part:
    """The six sides of a box."""
    corner = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)], np.float64)
    sides = [corner[list(s)] for s in ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))]
    sides = sides if inwards else [s[::-1] for s in sides]
    return Part(np.concatenate(sides), np.concatenate([QUAD + 4 * i for i in range(6)]), material=material)


def world(scene: Scene, places: Places) -> Array:
    """World positions, from the scene's arrays alone."""
    transforms = np.concatenate([np.eye(3, 4)[None], scene.instance_transform])
    first = scene.mesh_first_triangle[np.concatenate([[0], scene.instance_mesh])]
    v = scene.positions[scene.indices[first[places.items] + places.triangles]].astype(np.float64)
    b = places.barycentrics
    local = v[:, 0] + b[:, :1] * (v[:, 1] - v[:, 0]) + b[:, 1:] * (v[:, 2] - v[:, 0])
    m = transforms[places.items]
    out: Array = (m[:, :, :3] @ local[..., None])[..., 0] + m[:, :, 3] + scene.origin
    return out


def assert_even(found: Array, shares: Array) -> None:
    """Pearson's χ² of counts against shares: below the mean of its distribution plus four standard deviations."""
    expected = shares / shares.sum() * found.sum()
    assert expected.min() > 20, "too few to tell"
    chi2 = float(((found - expected) ** 2 / expected).sum())
    freedom = len(found) - 1
    assert chi2 < freedom + 4 * math.sqrt(2 * freedom), (found, expected)


def uneven_scene() -> Scene:
    """A mesh used three times, once mirrored and once sheared, and a double-sided square of its own."""
    w = GlbWriter()
    shape = Part(np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 3.0]]), np.array([[0, 1, 2], [0, 2, 3]]), material=w.material("m"))
    mesh = w.mesh("shape", [shape])
    w.node(mesh=mesh)
    w.node(mesh=mesh, scale=(-2, 0.5, 1), translation=(10, 0, 0))
    sheared = np.eye(4)
    sheared[0, 1], sheared[1, 3] = 0.7, 20
    w.node(mesh=mesh, matrix=sheared)
    add_square(w, "both", matrix=np.diag([3.0, 1, 1, 1]), double_sided=True)
    return load(w)


def test_places_are_uniform_over_instances_triangles_and_sides() -> None:
    scene = uneven_scene()
    places = SurfaceSampler(scene, build(scene), EVERYWHERE, 1).draw(0, 1 << 13)
    assert len(places.items) == 1 << 13
    key = (places.items * 4 + places.triangles) * 2 + places.back
    transforms = np.concatenate([np.eye(3, 4)[None], scene.instance_transform])
    meshes = np.concatenate([[0], scene.instance_mesh])
    areas: dict[int, float] = {}
    for item, (mesh, m) in enumerate(zip(meshes, transforms, strict=True)):
        first, end = scene.mesh_first_triangle[mesh : mesh + 2]
        for triangle in range(end - first):
            a, b, c = scene.positions[scene.indices[first + triangle]].astype(np.float64) @ m[:, :3].T
            area = float(np.linalg.norm(np.cross(b - a, c - a))) / 2
            for back in range(1 + int(scene.materials.double_sided[scene.triangle_material[first + triangle]])):
                areas[(item * 4 + triangle) * 2 + back] = area
    assert set(key.tolist()) == set(areas)
    assert_even(np.array([(key == k).sum() for k in areas]), np.array([*areas.values()]))


def test_places_are_uniform_within_what_a_box_leaves_of_a_triangle() -> None:
    """A square cut on all sides, whose diagonal runs through: cells of equal area hold equally many."""
    scene = load_squares((np.eye(4),))
    box = np.array([[[-0.4, -1, -0.3], [0.2, 1, 0.45]]])
    sampler = SurfaceSampler(scene, build(scene), box, 2)
    assert sampler.area == pytest.approx(0.6 * 0.75, rel=1e-6)
    at = world(scene, sampler.draw(0, 1 << 12))
    assert ((at >= box[0, 0] - 1e-6) & (at <= box[0, 1] + 1e-6)).all()
    cells = np.histogram2d(at[:, 0], at[:, 2], bins=(6, 5), range=((-0.4, 0.2), (-0.3, 0.45)))[0].ravel()
    assert_even(cells, np.ones(30))


def load_squares(matrices: tuple[Array, ...], **material: Any) -> Scene:
    w = GlbWriter()
    for i, matrix in enumerate(matrices):
        add_square(w, f"square {i}", matrix=matrix, **material)
    return load(w)


def test_a_box_that_holds_a_millionth_of_the_area_is_filled_all_the_same() -> None:
    scene = load_squares((np.diag([1000.0, 1, 1000, 1]),))
    box = np.array([[[100.25, -0.5, 30.5], [101.25, 0.5, 31.5]]])
    sampler = SurfaceSampler(scene, build(scene), box, 3)
    places = sampler.draw(0, 1000)
    assert sampler.area == pytest.approx(1, rel=1e-4)
    assert len(places.items) == 1000
    at = world(scene, places)
    assert ((at >= box[0, 0] - 1e-3) & (at <= box[0, 1] + 1e-3)).all()
    assert np.histogram(at[:, 0], bins=10, range=(100.25, 101.25))[0].min() > 70


def test_where_boxes_overlap_nothing_counts_twice() -> None:
    scene = load_squares((np.diag([10.0, 1, 10, 1]),))
    boxes = np.array([[[-2, -1, -1], [1, 1, 1]], [[-1, -1, -1], [2, 1, 1.0]]])
    at = world(scene, SurfaceSampler(scene, build(scene), boxes, 4).draw(0, 1 << 12))
    assert_even(np.histogram(at[:, 0], bins=8, range=(-2, 2))[0], np.ones(8))


def test_a_surface_in_the_plane_of_a_box_is_inside() -> None:
    scene = load_squares((np.eye(4),))
    assert SurfaceSampler(scene, build(scene), np.array([[[-1, 0, -1], [1, 1, 1]]]), 0).area == pytest.approx(1)
    assert SurfaceSampler(scene, build(scene), np.array([[[-1, 0.001, -1], [1, 1, 1]]]), 0).area == 0


def test_nothing_is_drawn_where_a_surface_is_cut_out_and_less_where_it_is_blended() -> None:
    w = GlbWriter()
    pixels = np.full((1, 2, 4), 255, np.uint8)
    pixels[0, 1, 3] = 0
    cut = w.material("cut", alpha_mode="MASK", base_color_texture=w.texture(png(pixels), nearest=True))
    veil = w.material("veil", alpha_mode="BLEND", alpha=0.25)
    corners = [[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]
    w.node(mesh=w.mesh("cut", [Part(SQUARE, QUAD, uvs=[corners], material=cut)]))
    w.node(mesh=w.mesh("veil", [Part(SQUARE + [0, 1, 0], QUAD, material=veil)]))
    w.node(mesh=w.mesh("whole", [Part(SQUARE + [0, 2, 0], QUAD, material=w.material("whole"))]))
    scene = load(w)
    at = world(scene, SurfaceSampler(scene, build(scene), EVERYWHERE, 5).draw(0, 1 << 13))
    assert (at[at[:, 1] < 0.5, 0] < 0).all()
    assert_even(np.histogram(at[:, 1], bins=3, range=(-0.5, 2.5))[0], np.array([0.5, 0.25, 1]))


# --- which of them count -----------------------------------------------------------------------------------------------------------


def drawn(writer: GlbWriter, *volumes: Any, count: int = 600, **more: Any) -> Receivers:
    scene = load(writer)
    return draw_receivers(scene, build(scene), volumes, count, 7, **more)


ROOM = volume([-1.5, 0.5, -1.5], [1.0, 1.0, 1.0], [4, 2, 4])


def room() -> GlbWriter:
    """A room of 4 × 2 × 4 m with single-sided walls, probes half a metre from them."""
    w = GlbWriter()
    w.node(mesh=w.mesh("room", [box_part((-2, 0, -2), (2, 2, 2), w.material("wall"), inwards=True)]))
    return w


def test_a_room_counts_as_a_whole_its_floor_under_a_box_does_not() -> None:
    plain = drawn(room(), ROOM)
    assert (len(plain), plain.behind, plain.unseen) == (600, 0, 0)
    w = room()
    w.node(mesh=w.mesh("box", [box_part((0, 0, 0), (1, 1, 1), w.material("box"))]))
    r = drawn(w, ROOM)
    hidden = (
        (r.positions[:, 1] < 1e-6) & (r.positions[:, 0] > 0) & (r.positions[:, 0] < 1) & (r.positions[:, 2] > 0) & (r.positions[:, 2] < 1)
    )
    assert not hidden.any()
    # The floor under it, and its own bottom, which looks at the floor's back: 2 of 64 + 6 m².
    assert 0.5 < (r.behind + r.unseen) / (len(r) + r.behind + r.unseen) / (2 / 70) < 1.5


def test_normals_are_those_of_the_side_that_is_looked_at() -> None:
    w = GlbWriter()
    add_square(w, double_sided=True)
    r = drawn(w, volume([-0.5, -0.5, -0.5], [1, 1, 1], [2, 2, 2]))
    np.testing.assert_array_equal(r.normals[:, 1], np.where(r.places.back, -1, 1))
    np.testing.assert_array_equal(r.geometric_normals, r.normals)
    assert 250 < r.places.back.sum() < 350
    assert not r.materials.any()


def test_a_mirrored_instance_keeps_its_front() -> None:
    w = GlbWriter()
    mesh = w.mesh("square", [Part(SQUARE, QUAD, material=w.material("m"))])
    w.node(mesh=mesh, translation=(2, 0, 0))
    w.node(mesh=mesh, scale=(-1, 1, 1))
    r = drawn(w, volume([-1, -0.5, -1], [1, 1, 1], [5, 2, 3]))
    assert set(r.places.items.tolist()) == {1, 2}
    np.testing.assert_allclose(r.normals, np.broadcast_to([0.0, 1, 0], r.normals.shape))


def test_the_inside_of_a_closed_slab_that_is_double_sided_is_left_out() -> None:
    """There is no back face to tell by. Where the probes stand inside, it is the outside that nobody sees."""
    w = GlbWriter()
    w.node(mesh=w.mesh("slab", [box_part((-2, -0.2, -2), (2, 0.2, 2), w.material("white", double_sided=True))]))
    around = drawn(w, volume([-2.5, -0.5, -2.5], [1, 1, 1], [6, 2, 6]))
    inside = drawn(w, volume([-1.5, 0, -1.5], [1, 1, 1], [4, 1, 4]))
    for r, side in ((around, 1), (inside, -1)):
        assert len(r) == 600
        assert (np.sign((r.positions * r.normals).sum(1)) == side).all()
        assert 500 < r.unseen < 700
        assert r.behind == 0


def test_around_one_corner_counts_and_around_two_does_not() -> None:
    """Behind a screen that stops short of the ceiling there is light by way of the gap; with a lid on the gap there is none."""
    probes = volume([-0.5, 0.5, -1.5], [1, 1, 1], [3, 2, 4])
    behind_screen = [[[-2.1, -0.1, -2.1], [-1.45, 1.1, 2.1]]]
    w = room()
    screen = w.material("screen")
    w.node(mesh=w.mesh("screen", [box_part((-1.4, 0, -2), (-1.35, 1.2, 2), screen)]))
    open_nook = drawn(w, probes, boxes=behind_screen)
    assert len(open_nook) == 600
    assert open_nook.unseen < 60
    w.node(mesh=w.mesh("lid", [box_part((-2, 1.2, -2), (-1.35, 1.25, 2), screen)]))
    assert len(drawn(w, probes, boxes=behind_screen)) == 0


def test_a_room_without_an_active_probe_is_seen_by_nobody() -> None:
    none = drawn(room(), volume(ROOM.origin, ROOM.spacing, ROOM.counts, active=False))
    assert len(none) == 0
    assert none.unseen == 16 * 600


def test_boxes_can_be_given_apart_from_the_volumes() -> None:
    r = drawn(room(), ROOM, boxes=[[[-2.1, -0.1, -2.1], [-1.9, 2.1, 2.1]]])
    assert r.positions[:, 0].max() < -1.9 + 1e-6
    np.testing.assert_allclose(volume_boxes([ROOM]), [[[-2, 0, -2], [2, 2, 2]]], atol=1e-4)


def test_points_are_the_same_every_time_and_wherever_the_scene_stands() -> None:
    here, again = drawn(room(), ROOM), drawn(room(), ROOM)
    np.testing.assert_array_equal(here.positions, again.positions)
    w = GlbWriter()
    w.node(mesh=w.mesh("room", [box_part((-2, 0, -2), (2, 2, 2), w.material("wall"), inwards=True)]), translation=(1e6, -2e6, 3e6))
    offset = np.array([1e6, -2e6, 3e6])
    far = drawn(w, volume(ROOM.origin + offset, [1.0, 1.0, 1.0], [4, 2, 4]))
    np.testing.assert_allclose(far.positions - offset, here.positions, atol=1e-5)


def test_no_surface_and_cancelling() -> None:
    w = GlbWriter()
    add_square(w)
    nothing = drawn(w, volume([10, 10, 10], [1, 1, 1], [2, 2, 2]))
    assert (len(nothing), nothing.behind, nothing.unseen) == (0, 0, 0)
    assert nothing.positions.shape == nothing.normals.shape == (0, 3)
    assert len(drawn(GlbWriter(), ROOM)) == 0
    with pytest.raises(Cancelled):
        drawn(room(), ROOM, cancelled=np.ones(1, np.uint8))
