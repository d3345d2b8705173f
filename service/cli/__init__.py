"""The `octobake` command: one file per command, every error printed in one place."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Sequence

from bake_core.errors import OctobakeError

# In the order of --help. A command's module imports what it needs inside `run`, so that `octobake status` does not wait for numba.
COMMANDS = (
    "bake",
    "import-cubemaps",
    "plan",
    "info",
    "sample",
    "verify",
    "trace-check",
    "stability",
    "bench",
    "serve",
    "submit",
    "wait",
    "status",
    "list",
    "stop",
    "cancel",
    "fetch",
    "token",
    "warmup",
    "demo",
)
EXIT_CODES = "exit codes: 0 done; 2 bad input or usage; 3 failed; 4 out of budget before the target error; 5 a verification failed"


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    top = argparse.ArgumentParser(prog="octobake", description="Server-side global-illumination baking.", epilog=EXIT_CODES)
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in COMMANDS:
        importlib.import_module(f"service.cli.{name.replace('-', '_')}").add(commands)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    args = parser().parse_args(argv)
    try:
        code: int = args.run(args)
        sys.stdout.flush()
        return code
    except OctobakeError as e:
        place = f"{e.where}: " if e.where else ""
        print(f"octobake: error [{e.slug}] {place}{e.message}", file=sys.stderr)
        if getattr(args, "json", False):
            print(json.dumps({"error": {"slug": e.slug, "where": e.where, "message": e.message}}))
        return e.exit_code
    except KeyboardInterrupt:
        print("octobake: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output (head, less) went away: nothing more to say, and Python must not complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
