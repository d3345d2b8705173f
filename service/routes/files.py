"""A lane of its own for requests that bring files or wait for them, so that a slow blob store holds up nobody who only asks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import anyio
import anyio.to_thread

R = TypeVar("R")
# As many as the framework has for all other work.
THREADS = 40
_lane = anyio.CapacityLimiter(THREADS)


async def run_with_files(call: Callable[..., R], *arguments: object) -> R:
    """As ``run_in_threadpool``, for calls that reach the blob store or read a scene."""
    return await anyio.to_thread.run_sync(partial(call, *arguments), limiter=_lane)
