"""What every test shares: where outside scenes lie, and that nothing is left running."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests import chromium, glsl


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of scenes and specs that is handed out beside a checkout and is no part of it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not (folder / "scenes").is_dir():
        pytest.skip("no shared/ folder beside this checkout: its scenes are not ours to ship")
    return folder


@pytest.fixture(params=["lavapipe", "swiftshader", "webgl2"])
def host(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> glsl.Host:
    """What runs GLSL, each in turn: Mesa's Vulkan driver, Chromium's, and Chromium's WebGL2."""
    if request.param != "lavapipe":
        chromium.needed(request.param)
    if request.param == "webgl2":
        return glsl.on_webgl2
    if request.param == "swiftshader":
        monkeypatch.setenv("VK_DRIVER_FILES", str(chromium.SWIFTSHADER))
    return glsl.on_vulkan


@pytest.fixture(scope="session", autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Every process that a test starts ends with it."""
    yield
    # multiprocessing's resource tracker belongs to Python, and ends with the process that it watches.
    left = [p for p in psutil.Process().children(recursive=True) if "resource_tracker" not in " ".join(p.cmdline())]
    assert not left, f"tests left processes running: {left}"
