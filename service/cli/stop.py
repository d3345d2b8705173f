"""`octobake stop`: end a bake with what it has."""

from __future__ import annotations

import argparse
import json

from service.cli.remote import add_json, add_server, connect


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("stop", help="end a bake with the passes it has; `cancel` keeps nothing")
    parser.add_argument("id", metavar="ID")
    add_server(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Stop it; prints the job, whose bundle follows within seconds."""
    from service.cli.progress import describe_job

    with connect(args.server) as client:
        job = client.stop(client.bake(args.id))
    print(json.dumps(job.document) if args.json else describe_job(job.document))
    return 0
