"""One light and one surface: `octobake sample` against the closed form, and what resolution 8 alone costs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from bake_core.examples import Example, plane_under_sun, square_emitter, square_emitter_irradiance
from service.cli import main
from tests.baking import bake_example


def sampled(capsys: pytest.CaptureFixture[str], bundle: Path, at: str, normal: str) -> float:
    """The first channel of what the command prints."""
    assert main(["sample", str(bundle), f"--at={at}", f"--normal={normal}", "--json"]) == 0
    answer: Any = json.loads(capsys.readouterr().out)
    return float(answer["samples"][0]["irradiance"][0])


def change(example: Example, irradiance: int) -> dict[str, Any]:
    return {"resolution": {**example[1]["resolution"], "irradiance": irradiance}}


@pytest.mark.parametrize(("resolution", "tolerance"), [(16, 0.005), (8, 0.0075)])
def test_plane_under_a_sun(tmp_path: Path, capsys: pytest.CaptureFixture[str], resolution: int, tolerance: float) -> None:
    example = plane_under_sun(albedo=0.5, irradiance=3.0, direction=(0.48, -0.8, 0.36))
    bake_example(tmp_path, example, **change(example, resolution))
    expected = 0.5 * 3.0 * 0.8
    below = sampled(capsys, tmp_path / "bundle", "0,1,0", "0,-1,0")
    assert below == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize(("resolution", "tolerance"), [(16, 0.005), (8, 0.0125)])
@pytest.mark.parametrize("shared", [True, False])
def test_square_emitter_beside_its_mirrored_twin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], resolution: int, tolerance: float, shared: bool
) -> None:
    example = square_emitter(2.0, shared=shared)
    bake_example(tmp_path, example, **change(example, resolution))
    expected = square_emitter_irradiance(2.0)
    for normal in ("1,0,0", "-1,0,0"):
        assert sampled(capsys, tmp_path / "bundle", "0,0,0", normal) == pytest.approx(expected, rel=tolerance)


def test_a_four_vertex_path_has_four_scatter_events(tmp_path: Path) -> None:
    """One bounce over a plane: all the light there is; none without."""
    from tests.baking import maps

    example = plane_under_sun()
    assert maps(bake_example(tmp_path, example, max_bounces=0)).max() == 0
    assert maps(bake_example(tmp_path, example, max_bounces=1)).max() > 0
