"""``octobake trace-check``: rays through a bundle's light field, one by one beside Embree's."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from pathlib import Path

from service.cli.bake import positive


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("trace-check", help="trace rays through a bundle, and hold each against Embree")
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="a folder or a zip")
    parser.add_argument("--scene", metavar="SCENE", type=Path, required=True, help="the scene that was baked")
    parser.add_argument("--sky", metavar="FILE", type=Path, help="the image that was baked with, where the environment is one")
    parser.add_argument("--rays", type=positive, default=20000, help="how many; default 20000")
    parser.add_argument("-o", "--out", metavar="DIR", type=Path, help="index.html, the picture and trace-check.json go here")
    parser.add_argument("--json", action="store_true", help="print the report as one JSON document")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check; 0 whatever comes out: how good it should be is for its reader to say."""
    import numpy as np

    from bake_core.bundle import read_bundle
    from bake_core.environment import exactly, no_images
    from bake_core.errors import MachineError
    from bake_core.scene_files import load_scene
    from bake_core.trace_report import table, trace_check, write_report

    bundle, scene = read_bundle(args.bundle), load_scene(args.scene)
    cancelled = np.zeros(1, np.uint8)
    previous = signal.signal(signal.SIGINT, lambda *_: cancelled.fill(1))
    try:
        report = trace_check(
            bundle,
            scene,
            rays=args.rays,
            find=exactly(args.sky) if args.sky else no_images,
            tell=lambda what: print(f"octobake: {what}", file=sys.stderr, flush=True),
            cancelled=cancelled,
        )
    finally:
        signal.signal(signal.SIGINT, previous)
    if args.out:
        try:
            written = write_report(report, args.out)
        except OSError as e:
            raise MachineError("machine.cannot_write", e.strerror or str(e), str(args.out)) from None
    if args.json:
        print(json.dumps(report, indent=2))
        return 0
    rows = table(report)
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    print("\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows))
    print(
        f"{report['rays']} rays from surfaces, {100 * report['misses']:.1f} % of which meet nothing; * is the bundle; on {report['device']}"
    )
    if args.out:
        print(written)
    return 0
