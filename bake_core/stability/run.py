"""Runs the cases, one after another, and writes what they found as a page."""

from __future__ import annotations

import html
import os
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.errors import Cancelled, MachineError, OctobakeError
from bake_core.stability import closed_rooms, crowds, geometry, maps, materials, placement, ranges
from bake_core.stability.case import Baker, Case, Result

CASES: tuple[Case, ...] = (
    *closed_rooms.CASES,
    *ranges.CASES,
    *placement.CASES,
    *maps.CASES,
    *materials.CASES,
    *geometry.CASES,
    *crowds.CASES,
)
# A case that takes longer hangs, by the promise that none does: they take seconds, and kernels are compiled in less than a minute.
_LIMIT = 180.0


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
            "measured": r.measured,
            "tolerance": r.tolerance,
            "verdict": "pass" if r.passed else "fail",
            "note": r.note,
            "seconds": self.seconds,
        }


def run_case(case: Case, *, threads: int, cancelled: NDArray[np.uint8]) -> Outcome:
    """Run one case in a folder that is gone afterwards.

    Parameters
    ----------
    cancelled : (1,) uint8
        Set it from any thread to stop within one texel.

    Raises
    ------
    Cancelled
    """
    late = threading.Event()

    def stop() -> None:
        late.set()
        cancelled.fill(1)

    timer = threading.Timer(_LIMIT, stop)
    timer.daemon = True
    timer.start()
    began = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory(prefix="octobake-stability-") as folder:
            result = case.run(Baker(Path(folder), threads, cancelled))
    except Cancelled:
        if not late.is_set():
            raise
        cancelled.fill(0)
        result = Result("an end", f"none in {_LIMIT:.0f} s", 0.0, "it hangs")
    except Exception as e:
        # A fault of ours is a case that fails, and no reason to leave out the others.
        result = Result("a bake", e.slug if isinstance(e, OctobakeError) else type(e).__name__, 0.0, str(e))
    finally:
        timer.cancel()
    return Outcome(case.name, result, time.perf_counter() - began)


def run_cases(
    cases: Sequence[Case], *, threads: int, cancelled: NDArray[np.uint8], done: Callable[[Outcome], None] = lambda outcome: None
) -> list[Outcome]:
    """Run cases in turn; `done` hears of each.

    Raises
    ------
    Cancelled
    """
    outcomes = []
    for case in cases:
        if cancelled[0]:
            raise Cancelled
        outcomes.append(run_case(case, threads=threads, cancelled=cancelled))
        done(outcomes[-1])
    return outcomes


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
