"""Schemathesis, which reads the OpenAPI document and sends what it allows and what it does not, finds nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.running import Server


@pytest.mark.slow
def test_schemathesis_finds_nothing(tmp_path: Path) -> None:
    # Not the retention: what others made would go.
    server = Server(tmp_path / "data", "--max-requests-per-second", "100000")
    try:
        command = [str(Path(sys.executable).with_name("schemathesis")), "run", f"{server.url}/v1/openapi.json"]
        options = ["--checks", "all", "--max-examples", "30", "--seed", "1", "--phases", "examples,coverage,fuzzing", "--no-color"]
        # An endless answer is what an event stream is; its own tests follow them.
        out = ["--exclude-operation-id", "followBake", "--exclude-operation-id", "followVerification"]
        done = subprocess.run([*command, *options, *out], cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False)
        assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    finally:
        server.close()
