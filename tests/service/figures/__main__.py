"""``python -m tests.service.figures [PART ...]`` prints a line for each goal of docs/operations.md; exit 1 where one is missed.

Times are of the machine it runs on, and of whatever else that machine does meanwhile.
"""

from __future__ import annotations

import argparse
import gc
import sys
import tempfile
from pathlib import Path

from tests.service.figures import interrupts, load, mixed, overhead, transfers
from tests.service.figures.table import Table

PARTS = ("load", "interrupts", "transfers", "overhead", "mixed")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}, or all; default load")
    parser.add_argument("--seconds", type=float, default=30.0, help="load: of requests, and of listening")
    parser.add_argument("--cancels", type=int, default=100, help="interrupts")
    parser.add_argument("--kills", type=int, default=20, help="interrupts: of the worker")
    parser.add_argument("--megabytes", type=int, default=500, help="transfers: of the upload and of the download")
    parser.add_argument("--bake-seconds", type=float, default=60.0, help="overhead: of the job, about")
    parser.add_argument("--rounds", type=int, default=3, help="overhead: of the job, each way")
    parser.add_argument("--minutes", type=float, default=30.0, help="mixed: a fifth of them is warm-up")
    args = parser.parse_args()
    parts = PARTS if "all" in args.parts else args.parts or ["load"]
    if stray := set(parts) - set(PARTS):
        parser.error(f"no such part: {', '.join(sorted(stray))}")
    # This process's own pauses are not the service's.
    gc.collect()
    gc.freeze()
    say = Table()
    for part in parts:
        with tempfile.TemporaryDirectory(prefix="octobake-figures-") as name:
            folder = Path(name)
            if part == "load":
                load.measure(folder, args.seconds, say)
            elif part == "interrupts":
                interrupts.measure(folder, args.cancels, args.kills, say)
            elif part == "transfers":
                transfers.measure(folder, args.megabytes, say)
            elif part == "overhead":
                overhead.measure(args.bake_seconds, args.rounds, say)
            else:
                mixed.measure(folder, args.minutes, say)
    # OpenImageIO's binding takes what stays frozen at the end for leaked, and says so at length.
    gc.unfreeze()
    return 1 if say.missed else 0


if __name__ == "__main__":
    sys.exit(main())
