"""The driver alone, with a stand-in for Dask: what it does about workers that say little."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bake_core.errors import BakeError, Cancelled
from service import driver, worker
from service.driver import Driver
from service.jobs import Kind
from service.parts import Service


class Future:
    """A task that never ends."""

    key = "task"

    def add_done_callback(self, call: Callable[[Any], None]) -> None:
        pass


class Compute:
    """One slot; remembers which workers it was told to restart. Its scheduler has given tasks to `placed`."""

    slots = 1

    def __init__(self, placed: dict[str, str]) -> None:
        self.placed = placed
        self.restarted: list[str] = []

    def places(self, keys: list[str]) -> dict[str, str]:
        return self.placed

    def submit(self, *call: Any) -> Future:
        return Future()

    def cancel(self, futures: list[Any]) -> None:
        pass

    def restart(self, address: str) -> None:
        self.restarted.append(address)


@pytest.mark.parametrize(
    ("news", "placed", "restarted"),
    [(["began"], {}, ["a"]), (["began", "ended"], {"task": "a"}, []), ([], {}, []), ([], {"task": "a"}, ["a"])],
)
def test_a_task_that_begins_as_it_is_cancelled_is_stopped_too(
    news: list[str], placed: dict[str, str], restarted: list[str], service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "STOP_SECONDS", 0.05)
    compute: Any = Compute(placed)
    job = service.store.add_job(Kind.BAKE, {}, {}, 0)
    it = Driver(job, service.settings, service.store, service.blobs, compute, service.hub)
    it.cancel()
    for what in news:
        it.hear({"key": "task", "address": "a", what: True})
    with pytest.raises(driver._Cancel):
        it._one(len, "anything")
    assert compute.restarted == restarted


@pytest.mark.parametrize(("limit", "over"), [(1, True), (None, False), (2**60, False)])
def test_a_task_whose_process_comes_to_more_memory_than_it_may_is_stopped(limit: int | None, over: bool) -> None:
    """A kernel sees its flag and gives up with a cancel; what the job is told is the reason."""
    task: Any = SimpleNamespace(flag=np.zeros(1, np.uint8))
    work = worker.Work("job", "file:///", {}, {}, 1, 1, limit)
    watch = worker._Watch(task, work)

    def kernel() -> None:
        deadline = time.monotonic() + (20 * worker.WATCH_SECONDS if not over else 10.0)
        while time.monotonic() < deadline:
            if task.flag[0]:
                raise Cancelled("bake.cancelled", "was cancelled")
            time.sleep(0.001)

    if not over:
        with watch:
            kernel()
        return
    worker._cache["another job's scene"] = SimpleNamespace()  # type: ignore[assignment]
    with pytest.raises(BakeError) as caught, watch:
        kernel()
    assert caught.value.slug == "job.over_memory" and caught.value.where == "job job" and not worker._cache
