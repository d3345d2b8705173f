"""`octobake cancel`: stop a bake."""

from __future__ import annotations

import argparse

from service.cli.remote import add_job_command


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    add_job_command(commands, "cancel", "stop a bake", lambda client, bake: client.cancel(bake))
