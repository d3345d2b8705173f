"""`octobake token`: who may use a service that listens to others."""

from __future__ import annotations

import argparse
import json
import os
import re
from datetime import UTC, datetime

from service.cli.remote import add_json

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    text = "Make, list and revoke tokens, in the service's own database; it need not run, and if it does it knows at once."
    parser = commands.add_parser("token", help="make, list and revoke the tokens of a service", description=text)
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    create = verbs.add_parser("create", help="make a token and print it, this once")
    create.add_argument("name", metavar="NAME", type=_name, help="whose it is; stands in the audit log")
    create.add_argument(
        "--scope", metavar="SCOPE", action="append", choices=("submit", "read", "admin"), required=True, help="may be given several times"
    )
    listing = verbs.add_parser("list", help="list tokens, without their secrets")
    revoke = verbs.add_parser("revoke", help="take a token away")
    revoke.add_argument("name", metavar="NAME")
    for verb in (create, listing, revoke):
        verb.add_argument("--data", metavar="DATA", help="the service's data folder, as `octobake serve` takes it")
        verb.add_argument("--database", metavar="DATABASE", help="the service's job store, as `octobake serve` takes it")
        add_json(verb)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Do it; a new token is all that `create` prints."""
    from bake_core.errors import MachineError
    from service.settings import load
    from service.tables import open_engine
    from service.tokens import Scope, Tokens

    settings = load({"data": args.data, "database": args.database}, os.environ)
    if not settings.database:
        try:
            settings.data_folder.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            text = f"the data folder cannot be used: {e.strerror}"
            raise MachineError("service.data_unusable", text, str(settings.data_folder)) from None
    engine = open_engine(settings.database_url)
    tokens = Tokens(engine)
    try:
        if args.verb == "create":
            secret = tokens.create(args.name, {Scope(s) for s in args.scope})
            print(json.dumps({"name": args.name, "scopes": sorted(set(args.scope)), "token": secret}) if args.json else secret)
        elif args.verb == "revoke":
            tokens.revoke(args.name)
            print(json.dumps({"revoked": args.name}) if args.json else f"revoked {args.name}")
        else:
            rows = [
                {"name": t.name, "scopes": sorted(t.scopes), "created": datetime.fromtimestamp(t.created, UTC).isoformat()}
                for t in tokens.list()
            ]
            for row in rows if not args.json else ():
                print(f"{row['name']:<24}  {','.join(row['scopes']):<18}  {row['created'][:19]}")
            if args.json:
                print(json.dumps({"tokens": rows}))
    finally:
        engine.dispose()
    return 0


def _name(text: str) -> str:
    if not NAME.fullmatch(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not 1 to 63 letters, digits, _ . and -, a letter or digit first")
    return text
