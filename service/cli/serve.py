"""`octobake serve`: the service."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import signal
import socket
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from types import FrameType

from service.settings import load, settings_list

# Downloads that are under way at a shutdown get this long; clients resume them by Range.
GRACE_SECONDS = 1


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command; its options are the settings."""
    parser = commands.add_parser(
        "serve", help="run the service", description="Run the service. Every option has a default that needs nothing else."
    )
    for f in settings_list():
        default = f"default {f.default}" if f.default != "" else f"or ${'OCTOBAKE_' + f.name.upper()}"
        parser.add_argument("--" + f.name.replace("_", "-"), metavar=f.name.upper(), help=f"{f.metadata['help']} ({default})")
    parser.add_argument("--ready-file", metavar="FILE", type=Path, help="write the service's URL here once it listens; removed at its end")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serve until SIGTERM or SIGINT."""
    # Looking for garbage among what is imported is a tenth of a start. From when it listens on there may be some.
    gc.disable()
    # Now, not above: `octobake --help` waits for none of it.
    import uvicorn

    from bake_core.errors import MachineError
    from service.app import create_app
    from service.parts import Service

    class Server(uvicorn.Server):
        """Says where it listens once it does, and keeps to itself the signal that ends it."""

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            if self.started:
                # Of all that is imported by now nothing will ever be garbage, and a look at it all (0.2 s) holds up every request.
                gc.collect()
                gc.freeze()
                gc.enable()
                print(f"listening on {url}", flush=True)
                if args.ready_file:
                    _write_whole(args.ready_file, url + "\n")

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            super().handle_exit(sig, frame)
            # uvicorn raises what it caught again at its end, so that a shell sees how it died; ending on request is no death.
            self._captured_signals.clear()

    settings = load(vars(args), os.environ)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # By its protocol asyncio knows that it may send an answer's body at once; else it waits for the headers' delayed ACK, 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    with listener:
        try:
            listener.bind((settings.host, settings.port))
        except OSError as e:
            where = f"{settings.host}:{settings.port}"
            raise MachineError("service.cannot_listen", f"{e.strerror}; choose another with --host and --port", where) from None
        host = f"[{settings.host}]" if family == socket.AF_INET6 else settings.host
        url = f"http://{host}:{listener.getsockname()[1]}"
        service = Service(settings)
        # For whatever of this process writes temporary files: a zip that is unpacked, Dask's scheduler.
        os.environ["TMPDIR"] = tempfile.tempdir = str(settings.temporary_folder)
        app = create_app(service)
        config = uvicorn.Config(app, log_config=None, access_log=False, timeout_graceful_shutdown=GRACE_SECONDS, server_header=False)
        # A signal during start-up must end the process, too, and uvicorn listens for it only later.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            Server(config).run(sockets=[listener])
        finally:
            if args.ready_file:
                args.ready_file.unlink(missing_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    # Everything is stored and closed. Dask's exit hooks would wait ten seconds for a worker that is busy compiling, and taking numba
    # apart takes another: go now, and what is left of the worker goes with us.
    os._exit(0)


def _write_whole(path: Path, text: str) -> None:
    """Whoever waits for the file finds it complete."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text)
        part.replace(path)
    finally:
        with suppress(FileNotFoundError):
            part.unlink()
