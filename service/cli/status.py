"""`octobake status`: one bake as it stands."""

from __future__ import annotations

import argparse

from service.cli.remote import add_job_command


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    add_job_command(commands, "status", "show a bake as it stands", lambda client, bake: bake)
