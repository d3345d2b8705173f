"""``octobake plan``: what will be baked and left out, and what it will cost."""

from __future__ import annotations

import argparse
import json
import os
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.bake import positive
from service.cli.progress import duration, in_bytes, percent

if TYPE_CHECKING:
    from bake_core.both_ways import BothWays
    from bake_core.plan import Plan
    from bake_core.spec import Spec


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("plan", help="what will be baked and left out, with predicted seconds, memory and bytes")
    parser.add_argument("scene", metavar="SCENE", type=Path, help=".glb, .gltf, a zip of its folder, .obj, .ply or .stl")
    parser.add_argument("--spec", metavar="SPEC", type=Path, required=True)
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="threads that the bake will have; default: all cores")
    parser.add_argument(
        "--measure",
        action="store_true",
        help="also bake twice, as planned and with everything demanded back, and print seconds, bytes, error",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the plan."""
    from dataclasses import asdict

    from bake_core.both_ways import measure
    from bake_core.environment import beside
    from bake_core.plan import plan
    from bake_core.scene_files import load_scene
    from bake_core.spec import load_spec

    spec, find = load_spec(args.spec), beside(args.spec.parent)
    scene = load_scene(args.scene)
    made = plan(scene, spec, threads=args.threads, find=find)
    measured = measure(scene, spec, threads=args.threads, find=find) if args.measure else None
    if args.json:
        both = None if measured is None else asdict(measured) | {"same": measured.same, "other": measured.other}
        print(json.dumps(asdict(made) | {"measured": both}, indent=2))
        return 0
    print("\n".join(_lines(made, spec, args.threads)))
    if measured is not None:
        print("\n".join(_measured(measured)))
    return 0


def _lines(made: Plan, spec: Spec, threads: int) -> list[str]:
    lines = []
    for v in made.volumes:
        origin, spacing = (", ".join(f"{x:.4g}" for x in values) for values in (v.origin, v.spacing))
        lines.append(f"volume     {v.name}: {'×'.join(map(str, v.counts))} probes from ({origin}) every ({spacing}) m")
    lines.append(f"kept       {', '.join(made.outputs)}: {in_bytes(made.atlas_bytes)} before compression")
    lines += left_out_lines([x.entry() for x in made.left_out])
    if made.unneeded_probes:
        size = in_bytes(made.unneeded_bytes)
        unneeded = f"{made.unneeded_probes} of {made.probes} probes"
        if spec.receivers == "surfaces":
            lines.append(f"left out   {unneeded}: needed by no surface, for none lies in the cells around them; saves {size}")
        else:
            lines.append(f'could be   {unneeded} are needed by no surface; "receivers": "surfaces" would leave them out and save {size}')
    lines.append(f"speed      {made.paths_per_second / 1e6:.2f} M paths/s on {threads} threads, from a few probes")
    target, most = spec.stop.target_error, spec.stop.max_samples
    between = f"{duration(made.least_seconds)} to {duration(made.greatest_seconds)}"
    if target is None or made.pilot_error is None:
        lines.append(f"time       {duration(made.seconds)} of tracing ({between}), for {made.samples} samples")
    elif made.samples < most:
        lines.append(f"time       {duration(made.seconds)} of tracing ({between}), if about {made.samples} samples reach an error")
        lines.append(f"           of {percent(target)}; at most {duration(made.most_seconds)}, for {most} samples")
    else:
        lines.append(
            f"time       {duration(made.seconds)} of tracing ({between}), for {most} samples; an error of {percent(target)} may need more"
        )
    lines.append(f"memory     {in_bytes(made.memory_bytes)}")
    return lines


def left_out_lines(entries: list[dict[str, Any]]) -> list[str]:
    """The manifest's `left_out` for people: one line for all that have one reason."""
    lines = []
    for why, alike in groupby(entries, key=lambda x: x["why"]):
        group = list(alike)
        sizes = [x["bytes"] for x in group if "bytes" in x]
        saves = f"; saves {in_bytes(sum(sizes))}" if sizes else ""
        lines.append(f"left out   {', '.join(x['what'] for x in group)}: {why}{saves}")
    return lines


def _measured(both: BothWays) -> list[str]:
    """A table of both ways, and what they agree in."""
    lines = ["", f"{'measured':<12}{'seconds':>9}{'samples':>9}{'bundle':>10}{'error':>9}"]
    for name, way in (("left out", both.without), ("demanded", both.everything)):
        error = "unknown" if way.error is None else percent(way.error)
        lines.append(f"{name:<12}{way.seconds:>9.2f}{way.samples:>9}{in_bytes(way.bytes):>10}{error:>9}")
    lines.append(f"same texels {', '.join(both.same) or 'none'}")
    if both.other:
        lines.append(f"others      {', '.join(both.other)}")
    return lines
