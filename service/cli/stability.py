"""``octobake stability``: stiff and extreme cases whose answers are known."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from service.cli.bake import positive

if TYPE_CHECKING:
    from bake_core.stability.run import Outcome


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("stability", help="bake stiff and extreme scenes whose answers are known, and compare")
    parser.add_argument("-o", "--out", metavar="DIR", type=Path, help="report.html goes here; none where left out")
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="default: all cores")
    parser.add_argument("--json", action="store_true", help="print the cases as one JSON document")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run all cases; 5 where one fails."""
    from bake_core.stability import run as stability

    outcomes: list[Outcome] = []
    for case in stability.CASES:
        outcome = stability.run_apart(case.name, threads=args.threads)
        outcomes.append(outcome)
        verdict = "pass" if outcome.result.passed else "FAIL"
        print(f"{len(outcomes)}/{len(stability.CASES)} {verdict} {outcome.name}, {outcome.seconds:.1f} s", file=sys.stderr, flush=True)
    report = stability.write_report(outcomes, args.out) if args.out else None
    failed = [o.name for o in outcomes if not o.result.passed]
    if args.json:
        print(json.dumps({"cases": [o.document() for o in outcomes]}, indent=2))
    else:
        rows = [("case", "expected", "measured", "tolerance", "verdict"), *stability.table(outcomes)]
        widths = [max(len(row[i]) for row in rows) for i in range(5)]
        print("\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows))
        seconds = sum(o.seconds for o in outcomes)
        print(
            f"{report or len(outcomes)}{'' if report else ' cases'}: {f'{len(failed)} failed' if failed else 'all passed'}, {seconds:.0f} s"
        )
    return 5 if failed else 0
