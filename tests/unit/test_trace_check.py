"""`octobake trace-check`, on a room whose every ray is right, and on answers that are wrong on purpose."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bake_core.examples import closed_box
from bake_core.light_field import HIT, MISS, UNKNOWN, light_field, trace
from bake_core.trace_check import Rays, judge
from bake_core.trace_variants import thinned
from service.cli import main
from tests.baking import bake_example
from tests.conformance import rooms

OUTPUTS = ["irradiance", "visibility", "radiance", "distance", "normal"]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stop = {"target_error": None, "max_samples": 1}
    bake_example(tmp_path, closed_box(0.5, 1.0, 0), outputs=OUTPUTS, stop=stop, resolution={"distance": 4, "normal": 4, "radiance": 8})
    out = tmp_path / "checked"
    scene = str(tmp_path / "scene.glb")
    assert main(["trace-check", str(tmp_path / "bundle"), "--scene", scene, "--rays", "500", "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((out / "trace-check.json").read_text())
    assert (report["rays"], report["misses"]) == (500, 0.0)
    assert [(row["spacing"], row["resolution"]) for row in report["rows"]] == [(s, r) for s in (1, 2) for r in (2, 4, 8)]
    for row in report["rows"]:
        for who in ("python", "glsl"):
            # One wall is as good as known by any four texels on it; where three walls meet, few texels are too few.
            assert row[who]["agree"] > (0.95 if row["resolution"] > 2 else 0.9)
            assert sum(row[who][k] for k in ("agree", "false_hits", "late_hits", "false_misses", "unknown")) == pytest.approx(1)
    assert {p.name for p in out.iterdir()} == {"index.html", "trace-check.json", "trace-check.svg", "trace-check.png"}


def test_a_bundle_without_maps_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bake_example(tmp_path, closed_box(0.5, 1.0, 0), stop={"target_error": None, "max_samples": 1})
    assert main(["trace-check", str(tmp_path / "bundle"), "--scene", str(tmp_path / "scene.glb")]) == 2
    assert "bundle.not_traceable" in capsys.readouterr().err


def test_every_ray_is_one_thing() -> None:
    room = rooms.Room(open_top=True)
    volumes = (rooms.volume(room, (-1.5, 0.5, -1.5), (1.0, 1.0, 1.0), (4, 3, 4), n=32),)
    o, d = rooms.rays(room, 200)
    truth = room.hit(o, d)[0]
    found = trace(light_field(volumes), o, d)
    good, _ = judge(volumes, Rays(o, d, truth), found)
    hits = np.flatnonzero(good["agree"] & (found.verdict == HIT) & (found.distance > 1.5))
    sky = np.flatnonzero(good["agree"] & (found.verdict == MISS))
    verdict, distance, volume, probe = found.verdict.copy(), found.distance.copy(), found.volume.copy(), found.probe.copy()
    distance[hits[0]] -= 1.4
    distance[hits[1]] += 3.0
    verdict[hits[2]], distance[hits[2]] = MISS, np.inf
    verdict[hits[3]] = UNKNOWN
    verdict[sky[0]], distance[sky[0]] = HIT, 1.0
    wrong, _ = judge(volumes, Rays(o, d, truth), replace(found, verdict=verdict, distance=distance, volume=volume, probe=probe))
    assert wrong["false_hits"][[hits[0], sky[0]]].all()
    assert wrong["late_hits"][hits[1]]
    assert wrong["false_misses"][hits[2]]
    assert wrong["unknown"][hits[3]]
    np.testing.assert_array_equal(sum(mask.astype(int) for mask in wrong.values()), 1)


def test_thinned_volumes_keep_their_probes() -> None:
    room = rooms.Room(solids=(((-1.2, 0.0, -1.0), (-0.3, 1.7, -0.2)),))
    volume = rooms.volume(room, (-1.5, 0.5, -1.5), (1.0, 1.0, 1.0), (4, 3, 4), n=16, moved=0.3)
    (half,) = thinned((volume,), 2)
    assert half.counts.tolist() == [2, 2, 2]
    chosen = np.arange(48).reshape(4, 3, 4)[::2, ::2, ::2].ravel()
    np.testing.assert_allclose(half.positions(), volume.positions()[chosen])
    o, d = rooms.rays(room, 500)
    truth = room.hit(o, d)[0]
    found = trace(light_field((half,)), o, d)
    assert judge((half,), Rays(o, d, truth), found)[0]["agree"].mean() > 0.9
