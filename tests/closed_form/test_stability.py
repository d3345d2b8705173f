"""Every case of `octobake stability`, and what the command makes of them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from bake_core.errors import SceneError
from bake_core.stability import run
from bake_core.stability.case import Baker, Case, Result
from service.cli import main
from tests.baking import THREADS

ROOT = Path(__file__).resolve().parents[2]
FAULTS = "tests.closed_form.stability_faults"

CASES = [pytest.param(c, id=c.name, marks=pytest.mark.slow if c.slow else ()) for c in run.CASES]


@pytest.mark.parametrize("case", CASES)
def test_the_answer_is_the_known_one(case: Case) -> None:
    outcome = run.run_case(case, threads=THREADS)
    assert outcome.result.passed, outcome.document()


def test_names_are_unique() -> None:
    assert len({c.name for c in run.CASES}) == len(run.CASES)


def found(measured: float | str) -> Case:
    return Case(f"found {measured}", lambda baker: Result(1.0, measured, 0.5, "a < b"))


def refused(baker: Baker) -> Result:
    raise SceneError("scene.bad", "refused", "here")


@pytest.mark.parametrize(
    ("measured", "passed"), [(1.4, True), (1.6, False), (float("nan"), False), (float("inf"), False), ("words", False)]
)
def test_verdicts(measured: float | str, passed: bool) -> None:
    assert found(measured).run(None).passed == passed  # type: ignore[arg-type]


def here(monkeypatch: pytest.MonkeyPatch, *cases: Case) -> None:
    """The command with other cases, which are run in this process."""
    monkeypatch.setattr(run, "CASES", cases)
    named = {c.name: c for c in cases}
    monkeypatch.setattr(run, "run_apart", lambda name, threads: run.run_case(named[name], threads=threads))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    here(monkeypatch, found(1.25))
    assert main(["stability", "--json"]) == 0
    out, err = capsys.readouterr()
    (case,) = json.loads(out)["cases"]
    assert {k: case[k] for k in ("case", "expected", "measured", "tolerance", "verdict")} == {
        "case": "found 1.25",
        "expected": 1.0,
        "measured": 1.25,
        "tolerance": 0.5,
        "verdict": "pass",
    }
    assert err.startswith("1/1 pass found 1.25")
    here(monkeypatch, found(2.0), Case("refused", refused))
    assert main(["stability", "-o", str(tmp_path / "a" / "b")]) == 5
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["found", "2.0", "1", "2", "0.5", "FAIL"]
    assert lines[2].split() == ["refused", "a", "bake", "scene.bad", "0", "FAIL"]
    page = (tmp_path / "a" / "b" / "report.html").read_text(encoding="utf-8")
    assert "2 of 2 failed" in page and "a &lt; b" in page


def test_a_report_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    here(monkeypatch, found(1.0))
    (tmp_path / "file").write_text("")
    assert main(["stability", "-o", str(tmp_path / "file" / "below")]) == 3
    assert "machine.cannot_write" in capsys.readouterr().err


def test_no_case_takes_the_others_along(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(run, "_LIMIT", 30.0)
    before = set(Path(tempfile.gettempdir()).glob("octobake-stability-*"))
    ends = {name: run.run_apart(name, threads=1, cases=FAULTS) for name in ("fine", "not a number", "broken", "crashes")}
    monkeypatch.setattr(run, "_LIMIT", 3.0)
    ends["hangs"] = run.run_apart("hangs", threads=1, cases=FAULTS)
    assert {name: o.result.passed for name, o in ends.items()} == {"fine": True, **dict.fromkeys(ends.keys() - {"fine"}, False)}
    assert ends["broken"].result.measured == "ZeroDivisionError"
    assert ends["crashes"].result.measured == "SIGSEGV" and ends["crashes"].result.note.startswith("crashed")
    assert ends["hangs"].result.note.startswith("hung") and ends["hangs"].seconds < 20
    assert ends["not a number"].document()["measured"] == "nan"
    assert set(Path(tempfile.gettempdir()).glob("octobake-stability-*")) <= before


def test_ctrl_c_ends_it() -> None:
    command = subprocess.Popen([sys.executable, "-m", "service.cli", "stability"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert command.stderr is not None
    # One case is done, so that the next is under way: a process that still reads its modules has nothing to end.
    assert command.stderr.readline().startswith(b"1/")
    began = time.perf_counter()
    command.send_signal(signal.SIGINT)
    _, err = command.communicate(timeout=30)
    assert command.returncode == 130 and err.endswith(b"octobake: interrupted\n")
    assert time.perf_counter() - began < 10
