"""``python -m bake_core.stability.child MODULE NAME THREADS``: one case, and what it found on stdout.

Started by :mod:`bake_core.stability.run`.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
from dataclasses import asdict

from bake_core.stability.run import run_case


def main(module: str, name: str, threads: str) -> None:
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    (case,) = [c for c in importlib.import_module(module).CASES if c.name == name]
    print(json.dumps(asdict(run_case(case, threads=int(threads)).result)))


def _end_with_the_parent() -> None:
    """Go when whoever started us has gone, however it went: its end of our standard input closes with it."""
    os.read(0, 1)
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
