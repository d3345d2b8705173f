"""The embedded Dask on which jobs run: what it keeps of what is over."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest
from distributed.scheduler import TaskGroup

from service.compute import Compute
from service.settings import Settings

# Of computations that are over, and the groups of tasks in them; as many as Dask itself would keep are run twice over.
REMEMBERED, RUN = 10, 200


def test_what_tasks_leave_behind_is_bounded(tmp_path: Path) -> None:
    settings = Settings(data=str(tmp_path))
    settings.temporary_folder.mkdir()
    compute = Compute(settings, lambda _: None)
    try:
        for _ in range(RUN):
            assert compute.submit(os.getpid).result() != os.getpid()
        gc.collect()
        assert sum(isinstance(thing, TaskGroup) for thing in gc.get_objects()) < REMEMBERED
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
