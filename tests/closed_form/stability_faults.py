"""Cases that end as none should: run in processes of their own by test_stability.py."""

from __future__ import annotations

import os
import signal
import time

from bake_core.stability.case import Baker, Case, Result


def crashes(baker: Baker) -> Result:
    os.kill(os.getpid(), signal.SIGSEGV)
    raise AssertionError("unreachable")


def hangs(baker: Baker) -> Result:
    (baker.folder / "left").write_text("behind")
    time.sleep(600)
    raise AssertionError("unreachable")


CASES = (
    Case("fine", lambda baker: Result(1.0, 1.25, 0.5, "a < b")),
    Case("not a number", lambda baker: Result(1.0, float("nan"), 0.5, "")),
    Case("broken", lambda baker: Result(1.0, 1 // 0, 0.0, "")),
    Case("crashes", crashes),
    Case("hangs", hangs),
)
