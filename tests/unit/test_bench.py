"""``octobake bench`` on tiny scenes: what it writes, what it refuses, and its arithmetic where the answer is known."""

from __future__ import annotations

import csv
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core.bench import pairs, peers
from bake_core.bench.outcome import Series, error_against_seconds, put_section
from bake_core.bench.reference import EPSILON, convolved_maps, stored_maps
from bake_core.bench.targets import audited_in_words
from bake_core.drawing import as_svg
from bake_core.examples import closed_box, cornell, plane_under_sun, square_emitter
from bake_core.octahedral import texel_directions, texel_solid_angles
from bake_core.prepared import prepare
from bake_core.rate import rate_of_runs
from bake_core.scene_files import load_scene
from bake_core.spec import parse_spec
from service.cli import main
from tests.baking import bake_example


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A plane under a sun, four probes above it; spec beside it."""
    glb, spec = plane_under_sun(half_width=4.0)
    (tmp_path / "plane.glb").write_bytes(glb)
    grid = {"name": "above", "origin": [0.0, 0.5, 0.0], "spacing": [1.0, 1.0, 1.0], "counts": [2, 1, 2]}
    document = {**spec, "volumes": [grid], "environment": {"kind": "constant", "radiance": [0.5, 0.6, 0.7]}, "max_bounces": 4}
    (tmp_path / "plane.json").write_text(json.dumps(document))
    return tmp_path / "plane.glb"


def bench(kind: str, scene: Path, *options: str) -> Path:
    out = scene.parent / "out"
    assert main(["bench", kind, str(scene), "--spec", str(scene.parent), "-o", str(out), *options]) == 0
    return out


def left(out: Path, kind: str) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """What a command wrote, after a look at its pictures."""
    assert (out / f"{kind}.png").read_bytes().startswith(b"\x89PNG")
    assert "</svg>" in (out / f"{kind}.svg").read_text()
    document = json.loads((out / f"{kind}.json").read_text())
    assert document["bench"] == kind and document["machine"]["cores"] == os.cpu_count()
    with (out / f"{kind}.csv").open() as f:
        return document, list(csv.DictReader(f))


def test_throughput(scene: Path) -> None:
    """Embree alone takes no longer than all of tracing does, within what a clock can tell; rays are those of the log."""
    document, rows = left(bench("throughput", scene, "--runs", "3", "--threads", "1"), "throughput")
    (row,) = rows
    assert float(row["paths"]) == 16 * float(row["probes"]) * 16**2
    assert float(row["nearest"]) >= 1 and 0 < float(row["share_inside_embree"]) < 1.2
    assert document["runs"] == 3


def test_scale_and_its_history(tmp_path: Path) -> None:
    """Exponents of costs whose sizes differ by much: a path in ten thousand triangles does not cost a hundred times one in a hundred."""
    out = tmp_path / "out"
    sizes = ["--threads-sizes", "1", "--probes-sizes", "1,8", "--triangles-sizes", "100,10000", "--emitters-sizes", "2,200"]
    for _ in range(2):
        assert main(["bench", "scale", "-o", str(out), "--runs", "1", *sizes]) == 0
    document, rows = left(out, "scale")
    assert [r["axis"] for r in rows] == ["threads", *(axis for axis in ("probes", "triangles", "emitters") for _ in range(2))]
    assert abs(document["exponents"]["triangles"]["slope"]) < 0.5 and abs(document["exponents"]["emitters"]["slope"]) < 0.5
    history = [json.loads(line) for line in (out / "history.jsonl").read_text().splitlines()]
    assert [entry["bench"] for entry in history] == ["scale", "scale"]
    assert len(history[1]["rows"]) == 7 and history[1]["machine"] == document["machine"]


def test_convergence_without_peers(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    none, kept = scene.parent / "none", scene.parent / "reference.npz"
    none.mkdir()
    options = (
        "--samples",
        "16,64",
        "--runs",
        "2",
        "--reference-samples",
        "256",
        "--reference",
        str(kept),
        "--peers",
        str(kept.parent / "none"),
    )
    out = bench("convergence", scene, *options)
    printed, said = capsys.readouterr()
    assert said.count("no peer is installed: ours alone is measured") == 1
    document, rows = left(out, "convergence")
    raced = [(f"octobake, {integrator}", samples) for integrator in ("path", "cache") for samples in ("16", "64")]
    assert [(r["contestant"], r["samples"]) for r in rows] == raced
    first, second, *_ = document["measured"]
    assert second["relative_mse"] < first["relative_mse"] and abs(second["bias"]) < 4 * second["bias_error"] + 1e-3
    assert second["irradiance_mse"] < first["irradiance_mse"] < first["relative_mse"]
    assert document["probes"] == 4 and document["reference_noise"] < second["relative_mse"]
    assert printed.splitlines()[0].startswith("integrator") and "Reference: ours, path traced" in printed
    # Again, from the reference that was kept.
    assert not bench("convergence", scene, *options).joinpath("tiles.npy").exists()
    assert "Reference: reference.npz, 2 runs at 4 probes" in capsys.readouterr().out
    np.savez(kept, chosen=np.array([9]), radiance=np.zeros((2, 1, 16, 16, 3)), irradiance=np.zeros((2, 1, 8, 8, 3)))
    assert main(["bench", "convergence", str(scene), "--spec", str(scene.parent), "-o", str(out), "--reference", str(kept)]) == 2
    assert "bench.bad_reference" in capsys.readouterr().err


def test_targets(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = scene.parent / "page.md"
    page.write_text("# Mine\n\n<!-- bench targets -->\nold\n<!-- /bench targets -->\nafter\n")
    out = bench(
        "targets", scene, "--targets", "0.2,0.05", "--max-samples", "512", "--audit-seconds", "1", "--markdown", str(page), "--json"
    )
    printed = json.loads(capsys.readouterr().out)
    document, rows = left(out, "targets")
    assert [(r["scene"], r["target"]) for r in rows] == [("plane", "0.2"), ("plane", "0.05")]
    assert all(float(r["stated"]) <= float(r["target"]) for r in rows) and document["baked"] == printed["baked"]
    text = page.read_text()
    assert text.startswith("# Mine\n") and text.endswith("after\n") and "old" not in text and "| plane | 5 % |" in text


@pytest.mark.parametrize("kind", ["adaptive", "leaving-out", "integrators"])
def test_pairs(scene: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = bench(kind, scene, "--target", "0.1", "--runs", "1", "--max-samples", "256")
    document, rows = left(out, kind)
    assert len(rows) == 2 and len({r["way"] for r in rows}) == 2 and document["question"] == kind
    if kind == "leaving-out":
        fewer, all_five = (int(r["bytes"]) for r in rows)
        assert fewer < all_five and rows[0]["error"] == rows[1]["error"]
    assert "ratio" in capsys.readouterr().out


def test_what_is_refused(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(scene.parent / "out")
    for arguments, slug in (
        (["targets", str(scene), "-o", out], "bench.no_spec"),
        (["convergence", str(scene), str(scene), "--spec", str(scene.parent), "-o", out], "bench.one_scene"),
        (["targets", "-o", str(scene)], "bench.no_folder"),
    ):
        assert main(["bench", *arguments]) == 2
        assert slug in capsys.readouterr().err
    for arguments in (["--targets", "0"], ["--targets", "0.1,x"], ["--max-seconds", "inf"]):
        with pytest.raises(SystemExit):
            main(["bench", "targets", "-o", out, *arguments])


def test_every_probe_has_its_own_tile(tmp_path: Path) -> None:
    """Those inside solids have none in the bundle; what comes after them stays where it belongs."""
    bundle = bake_example(tmp_path, cornell(), stop={"target_error": None, "max_samples": 1}, outputs=["irradiance", "radiance"])
    (volume,), (tiles, irradiance) = bundle.volumes, stored_maps(bundle)
    assert len(tiles) == len(volume.states) > (volume.states == 1).sum()
    for maps in (tiles, irradiance):
        np.testing.assert_array_equal(maps.reshape(len(maps), -1).any(1), volume.states == 1)
    last = np.flatnonzero(volume.states == 1)[-1]
    tile, (row, column) = volume.atlases["radiance"].tile, np.divmod((volume.states == 1).sum() - 1, volume.atlases["radiance"].columns)
    layer, row = np.divmod(row, volume.atlases["radiance"].rows)
    stored = volume.atlases["radiance"].texels[layer, row * tile + 1 : (row + 1) * tile - 1, column * tile + 1 : (column + 1) * tile - 1]
    np.testing.assert_array_equal(tiles[last], stored)


def test_a_peer_s_texels_convolved_are_irradiance() -> None:
    """Of all directions alike it is as bright over π; of one texel, its part of the sphere by the cosine."""
    side, m = 16, 8
    radiance = np.zeros((2, side, side, 3))
    radiance[0], radiance[1, 3, 5] = 2.0, 1.0
    even, single = convolved_maps(radiance, m).irradiance
    np.testing.assert_allclose(even, 2.0, rtol=1e-12)
    toward, normals = texel_directions(side)[3, 5], texel_directions(m)
    solid_angle = texel_solid_angles(side)[3, 5]
    np.testing.assert_allclose(single[..., 0], np.maximum(normals @ toward, 0) * solid_angle / np.pi, atol=0.02 * solid_angle)


def test_when_a_curve_gets_there() -> None:
    curve = [(1.0, 0.4), (4.0, 0.2), (16.0, 0.1)]
    assert pairs.when(curve, 0.5) == 1 and pairs.when(curve, 0.1) == pytest.approx(16) and pairs.when(curve, 0.05) is None
    assert pairs.when(curve, 0.2 / math.sqrt(2)) == pytest.approx(8)
    assert pairs.when([(1.0, 0.4), (2.0, 0.0)], 0.1) == 2 and pairs.when([], 0.1) is None


def test_the_rate_of_runs() -> None:
    seconds = [1.0, 2.0, 8.0]
    rate = rate_of_runs(seconds, [0.3 * s**-0.7 for s in seconds])
    assert rate.slope == pytest.approx(-0.7) and rate.coefficient == pytest.approx(0.3)
    assert rate_of_runs([1.0, 1.0], [0.1, 0.2]).slope is None and rate_of_runs([1.0], [0.0]).points == 0


def test_sections_of_a_page() -> None:
    page = put_section("", "a", "one\n")
    page = put_section(page, "b", "two\n")
    page = put_section(page, "a", "three\n")
    assert page.count("<!-- bench a -->") == 1 and "one" not in page and page.index("three") < page.index("two")


def test_a_plot_of_nothing_says_so() -> None:
    assert "nothing above 0" in as_svg(error_against_seconds([Series("a", [(1.0, 0.0)])]))


def test_an_audit_in_words() -> None:
    assert audited_in_words(None) == "–"
    assert audited_in_words({"texels": {"irradiance": {"error": 0.013, "low": 0.011, "high": 0.016}}}) == "1.30 % (1.10 to 1.60)"


def prepared(tmp_path: Path, example: tuple[bytes, dict[str, Any]], **changes: Any) -> Any:
    glb, spec = example
    (tmp_path / "scene.glb").write_bytes(glb)
    return prepare(load_scene(tmp_path / "scene.glb"), parse_spec({**spec, **changes}))


def test_what_peers_are_given(tmp_path: Path) -> None:
    """Instances, one of them mirrored, flattened: the square at x = 1 and its twin, both facing the middle."""
    given = peers.work(prepared(tmp_path, square_emitter()), 2)
    (name,) = given["names"]
    points, triangles = given[f"{name}.points"].astype(float), given[f"{name}.triangles"]
    a, b, c = (points[triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    assert len(triangles) == 4 and (normal[:, 0] * a[:, 0] < 0).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1).sum() / 2, 2.0)


def test_what_peers_cannot_render(tmp_path: Path) -> None:
    assert peers.cannot_render(prepared(tmp_path, cornell()), "Mitsuba") is None
    assert "glossy" in str(peers.cannot_render(prepared(tmp_path, closed_box(0.5, 1.0, metallic=1.0, roughness=0.5)), "Cycles"))
    lamp = [{"kind": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]}]
    assert "point" in str(peers.cannot_render(prepared(tmp_path, closed_box(0.5, 1.0), lights=lamp), "Cycles"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Mitsuba", "Cycles"])
def test_peers_render_what_we_do(tmp_path: Path, name: str) -> None:
    """A furnace: radiance Le (1 + a + … + a⁴) in every texel; OCTOBAKE_PEERS names the folder of their environments."""
    folder = os.environ.get("OCTOBAKE_PEERS")
    found = {f.name: f for f in peers.find_peers(Path(folder) if folder else None)}
    if name not in found:
        pytest.skip(f"{name} is not installed: set OCTOBAKE_PEERS to a folder with its environment")
    work = peers.work(prepared(tmp_path, closed_box(0.5, 0.9), max_bounces=4), 2)
    with peers.running(found[name], work, tmp_path) as peer:
        tiles, seconds = peer.render(64, 1)
    assert tiles.shape == (8, 16, 16, 3) and seconds > 0
    truth = 0.9 * (1 + 1 / 2 + 1 / 4 + 1 / 8 + 1 / 16)
    assert float(tiles.mean()) == pytest.approx(truth, rel=0.01) and EPSILON > 0
