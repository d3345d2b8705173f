"""`octobake stop`: end a bake with what it has."""

from __future__ import annotations

import argparse

from service.cli.remote import add_job_command


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    add_job_command(commands, "stop", "end a bake with the passes it has; `cancel` keeps nothing", lambda client, bake: client.stop(bake))
