"""Files from strangers, read in a child process with limits on its time, memory and files.

A file that makes a parser crash, hang or swell ends its child; whoever sent it gets a 422 with a slug, and the service goes on.
"""

from __future__ import annotations

import io
import pickle
import socket
import subprocess
import sys
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

from bake_core import errors
from bake_core.errors import MachineError, SceneError
from bake_core.zip_files import MAX_BYTES

# What a child answers is an outline: names and matrices, a few hundred bytes a node.
MAX_ANSWER = 1 << 30
# Each may take the whole memory limit.
AT_ONCE = 2
# A child that the kernel has ended is seen at once; one that it should have ended, this many seconds later.
GRACE = 5.0
# All that an answer may be made of. Unpickling calls nothing else, so a child that was taken over cannot call anything here.
ANSWER_TYPES = {
    *(("bake_core.scene", name) for name in ("Scene", "Materials", "Lights", "Camera", "SceneNode", "Texture")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.numeric", "_frombuffer"),
}


class Sandbox:
    """Calls the functions of :mod:`service.reading` in children that end when they take too much.

    Parameters
    ----------
    folder : Path
        For what children write: each has a folder of its own in it, removed with the child.
    seconds : int
        Wall-clock seconds for one call.
    memory : int
        Bytes of address space for one call.
    """

    def __init__(self, folder: Path, seconds: int, memory: int) -> None:
        self._folder, self._seconds, self._memory = folder, seconds, memory
        self._turn = threading.BoundedSemaphore(AT_ONCE)
        self._lock = threading.Lock()
        # Started by the first call: a service that only answers and bakes has no use for it.
        self._forker: tuple[subprocess.Popen[bytes], socket.socket] | None = None
        self._closed = False

    def call(self, function: str, *arguments: Any, where: str = "") -> Any:
        """What ``service.reading.FUNCTION(*arguments)`` answers, or the error that it raises.

        Raises
        ------
        SceneError
            ``scene.reader_timeout``, ``scene.reader_memory`` or ``scene.reader_crashed``, with place `where`.
        """
        with self._turn, tempfile.TemporaryDirectory(prefix="reader-", dir=self._folder) as folder:
            began = time.monotonic()
            with self._child() as connection:
                try:
                    # A zip's limits hold for what it unpacks to; nothing else that a reader writes is larger.
                    connection.send((function, arguments, folder, self._seconds, self._memory, MAX_BYTES))
                    data = connection.recv_bytes(MAX_ANSWER) if connection.poll(self._seconds + GRACE) else None
                except (EOFError, OSError):
                    data = None
            if data is None:
                self._died(time.monotonic() - began, where)
            kind, answer = _Answer(io.BytesIO(data)).load()
            if kind == "done":
                return answer
            if kind == "memory":
                raise SceneError(
                    "scene.reader_memory", f"takes more than {self._memory} bytes to read; split it, or make it smaller", where
                )
            raise getattr(errors, kind)(*answer)

    def close(self) -> None:
        """End the process that forks, and with it what it forked."""
        with self._lock:
            self._closed = True
            self._end()

    def _died(self, seconds: float, where: str) -> NoReturn:
        if seconds >= self._seconds:
            raise SceneError("scene.reader_timeout", f"cannot be read in {self._seconds} s; split it, or make it smaller", where)
        raise SceneError("scene.reader_crashed", "makes its reader crash; write the file again with another exporter", where)

    def _child(self) -> Connection:
        ours, theirs = socket.socketpair()
        with theirs, self._lock:
            if not self._closed and (self._hand(theirs) or self._hand(theirs)):
                return Connection(ours.detach())
        ours.close()
        raise MachineError("service.reader_unavailable", "no reader can be started; the service is stopping, or short of processes")

    def _hand(self, theirs: socket.socket) -> bool:
        """Hand a child's end of a connection to the process that forks; False where that has gone, and the next one is to be tried."""
        try:
            if self._forker is None:
                self._forker = self._start()
            socket.send_fds(self._forker[1], [b"."], [theirs.fileno()])
        except OSError:
            self._end()
            return False
        return True

    def _end(self) -> None:
        if self._forker is not None:
            process, control = self._forker
            self._forker = None
            control.close()
            process.kill()
            process.wait()

    def _start(self) -> tuple[subprocess.Popen[bytes], socket.socket]:
        ours, theirs = socket.socketpair()
        with theirs:
            command = [sys.executable, "-m", "service.reader_process", str(theirs.fileno())]
            process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
        return process, ours


class _Answer(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ANSWER_TYPES:
            raise SceneError(
                "scene.reader_crashed", "makes its reader answer what is no outline; write the file again with another exporter"
            )
        return super().find_class(module, name)
