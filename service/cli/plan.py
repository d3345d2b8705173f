"""``octobake plan``: what will be baked and left out, and what it will cost."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from service.cli.bake import positive


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("plan", help="what will be baked and left out, with predicted seconds, memory and bytes")
    parser.add_argument("scene", metavar="SCENE", type=Path, help=".glb, .gltf, a zip of its folder, .obj, .ply or .stl")
    parser.add_argument("--spec", metavar="SPEC", type=Path, required=True)
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="threads that the bake will have; default: all cores")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the plan."""
    from dataclasses import asdict

    from bake_core.environment import beside
    from bake_core.plan import plan
    from bake_core.scene_files import load_scene
    from bake_core.spec import load_spec

    spec = load_spec(args.spec)
    made = plan(load_scene(args.scene), spec, threads=args.threads, find=beside(args.spec.parent))
    if args.json:
        print(json.dumps(asdict(made), indent=2))
        return 0
    for v in made.volumes:
        print(f"volume     {v.name}: {'×'.join(map(str, v.counts))} probes from {v.origin} every {v.spacing} m")
    print(f"kept       {', '.join(made.outputs)}")
    for what, why in made.left_out:
        print(f"left out   {what}: {why}")
    speed = f"{made.paths_per_second / 1e6:.2f} M paths/s on {args.threads} threads"
    print(f"seconds    {made.seconds:.1f} at most, at {speed} for {spec.stop.max_samples} samples")
    print(f"memory     {made.memory_bytes / 1e6:.0f} MB")
    print(f"atlases    {made.atlas_bytes / 1e6:.1f} MB before compression")
    return 0
