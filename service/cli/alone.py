"""A service of a command's own: on a free port of loopback, gone when the command is."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bake_core.errors import MachineError

# Kernels compile at the first bake, not at the start, so this is long even for a slow disk.
START_SECONDS = 60.0


@contextmanager
def service_alone(out: Path) -> Iterator[str]:
    """A service that ends with this block; answers its URL.

    Parameters
    ----------
    out : Path
        A folder for its data, its URL and its log.

    Raises
    ------
    MachineError
        ``demo.no_service``.
    """
    ready = out / "service.url"
    ready.unlink(missing_ok=True)
    # Whatever the environment says of a service that others reach: this one is for this command alone.
    alone = ["--host", "127.0.0.1", "--port", "0", "--require-token", "0"]
    command = [sys.executable, "-m", "service.cli", "serve", *alone, "--data", str(out / "data"), "--ready-file", str(ready)]
    with open(out / "service.log", "w") as log, subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log) as process:
        try:
            deadline = time.monotonic() + START_SECONDS
            while not ready.exists():
                if process.poll() is not None or time.monotonic() > deadline:
                    raise MachineError("demo.no_service", "the service did not start; its log says why", str(out / "service.log"))
                time.sleep(0.05)
            yield ready.read_text().strip()
        finally:
            process.terminate()
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
