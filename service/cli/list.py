"""`octobake list`: the bakes of a service."""

from __future__ import annotations

import argparse
import json
from itertools import islice

from service.cli.remote import add_json, add_server, connect


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("list", help="list the bakes of a service, the newest first")
    parser.add_argument("--state", metavar="STATE", help="only those in this state")
    parser.add_argument("--label", metavar="KEY=VALUE", action="append", default=[], help="only those with this label")
    parser.add_argument("-n", metavar="N", dest="count", type=int, default=20, help="at most so many (default 20)")
    add_server(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print a line for each job."""
    from service.cli.progress import describe_job

    labels = dict((label.split("=", 1) + [""])[:2] for label in args.label)
    with connect(args.server) as client:
        jobs = list(islice(client.bakes(state=args.state, labels=labels), args.count))
    if args.json:
        print(json.dumps({"bakes": [job.document for job in jobs]}))
    else:
        for job in jobs:
            print(describe_job(job.document))
    return 0
