"""The embedded Dask on which jobs run: what it keeps of what is over."""

from __future__ import annotations

import gc
import os
import time
from pathlib import Path

import pytest
from distributed.client import FutureState
from distributed.scheduler import TaskGroup, Transition

from bake_core.spec import parse_spec
from service.compute import Compute
from service.driver import Driver
from service.jobs import Kind
from service.parts import Service
from service.settings import Settings

# Enough that Dask by itself would remember a hundred groups of tasks and a thousand changes of their states.
TASKS = 200


def test_what_tasks_leave_behind_is_bounded(tmp_path: Path) -> None:
    settings = Settings(data=str(tmp_path))
    settings.temporary_folder.mkdir()
    compute = Compute(settings, lambda _: None)
    try:
        for _ in range(TASKS):
            assert compute.submit(os.getpid).result() != os.getpid()
        gc.collect()
        kept = [type(thing) for thing in gc.get_objects()]
        assert kept.count(TaskGroup) < 10
        assert 0 < kept.count(Transition) <= 50
    finally:
        compute.close()


def test_what_a_task_raises_is_told_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """With its future; the worker, whose output is the service's own, does not print it, too."""
    settings = Settings(data=str(tmp_path))
    settings.temporary_folder.mkdir()
    compute = Compute(settings, lambda _: None)
    try:
        with pytest.raises(ZeroDivisionError):
            compute.submit(divmod, 1, 0).result()
    finally:
        compute.close()
    assert "ZeroDivisionError" not in "".join(capfd.readouterr())


def test_a_task_that_failed_is_forgotten_when_its_job_is_over(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its error refers to the driver's frames, and these to the future that keeps the error."""
    service.settings.temporary_folder.mkdir(exist_ok=True)
    compute = Compute(service.settings, lambda _: None)
    monkeypatch.setattr(Driver, "_bake", lambda driver: [driver._one(function, {}) for function in (dict, parse_spec)])
    try:
        for _ in range(3):
            service.store.add_job(Kind.BAKE, {}, {}, 0)
            job = service.store.claim()
            assert job is not None
            Driver(job, service.settings, service.store, service.blobs, compute, service.hub).run()
            ended = service.store.job(job.id)
            assert ended is not None and ended.error is not None and ended.error["slug"].startswith("spec.")
        # The client is told in its own thread.
        end = time.monotonic() + 5
        while kept := sum(isinstance(thing, FutureState) for thing in gc.get_objects()):
            assert time.monotonic() < end, kept
            gc.collect()
    finally:
        compute.close()
