"""`octobake fetch`: download a bake's bundle."""

from __future__ import annotations

import argparse
import json
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from service.cli.remote import add_json, add_server, connect

if TYPE_CHECKING:
    from octobake_client import Bake, Client


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("fetch", help="download a bake's bundle")
    parser.add_argument("id", metavar="ID")
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, required=True, help="a folder, or a zip where it ends in .zip")
    add_server(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Download; prints the path."""
    check_out(args.out)
    with connect(args.server) as client:
        out = fetch_bundle(client, client.bake(args.id), args.out)
    print(json.dumps({"id": args.id, "fetched": str(out)}) if args.json else out)
    return 0


def check_out(out: Path) -> None:
    """Refuse a destination where something stands that is no bundle, before anything else is done."""
    from bake_core.bundle import check_replaceable

    check_replaceable(out.absolute())


def fetch_bundle(client: Client, bake: Bake, out: Path) -> Path:
    """Download a bundle to a zip, or unpacked to a folder; an interrupted download is taken up again."""
    from bake_core.bundle import is_zip, publish

    out = out.absolute()
    if is_zip(out):
        return client.fetch(bake, out)
    packed = client.fetch(bake, out.with_name(f".{out.name}.zip"))
    try:
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as folder:
            unpacked = Path(folder) / "bundle"
            with zipfile.ZipFile(packed) as archive:
                archive.extractall(unpacked)
            publish(unpacked, out)
    finally:
        packed.unlink()
    return out
