"""``python -m service.reader_process FD``: forks one limited child for each file that :mod:`service.sandbox` has read.

Started once, with the readers imported, so that a child costs a fork and not a start of Python. It never reads a stranger's byte itself.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import socket
import sys
import tempfile
import threading
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from bake_core.errors import OctobakeError
from service import reading


def main(control: socket.socket) -> None:
    """Fork a child for every connection that comes, until the service has gone."""
    # Ctrl-C and SIGTERM are the service's to act on. Ended children leave nothing to wait for.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD):
        signal.signal(number, signal.SIG_IGN)
    while True:
        message, handles, _, _ = socket.recv_fds(control, 1, 1)
        if not message:
            return
        if os.fork() == 0:
            control.close()
            _child(Connection(handles[0]))
        os.close(handles[0])


def _child(connection: Connection) -> None:
    code = 1
    try:
        name, arguments, folder, seconds, memory, file_size = connection.recv()
        _limit(seconds, memory, file_size)
        threading.Thread(target=_end_with_the_asker, args=(connection,), daemon=True).start()
        # What a killed reader leaves is its asker's to remove.
        tempfile.tempdir = folder
        connection.send_bytes(pickle.dumps(_answer(name, arguments), protocol=5))
        code = 0
    finally:
        os._exit(code)


def _answer(name: str, arguments: tuple[Any, ...]) -> tuple[str, Any]:
    try:
        return "done", getattr(reading, name)(*arguments)
    except MemoryError:
        return "memory", None
    except OctobakeError as e:
        return type(e).__name__, (e.slug, e.message, e.where)


def _limit(seconds: int, memory: int, file_size: int) -> None:
    """Bound this process: the kernel ends it, whatever native code it is in."""
    signal.alarm(seconds)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds * len(os.sched_getaffinity(0)), resource.RLIM_INFINITY))
    # The interpreter and its libraries have mapped address space already; the limit is on what comes on top.
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + memory, mapped + memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _end_with_the_asker(connection: Connection) -> None:
    """Go when nobody waits for the answer any more: a service that was killed leaves no reader behind."""
    connection.poll(None)
    os._exit(1)


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])))
