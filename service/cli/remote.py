"""What the commands that talk to a service share: where it is, its errors as ours, and a job followed on the terminal."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from bake_core.errors import BakeError, InputError, MachineError
from bake_core.progress import Progress
from service.cli.progress import ProgressLine, describe_job

if TYPE_CHECKING:
    # The client's HTTP library takes longer to load than `octobake --help` should.
    from octobake_client import Bake, Client, Job, Verification
    from octobake_client import Point as CurvePoint
    from octobake_client import Progress as Told

DEFAULT_SERVER = "http://127.0.0.1:8787"
AnyJob = TypeVar("AnyJob", "Bake", "Verification")


def add_server(parser: argparse.ArgumentParser) -> None:
    """Add the option that says where the service is."""
    default = os.environ.get("OCTOBAKE_SERVER", DEFAULT_SERVER)
    parser.add_argument("--server", metavar="URL", default=default, help="the service; default $OCTOBAKE_SERVER, else " + DEFAULT_SERVER)


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the option for one JSON document on stdout."""
    parser.add_argument("--json", action="store_true", help="print one JSON document on stdout")


def add_job_command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, words: str, act: Callable[[Client, Bake], Bake]
) -> None:
    """Add a command that does one thing to one bake, or nothing, and prints the bake as it then is."""
    parser = commands.add_parser(name, help=words)
    parser.add_argument("id", metavar="ID")
    add_server(parser)
    add_json(parser)

    def run(args: argparse.Namespace) -> int:
        with connect(args.server) as client:
            document = act(client, client.bake(args.id)).document
        print(json.dumps(document) if args.json else describe_job(document))
        return 0

    parser.set_defaults(run=run)


@contextmanager
def connect(server: str) -> Iterator[Client]:
    """A client whose errors come out as octobake's own, slug and place unchanged."""
    from octobake_client import Client, JobFailed, OctobakeClientError, ServiceError, Unreachable

    try:
        with Client(server, token=os.environ.get("OCTOBAKE_TOKEN")) as client:
            yield client
    except JobFailed as e:
        raise (InputError if e.exit_code == 2 else BakeError)(e.slug, e.message, e.where) from None
    except ServiceError as e:
        raise (InputError if e.status < 500 else MachineError)(e.slug, e.message, e.where) from None
    except Unreachable as e:
        raise MachineError(e.slug, e.message, e.where) from None
    except OctobakeClientError as e:
        raise InputError(e.slug, e.message, e.where) from None


def follow(client: Client, job: AnyJob) -> AnyJob:
    """Wait for a job with a progress line; raises unless it succeeds."""
    from bake_core.convergence import Point

    line = ProgressLine(label=job.id)

    def show(told: Told) -> None:
        line(Progress(told.stage, told.fraction, told.samples, told.error, told.seconds, told.eta))

    def measured(told: CurvePoint) -> None:
        line.point(Point(told.samples, told.rays, told.seconds, told.error))

    try:
        return client.wait(job, show, measured).check()
    finally:
        line.close()


def exit_code(job: Job, fail_above: float | None = None) -> int:
    """What to exit with for a job that has succeeded: its own code, or 4 where its error is above `fail_above`."""
    result = job.result or {}
    error = result.get("error")
    if fail_above is not None and (error is None or error > fail_above):
        return 4
    code: int = result.get("exit_code", 0)
    return code
