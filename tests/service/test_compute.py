"""The embedded Dask on which jobs run: what it keeps of what is over."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest
from distributed.scheduler import TaskGroup, Transition

from service.compute import Compute
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
