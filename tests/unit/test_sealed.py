"""Rooms that no light of the environment enters: what proves it, what does not, and that no ray gets out of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core import sealed
from bake_core.examples import box_sides, quads_part
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.images import write_exr
from bake_core.prepared import prepare
from bake_core.sealed import is_sealed
from bake_core.spec import OUTPUTS, parse_spec
from tests.baking import bake_example, maps
from tests.scenes import add_square, build, icosphere, load, sky

F64 = NDArray[np.float64]
INSIDE = np.array([[-0.5, -0.4, 0.3], [0.6, 0.7, -0.8], [0, 0, 0]])


def boxes(w: GlbWriter, *parts: Part | list[F64], matrix: Any = None, copies: int = 1) -> GlbWriter:
    """Each part, or list of quads, under a node of its own; of several copies all but the first are 10 m away."""
    wall = w.material("wall")
    for part in parts:
        made = quads_part(part, wall) if isinstance(part, list) else part
        mesh = w.mesh("walls", [made])
        for copy in range(copies):
            place = np.eye(4) if matrix is None else np.array(matrix, float)
            moved = np.eye(4)
            moved[0, 3] = 10 * copy
            w.node("walls", mesh=mesh, matrix=moved @ place)
    return w


def sides(half: float = 1.0, *without: int) -> list[F64]:
    return [quad for i, quad in enumerate(box_sides((-half,) * 3, (half,) * 3)) if i not in without]


def split(quad: F64) -> list[F64]:
    """Two halves, with corners in the middle of two of its edges: a T in the edges that it shares."""
    a, b, c, d = quad
    return [np.array([a, (a + b) / 2, (c + d) / 2, d]), np.array([(a + b) / 2, b, c, (c + d) / 2])]


def ball() -> Part:
    vertices, faces = icosphere(3)
    return Part(2 * vertices, faces)


def proven(writer: GlbWriter) -> bool:
    scene = load(writer)
    return is_sealed(scene, build(scene), INSIDE - scene.origin)


TURNED = [[0.6, 0, 0.8, 0.1], [0, -1.5, 0, 0.1], [-0.8, 0, 0.6, 0.1], [0, 0, 0, 1]]
SEALED = {
    "a box": boxes(GlbWriter(), sides()),
    "a box whose walls are nodes of their own": boxes(GlbWriter(), *([quad] for quad in sides())),
    "a box turned inside out": boxes(GlbWriter(), [quad[::-1] for quad in sides()]),
    "a ball": boxes(GlbWriter(), ball()),
    "a box with furniture": boxes(GlbWriter(), sides(), sides(0.2, 3), sides(0.1)),
    "a box in a box with a hole": boxes(GlbWriter(), sides(), sides(3.0, 3)),
    "instances, turned, mirrored and stretched": boxes(GlbWriter(), sides(1.5), matrix=TURNED, copies=3),
}
OPEN = {
    "no wall at all": boxes(GlbWriter()),
    "a box without a lid": boxes(GlbWriter(), sides(1.0, 3)),
    "a lid that is not the walls' own": boxes(GlbWriter(), sides(1.0, 3) + split(sides()[3])),
    "a wall that is turned round": boxes(GlbWriter(), [*sides(1.0, 3), sides()[3][::-1]]),
    "a box that holds two of three probes": boxes(GlbWriter(), sides(0.75)),
    "a box beside the probes": boxes(GlbWriter(), [quad + [5, 0, 0] for quad in sides()]),
    "boxes between which the probes stand": boxes(GlbWriter(), sides(0.01), [quad + [0, 4, 0] for quad in sides(3)]),
    "a box whose wall a probe stands on": boxes(GlbWriter(), [quad + [0, 0, 0.2] for quad in sides()]),
}


@pytest.mark.parametrize("name", SEALED)
def test_what_is_sealed(name: str) -> None:
    assert proven(SEALED[name])


@pytest.mark.parametrize("name", OPEN)
def test_what_is_not_or_is_not_proven(name: str) -> None:
    writer = OPEN[name]
    if name.startswith("no wall"):
        writer.node("empty")
    assert not proven(writer)


def test_glass_does_not_seal_and_a_surface_too_large_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    w = GlbWriter()
    glass = w.material("glass", alpha_mode="BLEND")
    room = sides()
    w.node("room", mesh=w.mesh("room", [quads_part(room[:5], w.material("wall")), quads_part(room[5:], glass)]))
    assert not proven(w)
    monkeypatch.setattr(sealed, "MOST_TRIANGLES", 11)
    assert not proven(SEALED["a box"])


def test_a_sliver_seals_nothing() -> None:
    """A ridge of 10⁻⁷ m along an edge of the lid."""
    room = sides(1.0, 3)
    a, b, c, d = sides()[3]
    thin = a + 1e-7 * (d - a) / 2
    edge = b + 1e-7 * (c - b) / 2
    lid = [np.array([thin, edge, c, d]), np.array([a, b, edge, thin])]
    for extra, expected in ((lid[:1], False), (lid, False)):
        assert proven(boxes(GlbWriter(), room + extra)) == expected


GRID = {"name": "room", "origin": [-0.5, -0.4, -0.6], "spacing": [0.9, 1.0, 1.0], "counts": [2, 2, 2]}
STOP = {"target_error": None, "max_samples": 32}


@pytest.mark.parametrize("image", [False, True])
def test_no_ray_gets_out(tmp_path: Path, image: bool) -> None:
    """A lamp of 1 in a ball of a thousand triangles, under a sky of 10⁷: the same bits as without a sky, however it is left out.

    With it, one ray in 10¹² that escaped would show.
    """
    w = GlbWriter()
    vertices, faces = icosphere(3)
    w.node("ball", mesh=w.mesh("ball", [Part(2 * vertices, faces[:, ::-1], material=w.material("wall", (0.7,) * 3))]))
    add_square(w, "lamp", emission=(1.0, 1.0, 1.0))
    write_exr(tmp_path / "sky.exr", np.full((2, 4, 3), 1e7, np.float32), ("R", "G", "B"))
    bright = {"kind": "equirect", "image": "sky.exr"} if image else sky(1e7)
    spec = {"volumes": [GRID], "stop": STOP, "outputs": ["irradiance"]}
    folders = {name: tmp_path / name for name in ("dark", "sealed", "open")}
    for folder in folders.values():
        folder.mkdir()
        (folder / "sky.exr").write_bytes((tmp_path / "sky.exr").read_bytes())
    example = (w.to_glb(), spec)
    dark = bake_example(folders["dark"], example)
    bundle = bake_example(folders["sealed"], example, environment=bright)
    assert any("sealed off" in x["why"] for x in bundle.manifest["left_out"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bake_core.prepared.is_sealed", lambda scene, tracer, positions: False)
        unproven = bake_example(folders["open"], example, environment=bright)
    assert not any("sealed off" in x["why"] for x in unproven.manifest["left_out"])
    np.testing.assert_array_equal(maps(bundle), maps(dark))
    np.testing.assert_allclose(maps(unproven), maps(dark), rtol=0.05 if image else 0)


def test_what_is_sealed_is_said_and_audits_see_the_sky() -> None:
    scene = load(SEALED["a box"])
    made = prepare(scene, parse_spec({"volumes": [GRID], "environment": sky()}))
    assert not made.tracer.tables.environment.any() and made.whole.tables.environment.all()
    why = {x.what: x.why for x in made.left_out}
    assert "sealed off" in why["code for environment"] and "sealed off" in why["code for sky sampling"]
    black = prepare(scene, parse_spec({"volumes": [GRID], "outputs": OUTPUTS}))
    assert black.tracer is black.whole and "black" in {x.what: x.why for x in black.left_out}["code for environment"]
