"""``octobake import-cubemaps``: a bundle from cube maps that another renderer captured."""

from __future__ import annotations

import argparse
import json
from pathlib import Path


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("import-cubemaps", help="make a bundle of cube maps of radiance and distance")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="cubemaps.json, and a folder of faces for each probe")
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, required=True, help="a folder, or a zip where it ends in .zip")
    parser.add_argument("--json", action="store_true", help="print the manifest")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Import; says how many probes came in."""
    from bake_core.import_cubemaps import import_cubemaps

    manifest = import_cubemaps(args.folder, args.out)
    if args.json:
        print(json.dumps(manifest, indent=2))
        return 0
    active, probes = (sum(v["probes"][k] for v in manifest["volumes"]) for k in ("active", "count"))
    print(f"{args.out}: {active} of {probes} probes")
    return 0
