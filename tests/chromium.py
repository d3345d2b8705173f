"""Headless Chromium, where `make chromium` has put it: a second Vulkan driver, a WebGL2, and eyes for the service's pages."""

from __future__ import annotations

import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

CHROMIUM = Path(__file__).resolve().parents[1] / "build" / "chromium"
SWIFTSHADER = CHROMIUM / "usr" / "lib" / "chromium" / "vk_swiftshader_icd.json"


def needed(what: str) -> None:
    """Skip the test where there is none."""
    if not SWIFTSHADER.is_file():
        pytest.skip(f"{what} comes with Chromium, which is not in build/chromium; `make chromium` fetches it")


def document(url: str, *flags: str) -> str:
    """What a page has become once its scripts have run, as HTML."""
    libraries = CHROMIUM / "usr" / "lib" / "x86_64-linux-gnu"
    with TemporaryDirectory() as place:
        # Our own pages only, and a sandbox needs what containers lack. It draws on the CPU, like every other host of ours.
        always = ["--headless", "--no-sandbox", "--use-angle=swiftshader", f"--user-data-dir={place}/profile"]
        done = subprocess.run(
            [CHROMIUM / "usr/lib/chromium/chromium-headless-shell", *always, *flags, "--dump-dom", url],
            env={"LD_LIBRARY_PATH": f"{libraries}:{libraries}/pulseaudio", "HOME": place, "TMPDIR": place},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
    assert done.stdout, f"Chromium left no page: {done.stderr[-2000:]}"
    return done.stdout
