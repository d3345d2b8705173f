"""Cameras and thresholds as people give them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core.cameras import load_cameras, looking, parse_cameras
from bake_core.errors import InputError
from bake_core.thresholds import Thresholds, load_thresholds, parse_thresholds

GOOD = {"name": "a", "position": [0, 1, 3], "target": [0, 1, 0]}


def test_a_camera_looks_where_it_shall() -> None:
    (camera,) = parse_cameras([GOOD | {"yfov": 0.9}])
    np.testing.assert_allclose(camera.matrix, [[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)
    assert camera.yfov == 0.9


@pytest.mark.parametrize("target", [(0, 5, 0), (0, -5, 0), (1, 2, 3), (1e-9, 5, 0)])
def test_cameras_are_turned_never_mirrored_and_never_nan(target: tuple[float, float, float]) -> None:
    turn = looking((0, 0, 0), target)[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(-turn[:, 2], np.array(target) / np.linalg.norm(target), atol=1e-12)


@pytest.mark.parametrize(
    ("document", "place"),
    [
        ([], ""),
        ({}, ""),
        ([GOOD, GOOD], "[1].name"),
        ([GOOD | {"target": [0, 1, 3]}], "[0].target"),
        ([GOOD | {"yfov": 0}], "[0].yfov"),
        ([GOOD | {"yfov": 4}], "[0].yfov"),
        ([GOOD | {"fov": 1}], "[0].fov"),
        ([GOOD | {"position": [0, 1]}], "[0].position[2]"),
        ([GOOD | {"position": [0, 1, "3"]}], "[0].position[2]"),
        ([GOOD | {"name": "../x"}], "[0].name"),
        ([{"name": "a"}], "[0].position"),
        ([GOOD | {"position": [1e40, 0, 0]}], "[0].position[0]"),
    ],
)
def test_a_camera_that_is_none_is_refused_by_its_place(document: Any, place: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_cameras(document, "cameras.json")
    assert caught.value.slug == "camera.invalid"
    assert caught.value.where == f"cameras.json{place}"


def test_thresholds_default_to_the_cornell_boxs_and_may_be_given_in_part() -> None:
    assert Thresholds().model_dump(mode="json") == {
        "indirect": {"mean_ratio": [0.95, 1.05], "relmse": 0.05, "flip": None},
        "whole": {"mean_ratio": None, "relmse": None, "flip": None},
        "receivers": {"mean_ratio": None, "relmse": None, "p95": None},
    }
    given = parse_thresholds({"indirect": {"relmse": 0.01}, "whole": {"mean_ratio": [0.9, 1.1]}})
    assert given.indirect.mean_ratio is None
    assert given.indirect.relmse == 0.01
    assert given.whole.mean_ratio == (0.9, 1.1)
    assert parse_thresholds({"whole": {}}).indirect == Thresholds().indirect


@pytest.mark.parametrize(
    ("document", "place"),
    [
        ([], ""),
        ({"direct": {}}, ": direct"),
        ({"whole": {"relmsee": 1}}, ": whole.relmsee"),
        ({"whole": {"relmse": -1}}, ": whole.relmse"),
        ({"whole": {"mean_ratio": [1.1, 0.9]}}, ": whole"),
        ({"whole": {"mean_ratio": 1}}, ": whole.mean_ratio"),
    ],
)
def test_thresholds_that_are_none_are_refused_by_their_place(document: Any, place: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_thresholds(document, "t.json")
    assert caught.value.slug == "thresholds.invalid"
    assert caught.value.where == f"t.json{place}"


@pytest.mark.parametrize(("load", "area"), [(load_cameras, "camera"), (load_thresholds, "thresholds")])
def test_files_that_cannot_be_read(load: Callable[[Path], object], area: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path / "none.json")
    assert caught.value.slug == f"{area}.unreadable"
    path = tmp_path / "bad.json"
    for text, slug in (("[", "bad_json"), ("[NaN]", "not_finite"), ("[" * 1000 + "]" * 1000, "json_too_deep")):
        path.write_text(text)
        with pytest.raises(InputError) as caught:
            load(path)
        assert caught.value.slug == f"{area}.{slug}"


def test_a_file_of_cameras(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([GOOD, GOOD | {"name": "b"}]))
    assert [c.name for c in load_cameras(path)] == ["a", "b"]
