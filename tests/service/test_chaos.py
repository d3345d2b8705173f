"""A short run of `make chaos`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service import chaos


@pytest.mark.slow
def test_random_kills_lose_nothing(tmp_path: Path) -> None:
    figures = chaos.run(tmp_path, kills=15, seed=1)
    assert chaos.holds(figures), figures
    assert figures.kills_of_service and figures.kills_of_worker
