"""Nothing left out may change the verified picture beyond its thresholds: scenes baked both ways, verified both ways, pictures compared.

Each scene leaves out something else; the other way everything is demanded back (:func:`bake_core.both_ways.everything`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.bake import check_finite, finish, gather
from bake_core.both_ways import everything
from bake_core.bundle import Bundle, read_bundle
from bake_core.clock import Clock
from bake_core.comparison import compare
from bake_core.environment import beside, exactly
from bake_core.errors import InputError
from bake_core.examples import box_sides, quads_part
from bake_core.gltf.writer import GlbWriter, Part, look_at
from bake_core.images import read_exr, write_exr
from bake_core.prepared import Prepared, prepare
from bake_core.report import Run
from bake_core.scene import Camera, Scene
from bake_core.spec import parse_spec
from bake_core.thresholds import Limits, ReceiverLimits, Thresholds
from bake_core.verification import verify
from tests.baking import THREADS
from tests.scenes import add_square, load

F32 = NDArray[np.float32]

# The defaults' limits of the indirect part, for the whole picture too; receivers, which have none by default, keep the mean's.
LIMITS = Limits(mean_ratio=(0.95, 1.05), relmse=0.05)
THRESHOLDS = Thresholds(indirect=LIMITS, whole=LIMITS, receivers=ReceiverLimits(mean_ratio=(0.95, 1.05)))
SIZE: dict[str, Any] = {"width": 96, "height": 54, "samples": 16, "threads": THREADS, "thresholds": THRESHOLDS}


@dataclass(frozen=True)
class Case:
    """A scene: what it leaves out, in words of the manifest, and whether its pictures must be the same bits."""

    build: Callable[[Path], tuple[GlbWriter, dict[str, Any]]]
    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    left_out: tuple[str, ...]
    same: bool


def room(w: GlbWriter, color: tuple[float, float, float], *, open_front: bool = False) -> None:
    """Walls of 2 m about zero, and a lamp 1 cm below the ceiling."""
    walls = box_sides((-1, -1, -1), (1, 1, 1))[: 5 if open_front else 6]
    w.node("room", mesh=w.mesh("room", [quads_part(walls, w.material("wall", color))]))
    matrix = np.diag([0.8, -1.0, 0.8, 1.0])
    matrix[1, 3] = 0.99
    add_square(w, "lamp", (0, 0, 0), matrix=matrix, emission=(5.0, 5.0, 5.0))


def grid(counts: int, low: float, high: float) -> list[dict[str, Any]]:
    return [{"name": "v", "origin": [low] * 3, "spacing": [(high - low) / (counts - 1)] * 3, "counts": [counts] * 3}]


def grey_room(folder: Path) -> tuple[GlbWriter, dict[str, Any]]:
    """Closed and grey: no hue. Nothing in it hides anything, but for the lamp's own back."""
    w = GlbWriter()
    room(w, (0.6, 0.6, 0.6))
    return w, {"volumes": grid(4, -0.9, 0.9)}


def room_with_solids(folder: Path) -> tuple[GlbWriter, dict[str, Any]]:
    """Closed, coloured; a solid block holds probes; under a sky that never gets in."""
    w = GlbWriter()
    room(w, (0.7, 0.6, 0.5))
    faces = box_sides((-0.55, -0.999, -0.55), (0.1, 0.1, 0.1))
    w.node("block", mesh=w.mesh("block", [quads_part(faces, w.material("block", (0.3, 0.5, 0.7)), outwards=True)]))
    return w, {"volumes": grid(6, -0.9, 0.9), "environment": {"kind": "constant", "radiance": [3.0, 3.0, 3.0]}}


def ground_under_a_sky(folder: Path) -> tuple[GlbWriter, dict[str, Any]]:
    """Open ground under an image of a sky: no visibility, and of 5 layers of probes the upper three are needed by no surface."""
    w = GlbWriter()
    add_square(w, "ground", (0.5, 0.4, 0.3), matrix=np.diag([4.0, 1, 4.0, 1]))
    random = np.random.default_rng(2)
    texels = random.gamma(2.0, 0.5, (8, 16, 3)).astype(np.float32)
    write_exr(folder / "sky.exr", texels, ("R", "G", "B"))
    volume = {"name": "v", "origin": [-1.6, 0.2, -1.6], "spacing": [0.8, 0.8, 0.8], "counts": [5, 5, 5]}
    return w, {"volumes": [volume], "environment": {"kind": "equirect", "image": "sky.exr"}, "receivers": "surfaces"}


def ball_from_inside(folder: Path) -> tuple[GlbWriter, dict[str, Any]]:
    """A round room of 1,280 triangles with one bright patch: convex, so no visibility; its walls curve between probes."""
    from trimesh.creation import icosphere

    mesh = icosphere(subdivisions=3)
    faces = np.asarray(mesh.faces)[:, ::-1]
    bright = np.asarray(mesh.vertices)[faces].mean(1)[:, 1] > 0.8
    w = GlbWriter()
    parts = [
        Part(np.asarray(mesh.vertices), faces[~bright], material=w.material("wall", (0.7, 0.5, 0.4))),
        Part(np.asarray(mesh.vertices), faces[bright], material=w.material("lamp", (0.5, 0.5, 0.5), emission=(4.0, 4.0, 4.0))),
    ]
    w.node("ball", mesh=w.mesh("ball", parts))
    return w, {"volumes": grid(4, -0.55, 0.55), "environment": {"kind": "constant", "radiance": [9.0, 9.0, 9.0]}}


CASES = {
    "a grey room": Case(grey_room, (-0.8, 0.4, 0.8), (0.3, -0.4, -0.3), ("radiance", "v: irradiance in colour"), same=True),
    "solids in a sealed room": Case(
        room_with_solids, (0.8, 0.6, 0.8), (-0.3, -0.5, -0.3), ("radiance", "code for environment", "12 of 216 probes"), same=True
    ),
    "ground under a sky": Case(ground_under_a_sky, (1.8, 1.2, 1.8), (0, 0, 0), ("visibility", "75 of 125 probes"), same=False),
    "a ball from inside": Case(ball_from_inside, (0.1, -0.2, 0.7), (0, 0, -1), ("visibility", "code for environment"), same=False),
}


def baked(prepared: Prepared, out: Path) -> Bundle:
    check_finite(prepared, threads=THREADS)
    run = Run(THREADS, 1)
    state = gather(prepared, run, Clock(prepared.spec, None))
    finish(prepared, state, run, out, audit_seconds=0)
    return read_bundle(out)


def pictures(report: dict[str, Any], folder: Path, part: str, kind: str) -> F32:
    (camera,) = report["cameras"]
    pixels, _ = read_exr(folder / f"{camera['files'][part][kind]}.exr", InputError, "test.unreadable")
    return pixels


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_verified_picture_is_the_same_both_ways(tmp_path: Path, name: str) -> None:
    """Each way keeps the thresholds against the path tracer; so does each picture against the other, as if that were the truth."""
    case = CASES[name]
    writer, document = case.build(tmp_path)
    scene: Scene = load(writer)
    spec = parse_spec({**document, "stop": {"target_error": None, "max_samples": 64}})
    camera = Camera("eye", look_at(case.eye, case.target), 1.0)
    find = beside(tmp_path)
    bundles = [
        baked(prepare(scene, spec, find), tmp_path / "without"),
        baked(everything(scene, spec, find), tmp_path / "everything"),
    ]
    said = [x["what"] for x in bundles[0].manifest["left_out"]]
    assert set(case.left_out) <= set(said), said
    # Of the other, all that is missing are probes in solids.
    assert {x["what"].split()[-1] for x in bundles[1].manifest["left_out"] if not x["what"].startswith("code")} <= {"probes"}
    reports = []
    for bundle, out in zip(bundles, ("a", "b"), strict=True):
        reports.append(verify(bundle, scene, [camera], tmp_path / out, **SIZE, find=exactly(tmp_path / "sky.exr")))
        assert reports[-1]["failures"] == [], out
    for part in ("indirect", "whole"):
        a, b = (pictures(report, tmp_path / out, part, "raster") for report, out in zip(reports, "ab", strict=True))
        surface = np.asarray(((a > 0) | (b > 0)).any(-1))
        assert surface.any()
        if case.same:
            np.testing.assert_array_equal(a, b)
        assert LIMITS.failures(compare(a, (b, b), surface)) == []
    without, with_all = (report["receivers"] for report in reports)
    assert without["count"] == with_all["count"] > 500
    if "visibility" in case.left_out:
        # Visibility is 1 in truth, and its maps only come near it. relMSE is free of the reference's noise, up to its scatter.
        assert without["relmse"] <= with_all["relmse"] + without["reference_noise"]
