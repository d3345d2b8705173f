"""The bake-time choice of what a query's weights depend on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bake_core.bundle import MANIFEST, VolumeData
from bake_core.examples import Example, closed_box, cornell, two_rooms
from bake_core.irradiance import sample
from bake_core.leaks import leak_ratio
from bake_core.parameters import BIASES, FADES, FLOORS, PARAMETERS, Choice, choose_parameters
from bake_core.prepared import prepare
from bake_core.scene_files import load_scene
from bake_core.spec import parse_spec
from tests.baking import THREADS, bake_example

STOP = {"target_error": None, "max_samples": 16}


def volume_of(folder: Path, example: Example) -> VolumeData:
    return bake_example(folder, example, stop=STOP).volumes[0]


def choice_for(folder: Path, example: Example, volume: VolumeData, threads: int = THREADS) -> Choice:
    scene = load_scene(folder / "scene.glb")
    return choose_parameters(scene, prepare(scene, parse_spec(example[1])).whole, [[volume]], threads=threads)[0]


def test_walls_between_rooms_keep_the_default_and_their_darkness(tmp_path: Path) -> None:
    volume = volume_of(tmp_path, two_rooms())
    assert volume.parameters == PARAMETERS
    entry = json.loads((tmp_path / "bundle" / MANIFEST).read_bytes())["volumes"][0]["chosen"]
    assert entry["points"] == 2048
    assert entry["error"] == entry["default_error"] < 0.02
    assert leak_ratio(lambda p, n: sample([volume], p, n).irradiance) < 0.002


def test_walls_that_hide_what_is_seen_are_given_less_weight(tmp_path: Path) -> None:
    """Maps too coarse for their scene, in the extreme: of two probes in three the walls are said to be nearer than they are."""
    example = cornell()
    baked = volume_of(tmp_path, example)
    walls = baked.atlases["walls"]
    tiles = np.arange(walls.rows * walls.columns).reshape(1, walls.rows, walls.columns)
    nearer = np.where(tiles % 3 == 0, 1, 8).repeat(walls.tile, 1).repeat(walls.tile, 2)[..., None]
    lies = replace(baked, atlases={**baked.atlases, "walls": replace(walls, texels=(walls.texels * nearer).astype(np.float32))})
    choice = choice_for(tmp_path, example, lies)
    assert choice.error is not None
    assert choice.default_error is not None
    assert choice.error < 0.99 * choice.default_error
    assert choice.parameters != PARAMETERS
    assert choice.parameters["normal_bias"] in BIASES
    assert choice.parameters["visibility_floor"] in FLOORS
    assert choice.parameters["visibility_softness"] in FADES
    assert choice == choice_for(tmp_path, example, lies, threads=1)


@pytest.mark.parametrize("outputs", [["irradiance"], ["visibility"]])
def test_without_walls_or_light_nothing_is_measured(outputs: list[str], tmp_path: Path) -> None:
    volume = bake_example(tmp_path, closed_box(0.5, 1.0), stop=STOP, outputs=outputs).volumes[0]
    assert volume.parameters == PARAMETERS
    assert json.loads((tmp_path / "bundle" / MANIFEST).read_bytes())["volumes"][0]["chosen"] is None


def test_visibility_is_as_coarse_as_costs_nothing(tmp_path: Path) -> None:
    """Left open, its resolution is chosen for each volume: of what it is measured to need, and no light comes through by it."""
    document = {**two_rooms()[1], "resolution": {"visibility": None}}
    bundle = bake_example(tmp_path, (two_rooms()[0], document), stop=STOP)
    (volume,) = bundle.volumes
    side = volume.atlases["walls"].interior
    assert side == 8 and volume.atlases["visibility"].interior == side
    assert leak_ratio(lambda p, n: sample([volume], p, n).irradiance) < 0.002
    report = json.loads((tmp_path / "bundle" / "report.json").read_bytes())
    assert report["audit"]["texels"]["visibility"]["error"] < 0.05


def test_a_lower_resolution_is_taken_only_where_it_is_no_worse(tmp_path: Path) -> None:
    """The same maps once more, and maps of a wall everywhere: the one is as good, the other is not."""
    example = two_rooms()
    volume = volume_of(tmp_path, example)
    walls = volume.atlases["walls"]
    near = replace(volume, atlases={**volume.atlases, "walls": replace(walls, texels=np.full_like(walls.texels, 8.0))})
    scene = load_scene(tmp_path / "scene.glb")
    tracer = prepare(scene, parse_spec(example[1])).whole
    for ways, expected in (([volume], 0), ([volume, near], 0), ([volume, near, volume], 2)):
        assert choose_parameters(scene, tracer, [ways], threads=THREADS)[0].resolution == expected
