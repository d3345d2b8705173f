"""The whole bake: the same bytes however it is split, every way of stopping, nothing left where it fails."""

from __future__ import annotations

import threading
import time
from dataclasses import asdict, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core import tally
from bake_core.allocation import Allocation
from bake_core.bake import BakeResult, bake, empty_state, finish, gather
from bake_core.bundle import read_bundle, read_report
from bake_core.clock import Clock
from bake_core.convergence import Point, Verdict, decide, next_pass
from bake_core.environment import beside
from bake_core.errors import BakeError, Cancelled, SceneError
from bake_core.examples import closed_box, cornell, plane_under_sun, square_emitter
from bake_core.gltf.reader import load_scene
from bake_core.gltf.writer import GlbWriter
from bake_core.irradiance import sample
from bake_core.octahedral import oct_to_dir, texel_directions, with_border
from bake_core.parameters import PARAMETERS
from bake_core.prepared import prepare
from bake_core.progress import Progress
from bake_core.report import Run
from bake_core.shards import shard_ranges, trace_shard
from bake_core.spec import Stop, parse_spec
from bake_core.tally import State, Tally
from tests.baking import maps
from tests.pavilion import pavilion_spec, write_pavilion
from tests.scenes import add_square, sky
from tests.unit.test_bundle import files

Array = NDArray[Any]
SMALL_GRID = {"name": "room", "origin": [-0.7, 0.3, -0.7], "spacing": [0.7, 0.7, 0.7], "counts": [3, 3, 3]}


def bake_into(folder: Path, glb: bytes, spec: dict[str, Any], out: str = "out", **options: Any) -> BakeResult:
    scene = folder / "scene.glb"
    if not scene.exists():
        scene.write_bytes(glb)
    return bake(scene, parse_spec(spec), folder / out, **options)


def small_cornell(**stop: Any) -> tuple[bytes, dict[str, Any]]:
    glb, spec = cornell()
    return glb, {**spec, "volumes": [SMALL_GRID], "stop": {"target_error": None, "max_samples": 20, **stop}}


def test_the_same_bytes_for_any_threads_shards_and_packing(tmp_path: Path) -> None:
    """Two volumes, all outputs, a pass that ends short."""
    glb, spec = small_cornell()
    second = {"name": "low", "origin": [-0.5, 0.1, -0.5], "spacing": [1, 1, 1], "counts": [2, 1, 2]}
    small = {"distance": 16, "normal": 8, "visibility": 8}
    spec |= {
        "volumes": [SMALL_GRID, second],
        "outputs": ["normal", "distance", "radiance", "visibility", "irradiance"],
        "resolution": small,
    }
    (tmp_path / "scene.glb").write_bytes(glb)
    assert baked_alike(tmp_path / "scene.glb", spec) == 2 * 9


def test_the_same_bytes_with_textures_holes_gloss_and_a_sky(tmp_path: Path) -> None:
    assert baked_alike(write_pavilion(tmp_path), pavilion_spec()) == 9


def test_the_same_bytes_where_easy_probes_get_fewer_samples(tmp_path: Path) -> None:
    glb, spec = small_cornell(target_error=0.01, max_samples=4096)
    (tmp_path / "scene.glb").write_bytes(glb)
    assert baked_alike(tmp_path / "scene.glb", spec) == 4
    manifest = read_bundle(tmp_path / "a").manifest
    assert manifest["sampling"]["mean_samples"] < manifest["samples"]


def baked_alike(scene: Path, spec: dict[str, Any]) -> int:
    """Bake in every way: the manifest and every file that it names are the same; the number of EXRs among them."""
    made, rays = [], set()
    for threads, shards, out in ((1, 1, "a"), (2, 1, "b"), (1, 3, "c"), (2, 3, "d.zip"), (3, 1000, "e")):
        result = bake(scene, parse_spec(spec), scene.parent / out, threads=threads, shards=shards, find=beside(scene.parent))
        made.append(files(scene.parent / out))
        rays.add(tuple(p.rays for p in result.run.curve))
        read_bundle(scene.parent / out)
    assert len(rays) == 1, "so is the number of rays after each pass"
    for other in made[1:]:
        assert other.keys() == made[0].keys()
        assert [name for name in other if other[name] != made[0][name]] == []
    return sum(name.endswith(".exr") for name in made[0])


@pytest.mark.parametrize("stop", [{}, {"target_error": 0.01, "max_samples": 4096}], ids=["samples", "target"])
def test_a_bake_in_steps_through_bytes_is_the_same_bake(stop: dict[str, Any], tmp_path: Path) -> None:
    """As the service does it: shards anywhere, in any order, tallies and state stored between passes."""
    glb, spec = small_cornell(**stop)
    whole = bake_into(tmp_path, glb, spec, "whole")
    prepared = prepare(load_scene(tmp_path / "scene.glb"), parse_spec(spec))
    stored = empty_state(prepared).to_bytes()
    verdict: Verdict = "continue"
    while verdict == "continue":
        state = State.from_bytes(stored)
        run = next_pass(prepared.spec.stop, state.samples, state.error())
        elsewhere = prepare(load_scene(tmp_path / "scene.glb"), parse_spec(spec))  # another worker
        given = Allocation.from_bytes(state.allocation.to_bytes())
        tallies = [trace_shard(elsewhere, r, run, given, threads=1).to_bytes() for r in reversed(shard_ranges(27, 4))]
        state.add([Tally.from_bytes(t) for t in tallies])
        state.allocate(prepared.spec.stop)
        stored = state.to_bytes()
        verdict = decide(prepared.spec.stop, state.samples, state.error(), 0.0)
    assert verdict == whole.run.stopped and state.samples == whole.manifest["samples"]
    finish(prepared, State.from_bytes(stored), Run(threads=1, shards=4, stopped=verdict), tmp_path / "steps")
    assert files(tmp_path / "steps") == files(tmp_path / "whole")


def test_another_seed_is_another_bundle(tmp_path: Path) -> None:
    glb, spec = small_cornell(max_samples=4)
    a, b = (bake_into(tmp_path, glb, {**spec, "seed": seed}, f"s{seed}").manifest for seed in (0, 1))
    assert a["files"]["room.irradiance.exr"] != b["files"]["room.irradiance.exr"]
    assert a["files"]["room.visibility.exr"] == b["files"]["room.visibility.exr"]


@pytest.mark.parametrize(("probes", "shards"), list(product([1, 2, 7, 1000], [1, 2, 3, 7, 2000])))
def test_shards_cover_all_probes_evenly(probes: int, shards: int) -> None:
    ranges = shard_ranges(probes, shards)
    assert ranges[0][0] == 0 and ranges[-1][1] == probes and all(a[1] == b[0] for a, b in pairwise(ranges))
    sizes = [b - a for a, b in ranges]
    assert len(ranges) == min(probes, shards) and max(sizes) - min(sizes) <= 1 and min(sizes) > 0


# --- stopping ------------------------------------------------------------------------------------------------------------------------


def test_stops_at_the_target(tmp_path: Path) -> None:
    glb, spec = small_cornell(target_error=0.2, max_samples=4096)
    result = bake_into(tmp_path, glb, spec)
    assert result.met and result.manifest["stopped"] == "target" == result.run.stopped
    assert result.manifest["samples"] < 4096
    assert result.manifest["error"]["value"] <= 0.2 and result.manifest["error"]["target"] == 0.2


def test_out_of_samples_before_the_target(tmp_path: Path) -> None:
    glb, spec = small_cornell(target_error=1e-6, max_samples=32)
    result = bake_into(tmp_path, glb, spec)
    assert not result.met and result.manifest["stopped"] == "samples" and result.manifest["samples"] == 32
    assert result.manifest["error"]["value"] > 1e-6
    read_bundle(tmp_path / "out")


def test_no_target_is_always_met(tmp_path: Path) -> None:
    glb, spec = small_cornell(max_samples=4)
    assert bake_into(tmp_path, glb, spec).met


def test_out_of_time(tmp_path: Path) -> None:
    glb, spec = closed_box(0.99, 1.0)
    bake_into(tmp_path, glb, {**spec, "stop": {"target_error": None, "max_samples": 1}}, "warm")
    limited = {**spec, "stop": {"target_error": 1e-9, "max_seconds": 1.5, "max_samples": 1 << 24}}
    result = bake_into(tmp_path, glb, limited)
    # The first pass is always whole; after it, passes are cut to what is left.
    assert result.run.curve[-1].seconds < 1.5 * max(1.5, result.run.curve[0].seconds) + 1
    assert result.manifest["stopped"] == "time" and not result.met
    assert result.manifest["samples"] >= 16 and result.manifest["samples"] % 4 == 0
    assert result.manifest["samples"] == result.run.curve[-1].samples
    read_bundle(tmp_path / "out")


def test_the_curve_has_a_point_for_each_doubling_and_errors_fall(tmp_path: Path) -> None:
    glb, spec = small_cornell(max_samples=256)
    result = bake_into(tmp_path, glb, spec)
    assert [p.samples for p in result.run.curve] == [16, 32, 64, 128, 256]
    assert all(a.seconds < b.seconds for a, b in pairwise(result.run.curve))
    errors = [p.error for p in result.run.curve]
    assert errors[0] > 2 * errors[-1] > 0  # type: ignore[operator]
    assert {k: result.manifest["error"][k] for k in ("value", "target", "scrambles")} == {
        "value": errors[-1],
        "target": None,
        "scrambles": 8,
    }
    report = read_report(tmp_path / "out")
    assert report is not None
    assert report["curve"] == [asdict(p) for p in result.run.curve]
    assert set(report["stages"]) == {"reading", "building", "compiling", "tracing", "writing"}


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_with_fewer_samples_than_scrambles_the_error_is_null(tmp_path: Path, samples: int) -> None:
    glb, spec = small_cornell(max_samples=samples, target_error=0.5)
    result = bake_into(tmp_path, glb, spec)
    assert result.manifest["error"]["value"] is None and result.run.curve[-1].error is None
    assert result.manifest["stopped"] == "samples" and not result.met
    assert "–" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_the_error_figure_is_no_smaller_than_the_error(tmp_path: Path) -> None:
    """Against a bake of 16 times the samples, on the Cornell box: what is claimed holds, and is no empty claim."""
    glb, spec = small_cornell()
    few = bake_into(tmp_path, glb, {**spec, "stop": {"target_error": None, "max_samples": 32}, "seed": 1}, "few")
    bake_into(tmp_path, glb, {**spec, "stop": {"target_error": None, "max_samples": 512}, "seed": 2}, "many", threads=2)
    a, b = maps(read_bundle(tmp_path / "few")), maps(read_bundle(tmp_path / "many"))
    square = (b**2).sum(-1)
    error = np.sqrt((((a - b) ** 2).sum(-1) / (square + (0.05 * np.sqrt(square).mean()) ** 2)).mean())
    claimed = few.manifest["error"]["value"]
    assert error < claimed < 2 * error


def test_the_error_of_radiance_is_no_smaller_than_it_is(tmp_path: Path) -> None:
    """Of a single probe, too, which has only two halves to tell from: 12 seeds against a bake of 32 times the samples."""
    glb, _ = cornell()
    (tmp_path / "scene.glb").write_bytes(glb)
    one = {"origin": [0.3, 1.1, 0.2], "spacing": [1, 1, 1], "counts": [1, 1, 1]}
    prepared = prepare(load_scene(tmp_path / "scene.glb"), parse_spec({"volumes": [one], "outputs": ["radiance"]}))

    def baked(seed: int, samples: int) -> State:
        spec = prepared.spec.model_copy(update={"seed": seed, "stop": Stop(target_error=None, max_samples=samples)})
        return gather(replace(prepared, spec=spec), Run(2, 1), Clock(spec, None))

    truth = baked(0, 2048).mean_radiance()
    square = (truth**2).sum(-1)
    ratios = []
    for seed in range(1, 13):
        state = baked(seed, 64)
        difference = ((state.mean_radiance() - truth) ** 2).sum(-1)
        stated = state.radiance_error()
        assert stated is not None
        ratios.append(float(np.sqrt((difference / (square + (0.05 * np.sqrt(square).mean()) ** 2)).mean())) / stated)
    assert sum(r <= 1 for r in ratios) >= 9, "of 12 bounds that hold 95 times out of 100, fewer than 9 do 2 times in 10,000"
    assert float(np.median(ratios)) > 1 / 1.5, "and it is no empty claim"


def test_the_error_of_each_output_and_of_the_worst_probes(tmp_path: Path) -> None:
    """Two volumes: those who err most are named by their volume, their number in it and where they stand."""
    glb, spec = small_cornell(max_samples=32)
    low = {"name": "low", "origin": [-0.5, 0.1, -0.5], "spacing": [1, 1, 1], "counts": [2, 1, 2]}
    everything = ["irradiance", "visibility", "radiance", "distance", "normal"]
    (tmp_path / "scene.glb").write_bytes(glb)
    prepared = prepare(
        load_scene(tmp_path / "scene.glb"),
        parse_spec({**spec, "volumes": [SMALL_GRID, low], "outputs": everything, "resolution": {"distance": 16, "normal": 8}}),
    )
    run = Run(2, 1)
    state = gather(prepared, run, Clock(prepared.spec, None))
    error = finish(prepared, state, run, tmp_path / "out")["error"]
    assert [x["output"] for x in error["outputs"]] == everything
    values = {x["output"]: x["value"] for x in error["outputs"]}
    assert values["irradiance"] == error["value"] < values["radiance"] < 1, "a texel of radiance gets a few paths, one of irradiance all"
    assert [values[o] for o in ("visibility", "distance", "normal")] == [None] * 3
    probes = state.probe_errors()
    inside = ~state.active()
    assert np.isnan(probes[inside]).all() and np.isfinite(probes[~inside]).all()
    worst = error["probes"]["worst"]
    assert [w["error"] for w in worst] == sorted(probes[~inside], reverse=True)[:8]
    assert error["probes"]["median"] <= error["probes"]["p95"] <= worst[0]["error"]
    first = {"room": 0, "low": 27}
    stand = np.concatenate([v.positions() for v in prepared.volumes])
    for w in worst:
        flat = first[w["volume"]] + w["probe"]
        assert probes[flat] == w["error"] and w["position"] == stand[flat].tolist()
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"<td>{worst[0]['volume']}</td><td>{worst[0]['probe']}</td>" in page and "not sampled" in page


def test_who_is_told_of_points_hears_each_as_it_is_measured(tmp_path: Path) -> None:
    glb, spec = small_cornell(max_samples=64)
    told: list[Point] = []
    result = bake_into(tmp_path, glb, spec, point=told.append)
    assert told == result.run.curve and [p.samples for p in told] == [16, 32, 64]
    # Each pass of a probe's 16 × 16 texels is at least that many rays; the first has those for distances, 64 × 64, as well.
    steps = np.diff([p.rays for p in told], prepend=0) / 27
    assert steps[0] > 16 * 256 + 4096 and (steps[1:] > np.array([16, 32]) * 256).all() and steps[2] == pytest.approx(2 * steps[1], rel=0.02)


# --- cancelling, failing --------------------------------------------------------------------------------------------------------------


def test_cancelling_ends_within_half_a_second_and_leaves_nothing(tmp_path: Path) -> None:
    glb, spec = closed_box(0.99, 1.0)
    flag = np.zeros(1, np.uint8)
    cancelled_at: list[float] = []

    def cancel() -> None:
        cancelled_at.append(time.perf_counter())
        flag.fill(1)

    timer = threading.Timer(0.3, cancel)

    def watch(progress: Progress) -> None:
        if progress.stage == "tracing" and not timer.is_alive() and not cancelled_at:
            timer.start()

    endless = {**spec, "stop": {"target_error": None, "max_samples": 1 << 24}}
    with pytest.raises(Cancelled):
        bake_into(tmp_path, glb, endless, progress=watch, cancelled=flag, threads=2)
    assert time.perf_counter() - cancelled_at[0] < 0.5
    assert [p.name for p in tmp_path.iterdir()] == ["scene.glb"]


def test_a_bake_that_is_stopped_writes_the_passes_that_are_whole(tmp_path: Path) -> None:
    """Stopped in its second pass it is the bake of 16 samples, but for what the manifest says of its end."""
    glb, spec = small_cornell(max_samples=16)
    bake_into(tmp_path, glb, spec, "short")
    flag = np.zeros(1, np.uint8)
    endless = {**spec, "stop": {"target_error": None, "max_samples": 1 << 24}}
    result = bake_into(tmp_path, glb, endless, point=lambda _: flag.fill(1), cancelled=flag)
    assert result.run.stopped == "interrupt" == result.manifest["stopped"] and result.manifest["samples"] == 16
    assert not result.met, "nobody asked for 16 samples"
    short, out = files(tmp_path / "short"), files(tmp_path / "out")
    assert short.keys() == out.keys() and {n for n in out if out[n] != short[n]} == {"manifest.json"}


def test_what_cannot_be_stored_is_an_error_and_never_an_infinity(tmp_path: Path) -> None:
    """Close to a square of radiance 2e38 irradiance is 6e38: more than float32 holds."""
    w = GlbWriter()
    add_square(w, "sun", (0.9,) * 3, emission=(2e38,) * 3, double_sided=True)
    spec = {
        "volumes": [{"origin": [0, 0.01, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}],
        "stop": {"target_error": None, "max_samples": 4},
    }
    with pytest.raises(BakeError) as caught:
        bake_into(tmp_path, w.to_glb(), spec)
    assert caught.value.slug == "bake.not_finite" and "v0" in caught.value.where
    assert [p.name for p in tmp_path.iterdir()] == ["scene.glb"]


def test_bright_light_is_stored_in_full(tmp_path: Path) -> None:
    glb, spec = closed_box(0.5, 50_000.0)
    manifest = bake_into(tmp_path, glb, {**spec, "stop": {"target_error": None, "max_samples": 16}}).manifest
    (irradiance,) = manifest["volumes"][0]["atlases"]
    assert irradiance["encoding"] == "float"
    assert maps(read_bundle(tmp_path / "out")).mean() == pytest.approx(np.pi * 100_000, rel=0.01)


def test_a_bad_scene_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(SceneError):
        bake_into(tmp_path, b"not a scene", closed_box(0.5, 1.0)[1])
    assert [p.name for p in tmp_path.iterdir()] == ["scene.glb"]


# --- progress ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shards", [1, 3])
def test_progress_never_falls_and_goes_through_all_stages(tmp_path: Path, shards: int) -> None:
    told: list[Progress] = []
    glb, spec = small_cornell(max_samples=64, target_error=0.05)
    bake_into(tmp_path, glb, spec, progress=told.append, shards=shards, threads=2)
    assert all(a.fraction <= b.fraction for a, b in pairwise(told))
    assert all(0 <= p.fraction <= 1 for p in told) and told[-1].fraction >= 0.97
    stages = [p.stage for p in told]
    assert list(dict.fromkeys(stages)) == ["reading", "building", "compiling", "tracing", "writing"]
    assert all(a.seconds <= b.seconds for a, b in pairwise(told))
    measured = [p for p in told if p.error is not None]
    assert measured and measured[0].samples == 16


# --- what is baked --------------------------------------------------------------------------------------------------------------------


def test_all_outputs(tmp_path: Path) -> None:
    """A square 1 m to both sides of a probe: distances and normals by geometry, misses where there is nothing, radiance 1 or 0."""
    glb, spec = square_emitter()
    everything = ["irradiance", "visibility", "radiance", "distance", "normal"]
    small = {"radiance": 16, "distance": 32, "normal": 16, "visibility": 8, "irradiance": 4}
    result = bake_into(
        tmp_path, glb, {**spec, "outputs": everything, "resolution": small, "stop": {"target_error": None, "max_samples": 16}}
    )
    bundle = read_bundle(tmp_path / "out")
    assert list(bundle.volumes[0].atlases) == [*everything, "walls"]
    assert (tmp_path / "out" / "report.html").read_text().count("irradiance.exr") == 1
    assert not any("bytes" in x for x in result.manifest["left_out"])
    described = {a["output"]: a for a in result.manifest["volumes"][0]["atlases"]}
    assert [described[o]["interior"] for o in everything] == [4, 8, 16, 32, 16]
    d = texel_directions(32)
    x, y, z = np.abs(np.moveaxis(d, -1, 0))
    hit = np.maximum(y, z) < x / 2
    distance = maps(bundle, "distance")[0, :, :, 0]
    np.testing.assert_allclose(distance[hit], 1 / x[hit], rtol=1e-4)
    miss = described["distance"]["miss"]
    assert (distance[~hit] == miss).all() and 4 * np.sqrt(6) <= miss < 8 * np.sqrt(6)
    d = texel_directions(16)
    x, y, z = np.abs(np.moveaxis(d, -1, 0))
    hit = np.maximum(y, z) < x / 2
    normal = maps(bundle, "normal")[0]
    assert not normal[~hit].any()
    np.testing.assert_allclose(normal[hit][:, 0], -np.sign(d[hit][:, 0]), atol=1e-3)
    radiance = maps(bundle, "radiance")[0]
    assert set(np.unique(radiance)) >= {0.0, 1.0} and radiance.max() == 1
    # Every tile has its border.
    for output, atlas in bundle.volumes[0].atlases.items():
        interior = maps(bundle, output).astype(np.float32)
        np.testing.assert_array_equal(atlas.texels.reshape(1, atlas.tile, atlas.tile, -1), with_border(interior))


def test_one_output_alone(tmp_path: Path) -> None:
    glb, spec = square_emitter()
    for output in ("irradiance", "visibility", "radiance", "distance", "normal"):
        chosen = {**spec, "outputs": [output], "stop": {"target_error": None, "max_samples": 4}}
        manifest = bake_into(tmp_path, glb, chosen, output).manifest
        walls = ["walls"] if output == "visibility" else []
        assert [a["output"] for a in manifest["volumes"][0]["atlases"]] == [output, *walls]
        assert {x["what"] for x in manifest["left_out"] if "bytes" in x} == {
            "irradiance",
            "visibility",
            "radiance",
            "distance",
            "normal",
        } - {output}


def test_probes_inside_geometry_are_inactive(tmp_path: Path) -> None:
    """A closed box seen from outside by one probe, and a probe within it that sees the backs of its walls."""
    from trimesh.creation import box

    from bake_core.gltf.writer import Part

    mesh = box((1, 1, 1))
    w = GlbWriter()
    part = Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), material=w.material("grey", (0.5,) * 3))
    w.node("box", mesh=w.mesh("box", [part]))
    spec = {
        "volumes": [{"origin": [0.1, 0.1, 0.1], "spacing": [2, 2, 2], "counts": [2, 1, 1]}],
        "probes": "lattice",
        "environment": sky(),
        "stop": {"target_error": None, "max_samples": 16},
    }
    probes = bake_into(tmp_path, w.to_glb(), spec).manifest["volumes"][0]["probes"]
    assert probes["states"] == [0, 1] and probes["active"] == 1
    assert probes["backface"] == [1, 0]
    bundle = read_bundle(tmp_path / "out")
    assert bundle.volumes[0].states.tolist() == [0, 1] and bundle.volumes[0].tiles.tolist() == [-1, 0]
    assert len(maps(bundle)) == 1 and maps(bundle).all()


def test_leaving_out_probes_inside_solids_changes_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Baked both ways: texels of kept probes and what a query weighs them by are the same bits; rays and bytes are fewer."""
    glb, spec = box_among_probes()
    spec["outputs"] = ["irradiance", "visibility", "radiance", "distance", "normal"]
    spec["stop"] = {"target_error": 1e-9, "max_samples": 64}
    fewer = bake_into(tmp_path, glb, spec, "fewer", shards=3)
    with monkeypatch.context() as patch:
        patch.setattr(tally, "BACKFACE_LIMIT", 2.0)
        everything = bake_into(tmp_path, glb, spec, "all")
    a, b = read_bundle(tmp_path / "fewer"), read_bundle(tmp_path / "all")
    kept = a.volumes[0].states == 1
    assert (~kept).sum() == 8 and b.volumes[0].states.all()
    for output in spec["outputs"]:
        np.testing.assert_array_equal(maps(a, output), maps(b, output)[kept])
    assert fewer.run.curve[-1].rays < everything.run.curve[-1].rays
    (entry,) = (x for x in fewer.manifest["left_out"] if x not in everything.manifest["left_out"])
    assert entry["what"] == "8 of 64 probes"
    half, full = (
        sum(x.texels[0, 0, 0].size * x.tile**2 for x in a.volumes[0].atlases.values() if x.encoding == e) for e in ("half", "float")
    )
    assert entry["bytes"] == 8 * (2 * half + 4 * full)
    size = [sum(x.texels.size for x in bundle.volumes[0].atlases.values()) for bundle in (a, b)]
    assert size[0] == size[1] * 56 / 64

    random = np.random.default_rng(5)
    points, normals = random.uniform(-2, 2, (500, 3)), oct_to_dir(random.uniform(-1, 1, (500, 2)))
    # What a bake measures at surfaces to choose by is of all its probes: asked for with the same parameters.
    both = (replace(bundle.volumes[0], parameters=PARAMETERS) for bundle in (a, b))
    ours, theirs = (sample([volume], points, normals) for volume in both)
    weights = theirs.weights * kept[theirs.probes]
    some = weights.sum(-1) > 0
    np.testing.assert_allclose(ours.weights[some], weights[some] / weights[some].sum(-1, keepdims=True), rtol=1e-12)
    assert not ours.weights[~kept[ours.probes]].any() and some.sum() > 400


def test_a_volume_within_a_solid_has_no_tiles_and_gives_no_light(tmp_path: Path) -> None:
    glb, spec = box_among_probes()
    spec["volumes"] = [{"origin": [-0.2] * 3, "spacing": [0.4] * 3, "counts": [2, 2, 2]}]
    spec["stop"] = {"target_error": 0.01, "max_samples": 32}
    result = bake_into(tmp_path, glb, spec)
    assert result.manifest["volumes"][0]["probes"]["active"] == 0
    bundle = read_bundle(tmp_path / "out")
    found = sample(bundle.volumes, [[0, 0, 0]], [[0, 1, 0]])
    assert not found.irradiance.any() and not found.weights.any() and (bundle.volumes[0].tiles == -1).all()


def box_among_probes() -> tuple[bytes, dict[str, Any]]:
    """4³ probes, of which the inner eight are inside a box."""
    from trimesh.creation import box

    from bake_core.gltf.writer import Part

    mesh = box((2, 2, 2))
    w = GlbWriter()
    part = Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), material=w.material("grey", (0.5,) * 3))
    w.node("box", mesh=w.mesh("box", [part]))
    return w.to_glb(), {"volumes": [{"origin": [-1.95] * 3, "spacing": [1.3] * 3, "counts": [4, 4, 4]}], "environment": sky()}


def test_several_volumes_are_baked_each_by_itself(tmp_path: Path) -> None:
    """The second volume's bake depends on its probes' numbers only: it is found in the first bake's files."""
    glb, spec = plane_under_sun()
    grids = [{"name": n, "origin": [x, 1, 0], "spacing": [1, 1, 1], "counts": [2, 1, 1]} for n, x in (("a", 0.0), ("b", 50.0))]
    bake_into(tmp_path, glb, {**spec, "volumes": grids, "stop": {"target_error": None, "max_samples": 16}})
    bundle = read_bundle(tmp_path / "out")
    assert [v.name for v in bundle.volumes] == ["a", "b"]
    down = [maps(bundle, volume=i).max((1, 2, 3)) for i in (0, 1)]
    np.testing.assert_allclose(down, 0.5 * 3 * 0.8, rtol=0.06)


def test_nothing_but_sky(tmp_path: Path) -> None:
    w = GlbWriter()
    w.node("empty")
    grid = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 2, 1]}
    bake_into(tmp_path, w.to_glb(), {"volumes": [grid], "environment": sky(2.0), "outputs": ["irradiance", "visibility"]})
    bundle = read_bundle(tmp_path / "out")
    np.testing.assert_allclose(maps(bundle), 2 * np.pi, rtol=1e-3)
    assert bundle.manifest["error"]["value"] < 1e-9 and bundle.manifest["stopped"] == "target"
    moments = maps(bundle, "visibility")
    np.testing.assert_allclose(moments[..., 0], bundle.volumes[0].distance_limit, rtol=1e-6)


def test_black_is_exactly_black(tmp_path: Path) -> None:
    glb, spec = closed_box(0.9, 0.0)
    lit_outside = {"lights": [{"kind": "directional", "direction": [0, -1, 0], "irradiance": [1e9] * 3}], "environment": sky(1e9)}
    result = bake_into(tmp_path, glb, {**spec, **lit_outside, "stop": {"max_samples": 64}})
    assert not maps(read_bundle(tmp_path / "out")).any()
    assert result.manifest["error"]["value"] == 0 and result.met
