"""Rooms in which light never ends are refused; all others are not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core.bake import check_finite
from bake_core.errors import Cancelled, SceneError
from bake_core.examples import closed_box, quads_part, two_rooms
from bake_core.gltf.writer import GlbWriter
from bake_core.plan import plan
from bake_core.prepared import Prepared, prepare
from bake_core.spec import parse_spec
from bake_core.stability.scenes import box, box_with_hole
from tests.scenes import load, sky
from tests.unit.gltf_build import load_glb

PROBES = [{"origin": [-0.4, 0.3, 0.1], "spacing": [1, 1, 1], "counts": [1, 1, 1]}]


def room(color: tuple[float, float, float], emission: float, hole: float = 0.0, **spec: Any) -> Prepared:
    w = GlbWriter()
    walls = box_with_hole(hole) if hole else box()
    w.node("room", mesh=w.mesh("room", [quads_part(list(walls), w.material("wall", color, emission=(emission,) * 3))]))
    return prepare(load(w), parse_spec({"volumes": PROBES, **spec}))


@pytest.mark.parametrize(("color", "threads"), [((1, 1, 1), 1), ((0.2, 1.0, 0.0), 2), ((0.99999,) * 3, 2)])
def test_sealed_and_white_with_a_lamp(color: tuple[float, float, float], threads: int) -> None:
    """One channel that nothing absorbs is enough."""
    with pytest.raises(SceneError, match="max_bounces") as caught:
        check_finite(room(color, 1.0), threads=threads)
    assert (caught.value.slug, caught.value.where) == ("scene.light_never_ends", "probe 0")


@pytest.mark.parametrize(
    "finite",
    [
        lambda: room((1, 1, 1), 1.0, max_bounces=100),
        lambda: room((1, 1, 1), 1.0, hole=0.1),
        lambda: room((0.999,) * 3, 1.0),
        lambda: room((0.9999,) * 3, 1.0),
        lambda: room((1, 1, 1), 0.0, environment=sky(1e6)),
    ],
    ids=["bounces", "window", "0.999", "0.9999", "dark"],
)
def test_whatever_ends(finite: Any) -> None:
    check_finite(finite(), threads=2)


def test_the_place_is_the_first_probe_in_such_a_room() -> None:
    """Two white rooms, the second of which shines; probes 0 to 8 stand in the first."""
    w = GlbWriter()
    for x, emission in ((0.0, 0.0), (10.0, 1.0)):
        wall = w.material(f"wall {x}", (1, 1, 1), emission=(emission,) * 3)
        w.node(mesh=w.mesh(f"room {x}", [quads_part(list(box(1.0, (x, 0, 0))), wall)]))
    grids = [{"origin": [x - 0.6, -0.5, 0], "spacing": [0.5, 0.5, 1], "counts": [3, 3, 1]} for x in (0, 10)]
    scene = load(w)
    check_finite(prepare(scene, parse_spec({"volumes": grids[:1]})), threads=2)
    with pytest.raises(SceneError) as caught:
        check_finite(prepare(scene, parse_spec({"volumes": grids})), threads=2)
    assert int(caught.value.where.removeprefix("probe ")) >= 9


def test_a_lamp_that_absorbs_ends_it(tmp_path: Path) -> None:
    """The lamp of these white rooms is black."""
    glb, spec = two_rooms(1.0)
    check_finite(prepare(load_glb(glb, tmp_path), parse_spec(spec)), threads=2)


def test_it_can_be_cancelled() -> None:
    with pytest.raises(Cancelled):
        check_finite(room((1, 1, 1), 1.0), threads=1, cancelled=np.ones(1, np.uint8))


def test_a_plan_says_so_too(tmp_path: Path) -> None:
    glb, spec = closed_box(1.0, 1.0)
    with pytest.raises(SceneError) as caught:
        plan(load_glb(glb, tmp_path), parse_spec(spec), threads=2)
    assert caught.value.slug == "scene.light_never_ends"
