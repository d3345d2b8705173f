"""Schemathesis, which reads the OpenAPI document and sends what it allows and what it does not, finds nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.running import Server

# A schema cannot say that a scene, a bake or a blob has to be there, that bytes have the digest in their path, or what a volume needs to be
# one. What is refused for such a reason is 422 with its slug, and no fault.
NOT_ALL_THAT_IS_VALID = "".join(
    f"""
[[operations]]
include-operation-id = "{operation}"
checks.positive_data_acceptance.enabled = false
"""
    for operation in ("createBake", "createScene", "createVerification", "putBlob")
)


@pytest.mark.slow
def test_schemathesis_finds_nothing(tmp_path: Path) -> None:
    server = Server(tmp_path / "data", "--max-requests-per-second", "100000")
    try:
        config = tmp_path / "schemathesis.toml"
        config.write_text(NOT_ALL_THAT_IS_VALID)
        command = [str(Path(sys.executable).with_name("schemathesis")), "--config-file", str(config)]
        command += ["run", f"{server.url}/v1/openapi.json"]
        options = ["--max-examples", "30", "--seed", "1", "--phases", "examples,coverage,fuzzing", "--no-color"]
        # Every check is on where none is named. An endless answer is what an event stream is; its own tests follow them.
        out = ["--exclude-operation-id", "followBake", "--exclude-operation-id", "followVerification"]
        done = subprocess.run([*command, *options, *out], cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False)
        assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    finally:
        server.close()
