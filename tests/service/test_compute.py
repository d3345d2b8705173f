"""The embedded Dask on which jobs run: what it keeps of what is over."""

from __future__ import annotations

import gc
import os
from pathlib import Path

from distributed.scheduler import TaskGroup

from service.compute import Compute
from service.settings import Settings

# Dask remembers this many computations, and the groups of tasks in them.
REMEMBERED = 100


def test_what_tasks_leave_behind_is_bounded(tmp_path: Path) -> None:
    settings = Settings(data=str(tmp_path))
    settings.temporary_folder.mkdir()
    compute = Compute(settings, lambda _: None)
    try:
        for _ in range(2 * REMEMBERED):
            assert compute.submit(os.getpid).result() != os.getpid()
        gc.collect()
        assert sum(isinstance(thing, TaskGroup) for thing in gc.get_objects()) < 1.2 * REMEMBERED
    finally:
        compute.close()
