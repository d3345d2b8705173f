"""The command line, in this process: exit codes, one JSON document, errors on one line, nothing left by bad input."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest

from bake_core import irradiance
from bake_core.bundle import content_digest, read_bundle
from bake_core.convergence import Point
from bake_core.examples import closed_box, square_emitter
from bake_core.progress import Progress
from bake_core.spec import Spec
from service.cli import COMMANDS, main, parser
from service.cli.bake import INTEGRATORS
from service.cli.progress import ProgressLine, count
from tests.conformance import synthetic
from tests.faults.corpus import corpus
from tests.faults.fault import Fault

FEW = {"target_error": None, "max_samples": 4}


def write(folder: Path, glb: bytes, spec: dict[str, Any]) -> tuple[str, str]:
    """``scene.glb`` and ``spec.json`` in a folder."""
    (folder / "scene.glb").write_bytes(glb)
    (folder / "spec.json").write_text(json.dumps(spec))
    return str(folder / "scene.glb"), str(folder / "spec.json")


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of the square emitter, baked by the command; not to be written to."""
    folder = tmp_path_factory.mktemp("cli")
    glb, spec = square_emitter()
    scene, spec_file = write(folder, glb, {**spec, "stop": {"target_error": None, "max_samples": 16}})
    assert main(["bake", scene, "--spec", spec_file, "-o", str(folder / "bundle")]) == 0
    return folder / "bundle"


def document(capsys: pytest.CaptureFixture[str]) -> Any:
    """Stdout, which must be one JSON document and nothing else."""
    return json.loads(capsys.readouterr().out)


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    """Stderr's last line, which must be the only complaint; nothing on stdout."""
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if line.startswith("octobake:")]
    assert out == "" and len(lines) == 1 and "Traceback" not in err
    return lines[0]


# --- bake ----------------------------------------------------------------------------------------------------------------------------


def test_bake_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glb, spec = closed_box(0.5, 1.0)
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": FEW})
    assert main(["bake", scene, "--spec", spec_file, "-o", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    baked, audited = out.splitlines()
    assert "8 probes, 4 samples" in baked and audited.startswith("audit, ")
    assert "tracing" in err and "\r" not in err  # plain lines: this is no terminal
    read_bundle(tmp_path / "out")


def test_bake_may_be_told_another_integrator_than_the_spec_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert get_args(Spec.model_fields["integrator"].annotation) == INTEGRATORS
    glb, spec = closed_box(0.5, 1.0)
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": FEW})
    for name, ended in (("path", "traced to their ends"), ("cache", "ended in the light cache, which knew")):
        out = str(tmp_path / name)
        assert main(["bake", scene, "--spec", spec_file, "-o", out, "--integrator", name, "--audit-seconds", "0"]) == 0
        manifest = read_bundle(out).manifest
        assert manifest["spec"]["integrator"] == name and (manifest["sampling"]["cached"] is None) == (name == "path")
        capsys.readouterr()
        assert main(["info", out]) == 0 and f"paths      {ended}" in capsys.readouterr().out


def test_bake_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glb, spec = closed_box(0.5, 1.0)
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": {"target_error": None, "max_samples": 32}})
    out = tmp_path / "out.zip"
    assert main(["bake", scene, "--spec", spec_file, "-o", str(out), "--threads", "1", "--shards", "2", "--json"]) == 0
    told = document(capsys)
    assert told["bundle"] == str(out) and told["probes"] == 8 and told["samples"] == 32 and told["stopped"] == "samples"
    assert [p["samples"] for p in told["curve"]] == [16, 32] and told["error"] == told["curve"][-1]["error"]
    import zipfile

    with zipfile.ZipFile(out) as archive:
        assert told["content_digest"] == content_digest(archive.read("manifest.json"))


def test_bake_out_of_samples_is_4_and_the_bundle_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glb, spec = square_emitter()
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": {"target_error": 1e-9, "max_samples": 16}})
    assert main(["bake", scene, "--spec", spec_file, "-o", str(tmp_path / "out"), "--json"]) == 4
    out, err = capsys.readouterr()
    assert json.loads(out)["stopped"] == "samples"
    assert "above the target of" in err.splitlines()[-1] and "max_samples" in err.splitlines()[-1]
    assert read_bundle(tmp_path / "out").manifest["error"]["target"] == 1e-9


def test_bake_without_a_measured_error_is_4_where_one_was_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glb, spec = square_emitter()
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": {"target_error": 0.5, "max_samples": 2}})
    assert main(["bake", scene, "--spec", spec_file, "-o", str(tmp_path / "out"), "--json"]) == 4
    assert document(capsys)["error"] is None


@pytest.mark.parametrize("fault", corpus(), ids=lambda f: f.name[:60])
def test_every_bad_scene_is_2_with_its_slug_and_leaves_nothing(fault: Fault, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    scene = fault.write(tmp_path / "in")
    (tmp_path / "spec.json").write_text(json.dumps({"volumes": [{"fit": "scene", "counts": [2, 2, 2]}]}))
    began = time.perf_counter()
    assert main(["bake", str(scene), "--spec", str(tmp_path / "spec.json"), "-o", str(tmp_path / "out" / "bundle")]) == 2
    assert time.perf_counter() - began < 5
    assert complaint(capsys).startswith(f"octobake: error [{fault.slug}] {fault.where}: ")
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize(
    ("text", "slug"),
    [
        ("{", "spec.bad_json"),
        ('{"volumes": ' + "[" * 200_000, "spec.json_too_deep"),
        ('{"volumes": [], "volumez": []}', "spec.unknown_key"),
        ('{"volumes": [{"fit": "scene", "spacing": [0, 1, 1]}]}', "spec.invalid"),
        ('{"volumes": [{"fit": "scene", "spacing": [NaN, 1, 1]}]}', "spec.not_finite"),
        ('{"volumes": [{"fit": "scene", "counts": [4096, 4096, 2]}]}', "spec.too_many_probes"),
        ('{"volumes": [{"fit": "scene", "spacing": [1e-9, 1, 1]}]}', "spec.too_many_probes"),
        ('{"volumes": [{"fit": "node", "node": "none", "counts": [1, 1, 1]}]}', "spec.unknown_node"),
        (
            '{"volumes": [{"fit": "scene", "counts": [2, 2, 2]}], "environment": {"kind": "equirect", "image": "a.exr"}}',
            "spec.image_not_found",
        ),
    ],
)
@pytest.mark.parametrize("command", ["bake", "plan"])
def test_bad_specs_are_2(text: str, slug: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, spec_file = write(tmp_path, closed_box(0.5, 1.0)[0], {})
    Path(spec_file).write_text(text)
    arguments = [command, scene, "--spec", spec_file]
    if command == "bake":
        arguments += ["-o", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert complaint(capsys).startswith(f"octobake: error [{slug}] ")
    assert main([*arguments, "--json"]) == 2
    told = document(capsys)
    assert told["error"].keys() == {"slug", "where", "message"} and told["error"]["slug"] == slug
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.glb", "spec.json"]


def test_missing_files_and_places_are_2(tmp_path: Path, baked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, spec_file = write(tmp_path, *closed_box(0.5, 1.0))
    nowhere, out = str(tmp_path / "nowhere"), str(tmp_path / "out")
    for arguments, slug in (
        (["bake", nowhere + ".glb", "--spec", spec_file, "-o", out], "gltf.missing_file"),
        (["bake", scene, "--spec", nowhere, "-o", out], "spec.unreadable"),
        (["bake", scene, "--spec", spec_file, "-o", nowhere + "/out"], "bundle.no_folder"),
        (["bake", scene, "--spec", spec_file, "-o", spec_file], "bundle.in_the_way"),
        (["plan", nowhere + ".glb", "--spec", spec_file], "gltf.missing_file"),
        (["info", nowhere], "bundle.unreadable"),
        (["info", spec_file], "bundle.unreadable"),
        (["info", str(tmp_path)], "bundle.not_a_bundle"),
        (["sample", nowhere, "--at=0,0,0", "--normal=0,1,0"], "bundle.unreadable"),
        (["sample", str(baked), "--at=0,0,0"], "sample.usage"),
        (["sample", str(baked)], "sample.usage"),
        (["sample", str(baked), "--at=0,0,0", "--normal=0,0,0"], "sample.zero_normal"),
        (["sample", str(baked), "--points", nowhere], "sample.unreadable"),
    ):
        assert main(arguments) == 2, arguments
        assert f"[{slug}]" in complaint(capsys)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.glb", "spec.json"]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["bake"],
        ["fly"],
        ["bake", "a.glb", "--spec", "s.json"],
        ["bake", "a.glb", "--spec", "s.json", "-o", "x", "--threads", "0"],
        ["bake", "a.glb", "--spec", "s.json", "-o", "x", "--threads", "two"],
        ["sample", "b", "--at", "1,2"],
        ["sample", "b", "--at", "1,2,nan", "--normal", "0,1,0"],
        ["sample", "b", "--at", "1,2,3", "--normal", "0,1,inf"],
        ["info"],
    ],
)
def test_wrong_usage_is_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage:" in capsys.readouterr().err


def test_a_broken_machine_is_3(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from bake_core import report

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(report, "write", full)
    glb, spec = closed_box(0.5, 1.0)
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": FEW})
    assert main(["bake", scene, "--spec", spec_file, "-o", str(tmp_path / "out")]) == 3
    assert complaint(capsys).startswith("octobake: error [machine.cannot_write] ")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.glb", "spec.json"]


@pytest.mark.parametrize(
    ("stage", "albedo", "sent", "code", "says"),
    [
        ("tracing", 0.999, signal.SIGINT, 3, "[bake.cancelled]"),
        ("compiling", 0.5, signal.SIGINT, 130, "interrupted"),
        ("pass done", 0.5, signal.SIGINT, 4, "interrupted; the bundle holds what"),
        ("pass done", 0.5, signal.SIGTERM, 4, "interrupted; the bundle holds what"),
    ],
)
def test_ctrl_c_ends_a_bake_at_once(stage: str, albedo: float, sent: signal.Signals, code: int, says: str, tmp_path: Path) -> None:
    """As a process of its own: a line, no traceback; no file before the first pass has ended, a bundle of the best so far from then on."""
    glb, spec = closed_box(albedo, 1.0)
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": {"target_error": None, "max_samples": 1 << 24}})
    command = [sys.executable, "-c", "import sys; from service.cli import main; sys.exit(main())"]
    kernels = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")} if stage == "compiling" else {}
    process = subprocess.Popen(
        [*command, "bake", scene, "--spec", spec_file, "-o", str(tmp_path / "out")],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).resolve().parents[2],
        env={**os.environ, **kernels},
    )
    try:
        assert process.stderr is not None
        while stage not in (line := process.stderr.readline()):
            assert line, "the bake ended by itself"
        process.send_signal(sent)
        sent_at = time.perf_counter()
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == code and time.perf_counter() - sent_at < 3
    assert says in err and "Traceback" not in err
    left = {p.name for p in tmp_path.iterdir()} - {"scene.glb", "spec.json", "kernels"}
    if code != 4:
        assert out == "" and not left
        return
    assert left == {"out"}
    manifest = read_bundle(tmp_path / "out").manifest
    assert manifest["stopped"] == "interrupt" and manifest["samples"] >= 16 and f"{manifest['samples']} samples" in out


@pytest.mark.parametrize(("times", "code"), [(1, 4), (2, 130)])
def test_a_second_ctrl_c_writes_nothing(times: int, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any) -> None:
        for _number in range(times):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(ProgressLine, "point", interrupt)
    glb, spec = closed_box(0.5, 1.0)
    scene, spec_file = write(tmp_path, glb, {**spec, "stop": {"target_error": None, "max_samples": 1 << 24}})
    assert main(["bake", scene, "--spec", spec_file, "-o", str(tmp_path / "out")]) == code
    assert {p.name for p in tmp_path.iterdir()} - {"scene.glb", "spec.json"} == ({"out"} if code == 4 else set())


@pytest.mark.parametrize("terminal", [False, True])
def test_a_new_point_stays_above_the_line_that_is_redrawn(terminal: bool) -> None:
    class Stream(StringIO):
        def isatty(self) -> bool:
            return terminal

    stream = Stream()
    line = ProgressLine(stream)
    line(Progress("tracing", 0.5))
    line.point(Point(64, 3_140_000, 12.4, 0.031))
    # What a terminal shows of it: each line as it was last drawn.
    shown = [part.split("\r")[-1].replace("\x1b[K", "") for part in stream.getvalue().split("\n")]
    assert "pass done: 64 samples, 3.1 M rays, 12 s, error 3.1 %" in shown
    assert ("tracing  50 %" in shown[-1]) == terminal


@pytest.mark.parametrize(("number", "text"), [(0, "0"), (999, "999"), (12_345, "12 k"), (3_140_000, "3.1 M"), (5_000_000_000, "5.0 G")])
def test_large_numbers_are_short(number: int, text: str) -> None:
    assert count(number) == text


# --- plan, info ------------------------------------------------------------------------------------------------------------------------


def test_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, spec_file = write(tmp_path, *closed_box(0.5, 1.0))
    assert main(["plan", scene, "--spec", spec_file]) == 0
    text = capsys.readouterr().out
    for word in ("2×2×2", "irradiance", "left out", "saves", "time", "memory"):
        assert word in text
    assert main(["plan", scene, "--spec", spec_file, "--json", "--threads", "1"]) == 0
    told = document(capsys)
    assert told["probes"] == 8 and told["outputs"] == ["irradiance"] and told["seconds"] > 0
    assert told["measured"] is None and told["left_out"][0].keys() == {"what", "why", "bytes"}
    assert main(["plan", scene, "--spec", spec_file, "--measure", "--threads", "1"]) == 0
    assert "left out" in (text := capsys.readouterr().out) and "same texels box.irradiance" in text and "others" not in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.glb", "spec.json"]


def test_info(baked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(baked)]) == 0
    text = capsys.readouterr().out
    for word in (
        "bundle",
        "sha256:",
        "1×1×1 probes, 1 active",
        "irradiance",
        "stored as half",
        "left out",
        "seconds",
        "rays",
        "against samples",
        "audit      256 irradiance texels err by",
    ):
        assert word in text
    assert main(["info", str(baked), "--json"]) == 0
    told = document(capsys)
    assert told["manifest"] == read_bundle(baked).manifest and told["report"]["curve"]
    assert told["content_digest"] == content_digest((baked / "manifest.json").read_bytes())
    (baked / "report.json").rename(baked / "elsewhere")
    try:
        assert main(["info", str(baked), "--json"]) == 0
        assert document(capsys)["report"] is None
    finally:
        (baked / "elsewhere").rename(baked / "report.json")


# --- sample ----------------------------------------------------------------------------------------------------------------------------


def test_sample_is_the_numpy_twin(baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    positions = [[0.0, 0.0, 0.0], [0.25, -0.5, 0.1], [1e6, 0.0, 0.0]]
    normals = [[1.0, 0.0, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 5.0]]
    points = tmp_path / "points.json"
    points.write_text(json.dumps([{"position": p, "normal": n} for p, n in zip(positions[1:], normals[1:], strict=True)]))
    assert main(["sample", str(baked), "--at=0,0,0", "--normal=1,0,0", "--points", str(points), "--json"]) == 0
    told = document(capsys)["samples"]
    unit = np.array(normals) / np.linalg.norm(normals, axis=1, keepdims=True)
    truth = irradiance.sample(read_bundle(baked).volumes, positions, unit)
    assert [s["position"] for s in told] == positions and [s["normal"] for s in told] == normals
    np.testing.assert_array_equal([s["irradiance"] for s in told], truth.irradiance)
    np.testing.assert_array_equal([s["weights"] for s in told], truth.weights)
    assert {s["volume"] for s in told} == {"between"}
    assert main(["sample", str(baked), "--at=-1,0,0", "--normal", "0,1,0"]) == 0
    assert "irradiance" in capsys.readouterr().out


def test_sample_names_the_volumes_that_answer(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """In the finer one, a quarter of its spacing beyond it along x, and far from it."""
    monkeypatch.setattr("bake_core.bundle.read_bundle", lambda path: SimpleNamespace(volumes=synthetic.volumes()))
    points = ["-0.9,0.1,0.7", "-1.125,0.1,0.7", "1,-1,1"]
    words = ["sample", "b", *(f"--at={p}" for p in points), *["--normal=0,1,0"] * 3]
    assert main([*words, "--json"]) == 0
    told = document(capsys)["samples"]
    assert [s["volumes"] for s in told] == [
        [{"name": "fine", "weight": 1.0}],
        [{"name": "fine", "weight": 0.5}, {"name": "coarse", "weight": 0.5}],
        [{"name": "coarse", "weight": 1.0}],
    ]
    for sample in told:
        assert len(sample["probes"]) == len(sample["weights"]) == 8 * len(sample["volumes"])
        eights = np.reshape(sample["weights"], (-1, 8)).sum(1)
        np.testing.assert_allclose(eights, [v["weight"] for v in sample["volumes"]])
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "volume fine × 0.500, probes" in said and "volume coarse × 0.500, probes" in said


@pytest.mark.parametrize(
    ("text", "slug"),
    [
        ("", "sample.bad_json"),
        ("{}", "sample.invalid"),
        ('[{"position": [0, 0], "normal": [0, 1, 0]}]', "sample.invalid"),
        ('[{"position": [0, 0, 0]}]', "sample.invalid"),
        ('[{"position": [0, 0, true], "normal": [0, 1, 0]}]', "sample.invalid"),
        ('[{"position": [0, 0, 1e999], "normal": [0, 1, 0]}]', "sample.invalid"),
        ("[3]", "sample.invalid"),
        ("[]", "sample.usage"),
    ],
)
def test_sample_refuses_points_that_are_none(baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, slug: str) -> None:
    (tmp_path / "points.json").write_text(text)
    assert main(["sample", str(baked), "--points", str(tmp_path / "points.json")]) == 2
    assert f"[{slug}]" in complaint(capsys)


def test_sample_needs_irradiance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glb, spec = square_emitter()
    scene, spec_file = write(tmp_path, glb, {**spec, "outputs": ["distance"], "stop": FEW})
    assert main(["bake", scene, "--spec", spec_file, "-o", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert main(["sample", str(tmp_path / "out"), "--at=0,0,0", "--normal=0,1,0"]) == 2
    assert "[sample.no_irradiance]" in complaint(capsys)


# --- the whole -------------------------------------------------------------------------------------------------------------------------


def commands() -> dict[str, argparse.ArgumentParser]:
    (choices,) = (a.choices for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    return dict(choices)


def test_every_command_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert tuple(commands()) == COMMANDS
    for name in COMMANDS:
        with pytest.raises(SystemExit) as caught:
            main([name, "--help"])
        assert caught.value.code == 0 and "usage:" in capsys.readouterr().out


def test_an_interrupt_elsewhere_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from service.cli import info

    def interrupted(_: argparse.Namespace) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(info, "run", interrupted)
    assert main(["info", "x"]) == 130
    assert capsys.readouterr().err == "octobake: interrupted\n"
