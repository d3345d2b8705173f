"""``octobake bake``: bakes here, with no server."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from types import FrameType

# Those of the spec; importing it takes longer than all else that a help text needs.
INTEGRATORS = ("auto", "path", "cache")


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("bake", help="bake a scene here, with no server")
    parser.add_argument("scene", metavar="SCENE", type=Path, help=".glb, .gltf, a zip of its folder, .obj, .ply or .stl")
    parser.add_argument("--spec", metavar="SPEC", type=Path, required=True, help="JSON file: volumes, lights, environment, when to stop")
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, required=True, help="a folder, or a zip where it ends in .zip")
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="default: all cores")
    parser.add_argument("--shards", type=positive, default=1, help="split each pass into this many parts; the bundle is the same")
    parser.add_argument("--integrator", choices=INTEGRATORS, help="in place of the spec's: path traces every path to its end")
    parser.add_argument("--audit-seconds", type=seconds, metavar="S", help="what the audit may take; default 3 %% of the bake, 0 for none")
    parser.add_argument("--json", action="store_true", help="print one JSON document: bundle, digest, error, seconds, curve, audit")
    parser.set_defaults(run=run)


def positive(text: str) -> int:
    """An argparse type: a whole number from 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def seconds(text: str) -> float:
    """An argparse type: a number from 0."""
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError("must be 0 or more")
    return value


def run(args: argparse.Namespace) -> int:
    """Bake; 4 where the target error was not reached, or somebody stopped it before."""
    import numpy as np

    from bake_core import bundle
    from bake_core.bake import bake
    from bake_core.environment import beside
    from bake_core.report import audit_in_words, percent, rate_json
    from bake_core.spec import load_spec
    from service.cli.progress import ProgressLine

    spec = load_spec(args.spec)
    if args.integrator is not None:
        spec = spec.model_copy(update={"integrator": args.integrator})
    cancelled = np.zeros(1, np.uint8)
    line = ProgressLine(sys.stderr)

    def stop(signum: int, frame: FrameType | None) -> None:
        stage = line.last.stage if line.last else ""
        if stage in ("tracing", "writing") and not cancelled[0]:
            # Kernels run without the GIL and only look at this flag: Ctrl-C ends tracing within a texel. What whole passes have
            # gathered is written then, unless a second one comes.
            cancelled.fill(1)
        elif stage == "compiling":
            # It may take a minute in a thread that nothing else stops, and there is no file yet to clear away.
            line.close()
            os.write(sys.stderr.fileno(), b"octobake: interrupted\n")
            os._exit(130)
        else:
            signal.default_int_handler(signum, frame)

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        result = bake(
            args.scene,
            spec,
            args.out,
            threads=args.threads,
            shards=args.shards,
            find=beside(args.spec.parent),
            audit_seconds=args.audit_seconds,
            progress=line,
            point=line.point,
            cancelled=cancelled,
        )
    finally:
        line.close()
        for number, handler in previous.items():
            signal.signal(number, handler)
    manifest, done = result.manifest, result.run
    error, probes = manifest["error"]["value"], sum(v["probes"]["count"] for v in manifest["volumes"])
    if args.json:
        document = {
            "bundle": str(args.out),
            "content_digest": bundle.content_digest(bundle.dump_json(manifest)),
            "probes": probes,
            "samples": manifest["samples"],
            "error": error,
            "target_error": spec.stop.target_error,
            "stopped": manifest["stopped"],
            "seconds": done.seconds,
            "curve": [asdict(p) for p in done.curve],
            "rate": rate_json(done),
            "audit": None if done.audit is None else asdict(done.audit),
        }
        print(json.dumps(document, indent=2))
    else:
        print(f"{args.out}: {probes} probes, {manifest['samples']} samples, error {percent(error)}, {done.seconds:.1f} s")
        if done.audit is not None:
            print(f"audit, {done.audit.seconds:.1f} s: {audit_in_words(done.audit)}")
    if done.stopped == "interrupt":
        print(f"octobake: interrupted; the bundle holds what {manifest['samples']} samples gave", file=sys.stderr)
    elif not result.met:
        print(
            f"octobake: stopped by {manifest['stopped']} at error {percent(error)}, above the target of {percent(spec.stop.target_error)}; "
            "raise stop.max_samples or stop.max_seconds",
            file=sys.stderr,
        )
    return 0 if result.met else 4
