"""Runs the cases, each in a process of its own, and writes what they found as a page."""

from __future__ import annotations

import html
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bake_core.errors import MachineError, OctobakeError
from bake_core.stability import closed_rooms, crowds, geometry, leaks, maps, materials, placement, ranges
from bake_core.stability.case import Baker, Case, Result

CASES: tuple[Case, ...] = (
    *closed_rooms.CASES,
    *ranges.CASES,
    *placement.CASES,
    *maps.CASES,
    *leaks.CASES,
    *materials.CASES,
    *geometry.CASES,
    *crowds.CASES,
)
# A case that takes longer hangs, by the promise that none does: they take seconds, the longest half a minute of two cores, and kernels are
# compiled in less than a minute; the rest is for machines that others use, too.
_LIMIT = 300.0


@dataclass(frozen=True)
class Outcome:
    """A case with what it found and the seconds it took."""

    name: str
    result: Result
    seconds: float

    def document(self) -> dict[str, Any]:
        r = self.result
        return {
            "case": self.name,
            "expected": r.expected,
            # JSON knows no NaN.
            "measured": r.measured if isinstance(r.measured, str) or math.isfinite(r.measured) else str(r.measured),
            "tolerance": r.tolerance,
            "verdict": "pass" if r.passed else "fail",
            "note": r.note,
            "seconds": self.seconds,
        }


def run_case(case: Case, *, threads: int) -> Outcome:
    """Run one case here, in a folder that is gone afterwards."""
    began = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory(prefix="octobake-stability-") as folder:
            result = case.run(Baker(Path(folder), threads))
    except Exception as e:
        # A fault of ours is a case that fails, and no reason to leave out the others.
        result = Result("a bake", e.slug if isinstance(e, OctobakeError) else type(e).__name__, 0.0, str(e))
    return Outcome(case.name, result, time.perf_counter() - began)


def run_apart(name: str, *, threads: int, cases: str = __name__) -> Outcome:
    """Run one case in a process of its own, so that one that crashes or hangs takes nothing along.

    Parameters
    ----------
    name : str
    cases : str
        The module whose ``CASES`` has it.
    """
    began = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="octobake-stability-") as folder:
        # The child lives as long as our end of this pipe; what it leaves behind when it is killed goes with the folder.
        held, ours = os.pipe()
        child = subprocess.Popen(
            [sys.executable, "-m", "bake_core.stability.child", cases, name, str(threads)],
            stdin=held,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "TMPDIR": folder},
        )
        try:
            out, said = child.communicate(timeout=_LIMIT)
        except subprocess.TimeoutExpired:
            return Outcome(name, Result("an end", f"none in {_LIMIT:g} s", 0.0, "hung: it was killed"), time.perf_counter() - began)
        finally:
            child.kill()
            child.communicate()
            os.close(held)
            os.close(ours)
    if child.returncode:
        ended = f"exit code {child.returncode}" if child.returncode > 0 else signal.Signals(-child.returncode).name
        last = said.decode(errors="replace").strip().splitlines()[-1:]
        return Outcome(name, Result("an end", ended, 0.0, "crashed" + "".join(f": {line}" for line in last)), time.perf_counter() - began)
    found = json.loads(out)
    return Outcome(name, Result(**found), time.perf_counter() - began)


def table(outcomes: list[Outcome]) -> list[tuple[str, str, str, str, str]]:
    """Case, expected, measured, tolerance and verdict as people read them."""
    return [
        (o.name, number(o.result.expected), number(o.result.measured), number(o.result.tolerance), "pass" if o.result.passed else "FAIL")
        for o in outcomes
    ]


def number(value: float | str) -> str:
    """Six digits are more than any tolerance here needs."""
    return value if isinstance(value, str) else f"{value:.6g}"


def write_report(outcomes: list[Outcome], folder: Path) -> Path:
    """Write ``report.html`` into a folder, which is made where it is not there.

    Raises
    ------
    MachineError
        ``machine.cannot_write``.
    """
    failed = sum(not o.result.passed for o in outcomes)
    rows = "".join(
        f"<tr{' class=bad' if not o.result.passed else ''}>"
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in (*cells, f"{o.seconds:.1f}", o.result.note))
        + "</tr>"
        for o, cells in zip(outcomes, table(outcomes), strict=True)
    )
    head = "".join(f"<th>{h}</th>" for h in ("case", "expected", "measured", "tolerance", "verdict", "seconds", "what the numbers are"))
    page = (
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        "<title>octobake stability</title>"
        "<style>body{font:16px system-ui;max-width:90rem;margin:2rem auto;padding:0 1rem}table{border-collapse:collapse;margin:1rem 0}"
        "td,th{padding:.2rem .8rem;border-bottom:1px solid #ccc;text-align:left;vertical-align:top}td:nth-child(-n+6){white-space:nowrap}"
        "td:last-child{color:#555}.bad{color:#b2182b}</style>"
        f"<h1>Stiff and extreme cases: {f'{failed} of {len(outcomes)} failed' if failed else f'all {len(outcomes)} pass'}</h1>"
        f"<p>{sum(o.seconds for o in outcomes):.0f} s on {os.cpu_count()} cores, kernels compiled where they were not cached. "
        "A case passes where measured is within the tolerance of expected; tolerances are four standard errors of the stated samples, "
        "or bounds of rounding.</p>"
        f"<table><tr>{head}</tr>{rows}</table></html>\n"
    )
    path = folder / "report.html"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as e:
        raise MachineError("machine.cannot_write", f"{e.strerror or e}; is there room on the disk?", str(path)) from e
    return path
