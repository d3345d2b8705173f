"""`octobake wait`: follow a bake to its end."""

from __future__ import annotations

import argparse
import json

from service.cli.remote import add_json, add_server, connect, exit_code, follow


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("wait", help="follow a bake to its end")
    parser.add_argument("id", metavar="ID")
    parser.add_argument("--fail-above-error", metavar="E", type=float, help="exit 4 where the error is above E (0.02 is 2 %%)")
    add_server(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Wait; prints the bake's figures."""
    from service.cli.progress import describe_result

    with connect(args.server) as client:
        job = follow(client, client.bake(args.id))
    print(json.dumps(job.document) if args.json else f"{job.id} {describe_result(job.result or {})}")
    return exit_code(job, args.fail_above_error)
