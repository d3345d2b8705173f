"""Where nothing can hide a probe from a surface: the proof, against segments cast by brute force; and what a bake makes of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.audit import audit
from bake_core.examples import box_sides, closed_box, cornell, quads_part
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.irradiance import sample
from bake_core.occlusion import nothing_occludes
from bake_core.placement import place
from bake_core.reach import reach_box, triangles_meeting
from bake_core.scene import Scene
from bake_core.spec import parse_spec
from tests.baking import bake_example
from tests.scenes import add_square, icosphere, load
from tests.unit.test_audit import baked as baked_for_audit

F64 = NDArray[np.float64]


def grid(origin: float | tuple[float, float, float], spacing: float, counts: tuple[int, int, int] = (2, 2, 2)) -> dict[str, Any]:
    return {"origin": list(np.broadcast_to(np.asarray(origin, float), 3)), "spacing": [spacing] * 3, "counts": list(counts)}


def room(*blocks: float, outwards: bool = False) -> GlbWriter:
    """A box of 2 m about zero; and a small one at each of some places on its floor's diagonal."""
    w = GlbWriter()
    wall = w.material("wall")
    w.node("room", mesh=w.mesh("room", [quads_part(box_sides((-1, -1, -1), (1, 1, 1)), wall, outwards=outwards)]))
    block = w.mesh("block", [quads_part(box_sides((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1)), wall, outwards=True)])
    for x in blocks:
        w.node("block", mesh=block, translation=(x, -0.8, x))
    return w


def ball(subdivisions: int, *, inwards: bool = True) -> GlbWriter:
    vertices, faces = icosphere(subdivisions)
    w = GlbWriter()
    part = Part(vertices, faces[:, ::-1] if inwards else faces, material=w.material("wall"))
    w.node("ball", mesh=w.mesh("ball", [part]))
    return w


def floor(*, turned: float = 0.0) -> GlbWriter:
    w = GlbWriter()
    c, s = np.cos(turned), np.sin(turned)
    matrix = np.array([[9 * c, -s, 0, 0], [9 * s, c, 0, 0], [0, 0, 9, 0], [0, 0, 0, 1]], float)
    add_square(w, matrix=matrix, double_sided=True)
    return w


INSIDE = grid(-0.5, 1.0)
CASES: dict[str, tuple[GlbWriter, dict[str, Any], bool]] = {
    "a room": (room(), INSIDE, True),
    "a room whose walls face outwards": (room(outwards=True), INSIDE, True),
    "a room with a block": (room(0.0), INSIDE, False),
    "a room with two blocks, instances": (room(-0.5, 0.5), INSIDE, False),
    "a room with a block beyond reach": (room(40.0), INSIDE, True),
    "a room with two blocks beyond reach, instances": (room(40.0, 60.0), INSIDE, True),
    "a room that probes stand outside of": (room(), grid(-1.01, 1.01, (3, 3, 3)), False),
    "a ball from inside": (ball(3), grid(-0.4, 0.8), True),
    "a ball from outside": (ball(3, inwards=False), grid(-1.5, 1.0, (4, 4, 4)), False),
    "a floor": (floor(), grid((-1.0, 0.3, -1.0), 1.0, (3, 2, 3)), True),
    "a floor that is no axis's": (floor(turned=0.4), grid((-1.0, 1.3, -1.0), 1.0, (3, 2, 3)), True),
    "a floor between probes": (floor(), grid(-0.5, 1.0), False),
    "a floor on which probes stand": (floor(), grid((-1.0, 0.0, -1.0), 1.0), True),
    "nothing": (GlbWriter(), grid(-0.5, 1.0), True),
}


def hidden(scene: Scene, document: dict[str, Any], count: int = 4000) -> int:
    """How many of some segments between a probe and a surface point within reach go through a triangle: Möller and Trumbore 1997."""
    (volume,) = place(scene, parse_spec({"volumes": [document]}))
    box = reach_box(scene, volume)
    everything = np.array([[-np.inf] * 3, [np.inf] * 3])
    found = list(triangles_meeting(scene, everything))
    if not found:
        return 0
    corners = np.concatenate(found)
    random = np.random.default_rng(0)
    which = random.integers(0, len(corners), count)
    b = random.dirichlet([1, 1, 1], count)
    ends = (corners[which] * b[:, :, None]).sum(1)
    keep = ((ends >= box[0]) & (ends <= box[1])).all(1)
    starts = (volume.positions() - scene.origin)[random.integers(0, volume.probe_count, count)]
    starts, ends = starts[keep], ends[keep]
    blocked = np.zeros(len(starts), bool)
    d = ends - starts
    for a, e, f in zip(corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], strict=True):
        h = np.cross(d, f)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (h @ e)
            s = starts - a
            u = (s * h).sum(1) * inverse
            q = np.cross(s, e)
            v, t = (d * q).sum(1) * inverse, (q @ f) * inverse
        blocked |= (u > 0) & (v > 0) & (u + v < 1) & (t > 1e-6) & (t < 1 - 1e-6)
    return int(blocked.sum())


@pytest.mark.parametrize("name", CASES)
def test_what_is_proven_no_segment_contradicts(name: str) -> None:
    writer, document, expected = CASES[name]
    if name == "nothing":
        writer.node("empty")
    scene = load(writer)
    (volume,) = place(scene, parse_spec({"volumes": [document]}))
    assert nothing_occludes(scene, volume, volume.positions() - scene.origin) == expected
    assert not (expected and hidden(scene, document))


@pytest.mark.parametrize("name", ["a room with a block", "a ball from outside"])
def test_the_segments_do_find_what_occludes(name: str) -> None:
    writer, document, _ = CASES[name]
    assert hidden(load(writer), document)


def test_too_large_for_a_proof_is_not_proven() -> None:
    scene = load(ball(6))
    (volume,) = place(scene, parse_spec({"volumes": [grid(-0.4, 0.8)]}))
    assert not nothing_occludes(scene, volume, volume.positions() - scene.origin)


STOP = {"target_error": None, "max_samples": 16}


def test_a_bake_without_visibility_says_so_and_gives_the_light_that_a_bake_with_it_gives(tmp_path: Path) -> None:
    """Irradiance texels are the same bits; answers differ by what visibility, where nothing is hidden, gets wrong about corners."""
    glb, document = closed_box(0.5, 1.0)
    document["stop"] = STOP
    (tmp_path / "auto").mkdir()
    (tmp_path / "all").mkdir()
    without = bake_example(tmp_path / "auto", (glb, document))
    demanded = bake_example(tmp_path / "all", (glb, document), outputs=["irradiance", "visibility"])
    assert list(without.volumes[0].atlases) == ["irradiance"] and list(demanded.volumes[0].atlases) == ["irradiance", "visibility", "walls"]
    np.testing.assert_array_equal(without.volumes[0].atlases["irradiance"].texels, demanded.volumes[0].atlases["irradiance"].texels)
    (entry,) = (x for x in without.manifest["left_out"] if x["what"] == "visibility")
    visibility, walls = (demanded.volumes[0].atlases[name].texels.size for name in ("visibility", "walls"))
    assert "on one side" in entry["why"] and entry["bytes"] == visibility * 4 + walls * 2
    constants = (tmp_path / "auto" / "bundle" / "shaders" / "constants.glsl").read_text()
    assert constants != (tmp_path / "all" / "bundle" / "shaders" / "constants.glsl").read_text()
    random = np.random.default_rng(1)
    points = random.uniform(-0.9, 0.9, (500, 3))
    normals = np.eye(3)[random.integers(0, 3, 500)]
    a, b = (sample(x.volumes, points, normals) for x in (without, demanded))
    assert (a.weights.sum(1) > 0.999).all()
    # A furnace: whatever the weights, its light is the same everywhere.
    np.testing.assert_allclose(a.irradiance, b.irradiance, rtol=0.02)


def test_of_two_volumes_one_may_do_without(tmp_path: Path) -> None:
    glb, document = cornell()
    document["volumes"] = [
        {"name": "under the ceiling", **grid((-0.6, 1.6, 0.3), 0.2, (2, 2, 2))},
        {"name": "room", **grid((-0.6, 0.3, -0.6), 0.6, (3, 2, 3))},
    ]
    for volume in document["volumes"]:
        volume["name"] = volume["name"].replace(" ", "_")
    document["stop"] = STOP
    bundle = bake_example(tmp_path, (glb, document))
    assert [list(v.atlases) for v in bundle.volumes] == [["irradiance"], ["irradiance", "visibility", "walls"]]
    assert [x["what"] for x in bundle.manifest["left_out"] if "visibility" in x["what"]] == ["under_the_ceiling: visibility"]
    points = np.array([[-0.5, 1.7, 0.4], [0.0, 0.5, 0.0]])
    assert (sample(bundle.volumes, points, np.tile([0.0, 1.0, 0.0], (2, 1))).weights.sum(1) > 0.999).all()


def test_an_audit_looks_at_what_visibility_there_is(tmp_path: Path) -> None:
    glb, document = cornell()
    volumes = [{"name": "high", **grid((-0.6, 1.6, 0.3), 0.2)}, {"name": "low", **grid((-0.6, 0.3, -0.6), 0.6)}]
    found = audit(baked_for_audit(tmp_path, (glb, document), volumes=volumes), 0.5, threads=1)
    assert set(found.texels) == {"irradiance", "visibility"} and found.texels["visibility"].error < 0.1
