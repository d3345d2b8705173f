"""The driver alone, with a stand-in for Dask: what it does about workers that say little."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sqlalchemy.exc import OperationalError

from bake_core.errors import BakeError, Cancelled, MachineError
from service import driver, worker
from service.blobs import StoreError, store_errors
from service.driver import Driver
from service.jobs import Kind, State
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


class Refusing:
    """One slot whose tasks fail so often for the blob store, and then succeed."""

    slots = 1

    def __init__(self, times: int) -> None:
        self.left = times
        self.held = 0

    def release(self, future: Any) -> None:
        self.held -= 1

    def submit(self, *call: Any) -> Any:
        error = StoreError("blob.store_failed", "is full") if self.left else None
        self.left -= 1
        self.held += 1

        def result() -> str:
            if error:
                raise error
            return "done"

        return SimpleNamespace(key="task", result=result, add_done_callback=lambda told: told(SimpleNamespace(key="task")))


def test_a_piece_waits_for_the_blob_store_and_gives_up_in_the_end(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "STORE_PAUSES", (0.01, 0.02, 0.03))
    job = service.store.add_job(Kind.BAKE, {}, {}, 0)
    for times in (3, 4):
        compute: Any = Refusing(times)
        it = Driver(job, service.settings, service.store, service.blobs, compute, service.hub)
        began = time.monotonic()
        if times == 3:
            assert it._one(len, "anything") == "done"
        else:
            with pytest.raises(StoreError, match="is full"):
                it._one(len, "anything")
        assert time.monotonic() - began >= 0.06
        # Only the last, which goes when another is submitted, or with the job.
        assert compute.held == 1


def test_what_the_store_raises_is_told_as_one_error() -> None:
    for raised, slug in (
        (OSError(28, "No space left on device"), "blob.store_failed"),
        (MachineError("machine.cannot_write", "full"), "machine.cannot_write"),
    ):
        with pytest.raises(StoreError) as caught, store_errors("job x"):
            raise raised
        assert caught.value.slug == slug
    with pytest.raises(Cancelled), store_errors("job x"):
        raise Cancelled


def test_a_job_whose_driver_lost_the_database_goes_on_by_itself(service: Service) -> None:
    job = service.store.add_job(Kind.BAKE, {}, {}, 0).id
    assert service.store.claim()
    scheduler = service.scheduler
    scheduler._compute = SimpleNamespace(slots=0)  # type: ignore[assignment]

    def lost() -> None:
        raise OperationalError("UPDATE", {}, Exception("database or disk is full"))

    it: Any = SimpleNamespace(job=SimpleNamespace(id=job), run=lost)
    scheduler._drivers[job] = it
    scheduler._drive(it)
    assert not scheduler.drives(job)
    scheduler._fill()
    found = service.store.job(job)
    assert found and found.state == State.QUEUED
    scheduler._compute = None


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
