"""`octobake submit`: queue a bake on a service; with --wait or --fetch, one line for a CI script."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from service.cli.remote import add_json, add_server, connect, exit_code, follow


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("submit", help="queue a bake on a service")
    parser.add_argument(
        "scene", metavar="SCENE", type=Path, help=".glb, .gltf with its files beside it, a zip of its folder, .obj, .ply or .stl"
    )
    parser.add_argument("--spec", metavar="SPEC", type=Path, required=True)
    parser.add_argument("--label", metavar="KEY=VALUE", action="append", default=[], type=_label, help="may be given several times")
    parser.add_argument("--priority", metavar="N", type=int, default=0, help="higher goes first")
    parser.add_argument("--fresh", action="store_true", help="bake again what the service has baked before")
    parser.add_argument("--wait", action="store_true", help="follow it to its end")
    parser.add_argument(
        "--fetch", metavar="OUT", type=Path, help="wait, then download the bundle to a folder, or to a zip where it ends in .zip"
    )
    parser.add_argument("--fail-above-error", metavar="E", type=float, help="wait, and exit 4 where the error is above E (0.02 is 2 %%)")
    add_server(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Submit; prints the job's id, and once it has finished its figures."""
    from bake_core.environment import beside
    from bake_core.spec import EquirectEnvironment, load_spec
    from service.cli.fetch import check_out, fetch_bundle
    from service.cli.progress import describe_result

    spec = load_spec(args.spec)
    if args.fetch:
        check_out(args.fetch)
    with connect(args.server) as client:
        scene = client.add_scene(args.scene)
        if isinstance(spec.environment, EquirectEnvironment) and not spec.environment.image.startswith("sha256:"):
            image = client.put_blob(beside(args.spec.parent)(spec.environment.image))
            spec = spec.model_copy(update={"environment": spec.environment.model_copy(update={"image": image})})
        job = client.submit(scene.digest, spec.canonical(), labels=dict(args.label), priority=args.priority, fresh=args.fresh)
        if not (args.wait or args.fetch or args.fail_above_error is not None):
            print(json.dumps(job.document) if args.json else job.id)
            return 0
        job = follow(client, job)
        answer: dict[str, Any] = dict(job.document)
        if args.fetch:
            answer["fetched"] = str(fetch_bundle(client, job, args.fetch))
    print(json.dumps(answer) if args.json else f"{job.id} {describe_result(job.result or {})}")
    return exit_code(job, args.fail_above_error)


def _label(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is not KEY=VALUE")
    return key, value
