"""Which probes surfaces need: cells against triangles, and a bake that leaves out the rest."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.examples import plane_under_sun
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.irradiance import cell, sample
from bake_core.placement import Volume
from bake_core.plan import plan
from bake_core.prepared import prepare
from bake_core.reach import probes_about_surfaces, triangles_meeting
from bake_core.scene import Scene
from bake_core.spec import parse_spec
from service.cli import main
from tests.baking import bake_example, maps
from tests.conformance import synthetic
from tests.scenes import add_square, load, load_example

F64 = NDArray[np.float64]
EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])


def triangles(seed: int, count: int = 12) -> Scene:
    """A few, of all sizes, some of them copies: turned, mirrored and stretched."""
    random = np.random.default_rng(seed)
    w = GlbWriter()
    wall = w.material("wall")
    for i in range(count):
        centre, size = random.uniform(-3, 3, 3), 10 ** random.uniform(-2, 0.7)
        corners = centre + size * random.uniform(-1, 1, (3, 3))
        mesh = w.mesh(f"{i}", [Part(corners, np.array([[0, 1, 2]]), material=wall)])
        w.node(f"{i}", mesh=mesh)
        if i % 3 == 0:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = random.uniform(-1, 1, (3, 3)), random.uniform(-2, 2, 3)
            w.node(f"{i} again", mesh=mesh, matrix=matrix)
    return load(w)


@pytest.mark.parametrize("counts", [(6, 5, 4), (1, 7, 3), (1, 1, 1), (2, 2, 2)])
@pytest.mark.parametrize("seed", range(3))
def test_no_query_on_a_surface_asks_a_probe_that_is_not_needed(seed: int, counts: tuple[int, int, int]) -> None:
    """All eight probes of the cells of points drawn on triangles, also outside of the grid; and not many more than those."""
    scene = triangles(seed)
    volume = Volume("v", np.array([-1.6, -1.1, -1.3]), np.array([0.7, 0.5, 0.9]), counts)
    needed = probes_about_surfaces(scene, volume, 0.0)
    corners = np.concatenate(list(triangles_meeting(scene, EVERYWHERE)))
    assert len(corners) == scene.triangle_count
    random = np.random.default_rng(seed)
    points = np.einsum("tpa,tak->tpk", random.dirichlet([0.5] * 3, (len(corners), 4000)), corners).reshape(-1, 3) + scene.origin
    asked = np.zeros(counts, bool)
    lattice = synthetic.volume("v", (-1.6, -1.1, -1.3), (0.7, 0.5, 0.9), counts)
    base, _ = cell(lattice, points)
    for corner in range(8):
        at = np.minimum(base + [corner >> axis & 1 for axis in range(3)], np.array(counts) - 1)
        asked[tuple(at.T)] = True
    assert needed[asked.ravel(order="F")].all()
    # A triangle that only cuts a cell's edge may not have been drawn there.
    assert needed.sum() <= 1.15 * asked.sum()


def test_a_margin_reaches_the_next_cell() -> None:
    w = GlbWriter()
    add_square(w, matrix=np.array([[0.2, 0, 0, 0.5], [0, 1, 0, 0.9], [0, 0, 0.2, 0.5], [0, 0, 0, 1]]))
    scene = load(w)
    volume = Volume("v", np.zeros(3), np.ones(3), (2, 4, 2))
    for margin, layers in ((0.0, [1, 1, 0, 0]), (0.05, [1, 1, 0, 0]), (0.11, [1, 1, 1, 0])):
        needed = probes_about_surfaces(scene, volume, margin).reshape(2, 4, 2)
        assert (needed == np.array(layers, bool)[None, :, None]).all(), margin


def example() -> tuple[bytes, dict[str, Any]]:
    """A floor of 6 m below 4 × 5 × 4 probes, most of which are high above it; and a box among them, whose inside is a solid."""
    w = GlbWriter()
    add_square(w, "floor", matrix=np.diag([6.0, 1, 6.0, 1]))
    from trimesh.creation import box

    mesh = box((1.2, 1.2, 1.2))
    w.node("box", mesh=w.mesh("box", [Part(np.asarray(mesh.vertices) + [0, 0.7, 0], np.asarray(mesh.faces), material=w.material("box"))]))
    grid = {"name": "g", "origin": [-1.5, 0.2, -1.5], "spacing": [1.0, 1.0, 1.0], "counts": [4, 5, 4]}
    environment = {"kind": "constant", "radiance": [1.0, 0.9, 0.8]}
    return w.to_glb(), {"volumes": [grid], "environment": environment, "stop": {"target_error": None, "max_samples": 16}}


def test_a_bake_for_surfaces_answers_on_surfaces_as_the_whole_one_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glb, spec = example()
    (tmp_path / "all").mkdir()
    (tmp_path / "few").mkdir()
    whole = bake_example(tmp_path / "all", (glb, spec))
    few = bake_example(tmp_path / "few", (glb, spec), receivers="surfaces", shards=3)
    a, b = whole.volumes[0], few.volumes[0]
    unneeded = b.states == 2
    assert a.states.tolist() == np.where(unneeded, 1, b.states).tolist() and unneeded.sum() == 32
    # The topmost two layers have no surface about them.
    assert unneeded.reshape(4, 5, 4)[:, 3:].all()
    np.testing.assert_array_equal(maps(few), maps(whole)[(b.states == 1)[a.states == 1]])
    random = np.random.default_rng(0)
    floor = np.stack([random.uniform(-3, 3, 400), np.zeros(400), random.uniform(-3, 3, 400)], -1)
    lid = np.stack([random.uniform(-0.6, 0.6, 100), np.full(100, 1.3), random.uniform(-0.6, 0.6, 100)], -1)
    points, up = np.concatenate([floor, lid]), np.tile([0.0, 1.0, 0.0], (500, 1))
    one, other = sample(whole.volumes, points, up), sample(few.volumes, points, up)
    np.testing.assert_array_equal(one.irradiance, other.irradiance)
    np.testing.assert_array_equal(one.weights, other.weights)
    (entry,) = (x for x in few.manifest["left_out"] if "needed by no surface" in x["why"])
    assert entry["what"] == "32 of 80 probes" and entry["bytes"] == 32 * (10 * 10 * 6 + 18 * 18 * (8 + 2))
    probes = few.manifest["volumes"][0]["probes"]
    assert probes["active"] == (b.states == 1).sum() and all(probes["backface"][i] == 0 for i in np.flatnonzero(unneeded))

    # In the open, where no probe is left, a query says so.
    where = ["sample", str(tmp_path / "few" / "bundle"), "--at", "0,3.8,0", "--normal", "0,1,0"]
    assert main(where) == 0
    assert "irradiance 0 0 0" in (told := capsys.readouterr().out) and "no measurement" in told
    assert main([*where, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["samples"][0]["weights"] == [0] * 8
    # Between a layer that is there and one that is not, the one that is there answers.
    between = sample(few.volumes, [[1.5, 2.9, 1.5]], [[0.0, 1.0, 0.0]])
    assert between.weights.sum() == pytest.approx(1) and (b.states[between.probes[between.weights > 0]] == 1).all()
    assert main(["info", str(tmp_path / "few" / "bundle")]) == 0
    assert "32 needed by no surface" in capsys.readouterr().out


def test_a_plan_says_what_could_be_left_out() -> None:
    glb, spec = example()
    scene = load_example(glb)
    could = plan(scene, parse_spec(spec), threads=1)
    does = plan(scene, parse_spec({**spec, "receivers": "surfaces"}), threads=1)
    assert could.unneeded_probes == does.unneeded_probes == 32
    assert could.unneeded_bytes == could.atlas_bytes - does.atlas_bytes == 32 * (10 * 10 * 6 + 18 * 18 * (8 + 2))
    assert does.seconds < could.seconds


def test_a_scene_without_surfaces_needs_no_probe(tmp_path: Path) -> None:
    w = GlbWriter()
    w.node("empty")
    grid = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [2, 2, 2]}
    spec = {"volumes": [grid], "receivers": "surfaces", "environment": {"kind": "constant", "radiance": [1, 1, 1]}}
    made = plan(load(w), parse_spec(spec), threads=1)
    assert made.unneeded_probes == 8 and made.seconds == 0 and made.atlas_bytes == 0
    bundle = bake_example(tmp_path, (w.to_glb(), spec))
    assert bundle.volumes[0].states.tolist() == [2] * 8 and bundle.manifest["error"]["value"] == 0
    assert not sample(bundle.volumes, [[0.5, 0.5, 0.5]], [[0.0, 1.0, 0.0]]).irradiance.any()


def test_a_surface_outside_is_the_nearest_cells() -> None:
    """A border's cells reach outwards without end: a plane 1 m below is what a probe in the open is asked about."""
    glb, spec = plane_under_sun()
    assert prepare(load_example(glb), parse_spec({**spec, "receivers": "surfaces"})).needed.all()
