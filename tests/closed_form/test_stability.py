"""Every case of `octobake stability`, and what the command makes of them."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from bake_core.errors import Cancelled, SceneError
from bake_core.stability import run
from bake_core.stability.case import Baker, Case, Result
from service.cli import main
from tests.baking import THREADS

CASES = [pytest.param(c, id=c.name, marks=pytest.mark.slow if c.slow else ()) for c in run.CASES]


@pytest.mark.parametrize("case", CASES)
def test_the_answer_is_the_known_one(case: Case) -> None:
    outcome = run.run_case(case, threads=THREADS, cancelled=np.zeros(1, np.uint8))
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


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "CASES", (found(1.25),))
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
    monkeypatch.setattr(run, "CASES", (found(2.0), Case("refused", refused)))
    assert main(["stability", "-o", str(tmp_path / "a" / "b")]) == 5
    lines = capsys.readouterr().out.splitlines()
    broken = Case("broken", lambda baker: Result(1.0, 1 // 0, 0.0, ""))
    assert run.run_case(broken, threads=1, cancelled=np.zeros(1, np.uint8)).result.measured == "ZeroDivisionError"
    assert lines[1].split() == ["found", "2.0", "1", "2", "0.5", "FAIL"]
    assert lines[2].split() == ["refused", "a", "bake", "scene.bad", "0", "FAIL"]
    page = (tmp_path / "a" / "b" / "report.html").read_text(encoding="utf-8")
    assert "2 of 2 failed" in page and "a &lt; b" in page


def test_a_report_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "CASES", (found(1.0),))
    (tmp_path / "file").write_text("")
    assert main(["stability", "-o", str(tmp_path / "file" / "below")]) == 3
    assert "machine.cannot_write" in capsys.readouterr().err


def waits(baker: Baker) -> Result:
    """A kernel that goes on until its flag is raised."""
    while not baker.cancelled[0]:
        time.sleep(0.01)
    raise Cancelled


def test_a_case_that_hangs_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "_LIMIT", 0.2)
    flag = np.zeros(1, np.uint8)
    hung, fine = run.run_cases((Case("waits", waits), found(1.0)), threads=1, cancelled=flag)
    assert not hung.result.passed and hung.result.note == "it hangs"
    assert fine.result.passed and not flag[0]


def test_ctrl_c_ends_it(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "CASES", (Case("waits", waits), found(1.0)))
    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    assert main(["stability"]) == 130
    timer.join()
    assert capsys.readouterr().err.endswith("octobake: interrupted\n")
