"""``python -m service.worker_process SCHEDULER FOLDER``: the embedded worker, started and watched by :mod:`service.compute`.

It imports everything, and works once a line comes by its standard input.

A worker of somebody's own cluster is Dask's own: ``dask worker --nthreads 1 --preload service.worker SCHEDULER``.
"""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import sys
import threading

# A bake takes every core; without this a request, and the commit of a shard, would wait for its turn on one as long as any of its threads.
NICENESS = 5


def main(scheduler: str, folder: str) -> None:
    """Work for the scheduler at this address until the service goes away, be it while modules are still read."""
    # Ctrl-C in the service's terminal, and a service manager's SIGTERM to the whole group, are the service's to act on: a worker that
    # went by itself would be taken for lost.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    called = threading.Event()
    threading.Thread(target=_hear_the_service, args=(called,), daemon=True).start()
    os.nice(NICENESS)

    # Looking for garbage among what is imported is a tenth of a start.
    gc.disable()
    from service import worker as tasks
    from service.dask_configuration import configure

    # Imported here although the scheduler would name it: the first task does not wait for it.
    assert tasks
    configure()
    gc.freeze()
    gc.enable()
    called.wait()
    asyncio.run(_work(scheduler, folder))
    # OpenImageIO's binding takes what stays frozen at the end for leaked, and says so at length.
    gc.unfreeze()


def _hear_the_service(called: threading.Event) -> None:
    """Go when the service has gone, however it went: its end of our standard input closes with it, even on kill -9."""
    if sys.stdin.buffer.readline():
        called.set()
    sys.stdin.buffer.read()
    os._exit(0)


async def _work(scheduler: str, folder: str) -> None:
    from distributed import Worker
    from distributed.worker import DEFAULT_EXTENSIONS

    from service.dask_configuration import kept

    async with Worker(
        scheduler,
        nthreads=1,
        host="127.0.0.1",
        dashboard=False,
        memory_limit=0,
        local_directory=folder,
        extensions=kept(DEFAULT_EXTENSIONS),
    ) as worker:
        await worker.finished()


if __name__ == "__main__":
    main(*sys.argv[1:])
