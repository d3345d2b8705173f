"""A short run of `make fuzz`."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris has no wheel here")
def test_the_reader_refuses_whatever_it_is_given(tmp_path: Path) -> None:
    # A process of its own: what is fuzzed is instrumented, and libFuzzer ends with its process.
    command = [sys.executable, "-m", "tests.faults.fuzz", "--seconds", "60", "--findings", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-5000:]
    assert not list(tmp_path.iterdir())
