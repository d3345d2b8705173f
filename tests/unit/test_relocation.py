"""Probes move towards walls as the closed form says, never through one; and a bundle says where they stand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core.examples import box_sides, closed_box, cornell, quads_part, two_rooms
from bake_core.gltf.writer import GlbWriter
from bake_core.prepared import prepare
from bake_core.relocation import FARTHEST
from bake_core.relocation_trial import Trial
from bake_core.spec import parse_spec
from tests.baking import bake_example
from tests.scenes import add_square, load, load_example

# Of a spacing, of a probe half a spacing from a wall.
MOVED = 1.5 * 1.5 / 8


def moved(glb: bytes, **volume: object) -> np.ndarray:
    spec = parse_spec({"version": 1, "volumes": [volume], "probes": "relocated"})
    return np.asarray(prepare(load_example(glb), spec).offsets)


def test_a_probe_half_a_cell_from_a_wall_moves_by_more_than_a_quarter() -> None:
    """In two rooms every outermost probe has a wall half a metre off on one side of each axis: m = 3 d (d + s) / (6 d + 5 s)."""
    glb, document = two_rooms()
    found = moved(glb, **document["volumes"][0]).reshape(4, 3, 8, 3)
    np.testing.assert_allclose(found[..., 0], MOVED * np.array([-1, 0, 0, 1, -1, 0, 0, 1]) * np.ones((4, 3, 1)), atol=0.01)
    np.testing.assert_allclose(np.delete(found[..., 1], 2, 1), MOVED * np.array([-1, 0])[None, :, None] * np.ones((4, 1, 8)), atol=1e-6)
    np.testing.assert_allclose(found[:, 0, :, 2], MOVED * np.array([-1, 0, 0, 1])[:, None] * np.ones((1, 8)), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_between_two_walls_a_probe_stands_in_the_middle(scale: float) -> None:
    w = GlbWriter()
    sides = [q * scale for q in box_sides((0, 0, 0), (1, 8, 8))]
    w.node("slot", mesh=w.mesh("slot", [quads_part(sides, w.material("wall", (0.5,) * 3))]))
    found = moved(w.to_glb(), origin=[0.3 * scale, 4 * scale, 4 * scale], spacing=[scale] * 3, counts=[1, 1, 1])
    np.testing.assert_allclose(found[0] / scale, [0.2, 0, 0], atol=1e-5)


def test_backs_draw_nobody_and_double_sided_walls_do() -> None:
    """Outside of a box whose walls face inwards, there is nothing but backs; the same walls double-sided are walls."""
    for double_sided, expected in ((False, 0.0), (True, MOVED)):
        w = GlbWriter()
        wall = w.material("wall", (0.5,) * 3, double_sided=double_sided)
        w.node("box", mesh=w.mesh("box", [quads_part(box_sides((0, -9, -9), (1, 9, 9)), wall)]))
        found = moved(w.to_glb(), origin=[-0.5, 0, 0], spacing=[1, 1, 1], counts=[1, 1, 1])
        np.testing.assert_allclose(found[0], [expected, 0, 0], atol=1e-5)


def test_nobody_goes_far_or_through_anything(tmp_path: Path) -> None:
    """In the Cornell box, boxes and all: within 0.45 of a spacing, as active as before, and the bundle says where they stand."""
    glb, document = cornell()
    grid = {**document["volumes"][0], "spacing": [0.5] * 3, "counts": [4, 4, 4]}
    kept: dict[str, Any] = {"volumes": [grid], "stop": {"target_error": None, "max_samples": 4}, "outputs": ["irradiance", "visibility"]}
    still = bake_example(tmp_path, (glb, document), **kept, probes="lattice").volumes[0]
    bundle = bake_example(tmp_path, (glb, document), **kept)
    (volume,) = bundle.volumes
    assert volume.offsets.any() and (np.abs(volume.offsets) <= FARTHEST * 0.5).all()
    assert (volume.states >= still.states).all()
    told = np.array(bundle.manifest["volumes"][0]["probes"]["offsets"], np.float32)
    np.testing.assert_array_equal(told, volume.offsets)
    np.testing.assert_allclose(volume.positions() - still.positions(), volume.offsets, atol=1e-6)


def test_probes_stay_where_light_on_surfaces_is_not_what_they_are_for() -> None:
    """Maps asked for by name are of the lattice, unless both that surfaces are lit from are among them; one probe stays where it is put."""
    glb, document = cornell()
    for outputs, moves in (
        (["irradiance"], False),
        (["radiance", "irradiance"], False),
        (["visibility", "irradiance"], True),
        ("auto", True),
    ):
        spec = parse_spec({**document, "outputs": outputs})
        assert prepare(load_example(glb), spec).offsets.any() == moves
    single = {**document["volumes"][0], "counts": [1, 1, 1]}
    assert not prepare(load_example(glb), parse_spec({**document, "volumes": [single]})).offsets.any()


def test_a_column_is_no_wall() -> None:
    """Half a cell off and thinner than a quarter of that: it draws nobody, where a wall in its place does."""
    for half, expected in ((0.1, 0.0), (9.0, MOVED)):
        w = GlbWriter()
        column = w.material("column", (0.5,) * 3)
        w.node("box", mesh=w.mesh("box", [quads_part(box_sides((0.5, -9, -half), (0.7, 9, half)), column, outwards=True)]))
        found = moved(w.to_glb(), origin=[0, 0, 0], spacing=[1, 1, 1], counts=[1, 1, 1])
        np.testing.assert_allclose(found[0], [expected, 0, 0], atol=1e-5)


def grey_cube(lamp_height: float) -> bytes:
    """Of 2 m, with a lamp of 1.6 m that faces down."""
    w = GlbWriter()
    w.node("room", mesh=w.mesh("room", [quads_part(box_sides((-1, -1, -1), (1, 1, 1)), w.material("wall", (0.6,) * 3))]))
    matrix = np.diag([0.8, -1.0, 0.8, 1.0])
    matrix[1, 3] = lamp_height
    add_square(w, "lamp", (0, 0, 0), matrix=matrix, emission=(5.0, 5.0, 5.0))
    return w.to_glb()


def test_probes_stay_on_a_lattice_that_is_measured_to_be_better(tmp_path: Path) -> None:
    """Beside a lamp 1 cm below the ceiling light bends within the cell; in two rooms it does not. The bundle has both figures."""
    grid = {"origin": [-0.9] * 3, "spacing": [0.6] * 3, "counts": [4] * 3}
    room = (grey_cube(0.99), {"version": 1, "volumes": [grid]})
    for example, moves in ((room, False), (two_rooms(), True)):
        (volume,) = bake_example(tmp_path, example, stop={"target_error": None, "max_samples": 4}).manifest["volumes"]
        tried = volume["probes"]["tried"]
        assert (volume["probes"]["offsets"] is not None) == moves == (tried["error"] < tried["lattice_error"])
        assert tried["points"] == 1024


def test_what_is_measured_does_not_depend_on_threads() -> None:
    glb, document = two_rooms()
    scene, spec = load_example(glb), parse_spec(document)
    one, two = (prepare(scene, spec, threads=n) for n in (1, 2))
    assert one.trials == two.trials != (None,)


def test_what_was_measured_elsewhere_is_taken_as_it_is() -> None:
    glb, document = two_rooms()
    scene, spec = load_example(glb), parse_spec(document)
    for moved in (False, True):
        told = prepare(scene, spec, trials=(Trial(7, 0.1, 0.2, moved),))
        assert told.trials == (Trial(7, 0.1, 0.2, moved),) and told.offsets.any() == moved


def test_where_no_light_is_nothing_is_measured() -> None:
    """In the dark probes go to the walls, as they do without measuring."""
    w = GlbWriter()
    w.node("room", mesh=w.mesh("room", [quads_part(box_sides((-1, -1, -1), (1, 1, 1)), w.material("wall", (0.6,) * 3))]))
    spec = parse_spec({"version": 1, "volumes": [{"origin": [-0.5] * 3, "spacing": [1.0] * 3, "counts": [2] * 3}]})
    prepared = prepare(load(w), spec)
    assert prepared.trials == (None,) and prepared.offsets.all()


def test_light_that_never_ends_ends_here() -> None:
    """A white room with a lamp is refused once it has been prepared; preparing it takes no longer than another."""
    glb, document = closed_box(1.0, 1.0)
    prepared = prepare(load_example(glb), parse_spec(document))
    assert prepared.spec.max_bounces is None and prepared.trials[0] is not None
