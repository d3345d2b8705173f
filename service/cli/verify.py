"""``octobake verify``: a picture with the bundle beside a path-traced one."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from service.cli.bake import positive


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("verify", help="render with a bundle and path-traced, and compare")
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="a folder or a zip")
    parser.add_argument("--scene", metavar="SCENE", type=Path, required=True, help="the scene that was baked")
    parser.add_argument(
        "--camera",
        metavar="FILE",
        type=Path,
        help='[{"name", "position", "target", "up"?, "yfov"?}]; default: the scene\'s, else automatic',
    )
    parser.add_argument("--sky", metavar="FILE", type=Path, help="the image that was baked with, where the environment is one")
    parser.add_argument("--thresholds", metavar="FILE", type=Path, help="limits other than the Cornell box's")
    parser.add_argument("-o", "--out", metavar="DIR", type=Path, required=True, help="pictures, verification.json and index.html go here")
    parser.add_argument("--width", type=positive, default=640, help="pixels; default 640")
    parser.add_argument("--height", type=positive, default=360, help="pixels; default 360")
    parser.add_argument(
        "--samples", type=positive, default=128, help="paths a pixel of the reference, 16 times as many from surface points; default 128"
    )
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="default: all cores")
    parser.add_argument("--json", action="store_true", help="print the report as one JSON document")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Verify; 5 where a threshold is not kept."""
    import numpy as np

    from bake_core.bundle import read_bundle
    from bake_core.cameras import load_cameras
    from bake_core.environment import exactly, no_images
    from bake_core.scene_files import load_scene
    from bake_core.thresholds import load_thresholds
    from bake_core.verification import verify
    from bake_core.verification_report import glossy_facts, receiver_facts
    from service.cli.progress import ProgressLine

    cameras = load_cameras(args.camera) if args.camera else None
    thresholds = load_thresholds(args.thresholds) if args.thresholds else None
    bundle, scene = read_bundle(args.bundle), load_scene(args.scene)
    cancelled = np.zeros(1, np.uint8)
    previous = signal.signal(signal.SIGINT, lambda *_: cancelled.fill(1))
    line = ProgressLine(sys.stderr)
    try:
        report = verify(
            bundle,
            scene,
            cameras,
            args.out,
            width=args.width,
            height=args.height,
            samples=args.samples,
            threads=args.threads,
            thresholds=thresholds,
            find=exactly(args.sky) if args.sky else no_images,
            progress=line,
            cancelled=cancelled,
        )
    finally:
        line.close()
        signal.signal(signal.SIGINT, previous)
    if args.json:
        print(json.dumps(report, indent=2))
    else:
        print(table(report))
        print(receiver_facts(report["receivers"]))
        if report["glossy"] is not None:
            print(glossy_facts(report["glossy"]))
        print(f"{args.out / 'index.html'}: {'passed' if report['passed'] else 'failed'}, {report['seconds']:.1f} s")
    for failure in report["failures"]:
        print(f"octobake: {failure}", file=sys.stderr)
    if report["failures"] and thresholds is None:
        print("octobake: these limits are the Cornell box's; a scene states its own with --thresholds FILE", file=sys.stderr)
    return 0 if report["passed"] else 5


def table(report: dict[str, Any]) -> str:
    """A line for each camera and part, and three for the receivers, two of which weigh probes as others do: ratio, relMSE, FLIP or p95."""
    from bake_core.verification_report import BESIDE, PARTS, number

    rows = [("camera", "part", "mean ratio", "relMSE", "HDR-FLIP", "95th percentile")]
    for camera in report["cameras"]:
        for part in PARTS:
            f = camera[part]
            rows.append((camera["name"], part, number(f["mean_ratio"]), number(f["relmse"]), number(f["flip"]), ""))
    receivers = report["receivers"]
    for part, f in [("irradiance", receivers), *((words, receivers["beside"][way]) for way, words in BESIDE.items())]:
        rows.append(("receivers", part, number(f["mean_ratio"]), number(f["relmse"]), "", number(f["p95"])))
    if report["glossy"] is not None:
        g = report["glossy"]
        rows.append(("rays", "radiance", number(g["mean_ratio"]), number(g["relmse"]), "", number(g["p95"])))
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)
