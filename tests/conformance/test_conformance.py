"""The fixtures are up to date, and the numpy twin agrees with what they say when it reads nothing but them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from bake_core import irradiance
from bake_core.bundle import Atlas, VolumeData
from bake_core.octahedral import dir_to_oct, oct_to_dir, with_border
from tests.conformance import generate


def fixture(name: str) -> Any:
    return json.loads((generate.HERE / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["octahedral.json", "grid.json", "irradiance.json"])
def test_fixtures_are_what_the_generator_writes(name: str) -> None:
    assert (generate.HERE / name).read_text(encoding="utf-8") == generate.files()[name], "run: python tests/conformance/generate.py"


def volume_of(row: dict[str, Any]) -> VolumeData:
    atlases = {}
    for name, a in row.get("atlases", {}).items():
        texels = np.array(a["texels"], np.float32).reshape(a["shape"])
        atlases[name] = Atlas(name, texels, a["tile"], a["interior"], row["tiles"][0], row["tiles"][1], a["shape"][0], "float")
    probes = np.array(row.get("probes", {"texels": []})["texels"], np.float32).reshape(-1, 4)
    # The biases are given in metres: with this spacing-free scale they come out as they stand.
    counts = np.asarray(row["counts"])
    spacing = np.asarray(row["spacing"])
    several = spacing[counts > 1].min()
    parameters = {"bias_scale": 1 / several} | {
        k: row.get(k, 0.0) for k in ("normal_bias", "view_bias", "visibility_softness", "visibility_floor")
    }
    return VolumeData(
        name="",
        origin=np.asarray(row["origin"]),
        spacing=spacing,
        counts=counts,
        states=(probes[:, 3] > 0).astype(np.uint8),
        offsets=probes[:, :3],
        backface=np.zeros(len(probes), np.float32),
        parameters=parameters,
        distance_limit=row.get("distance_limit", 0.0),
        atlases=atlases,
    )


def test_octahedral_map() -> None:
    data = fixture("octahedral.json")
    for row in data["dir_to_oct"]:
        np.testing.assert_allclose(dir_to_oct(np.array(row["direction"])), row["oct"], atol=2e-9)
    for row in data["oct_to_dir"]:
        np.testing.assert_allclose(oct_to_dir(np.array(row["oct"])), row["direction"], atol=2e-9)
    border = data["border"]
    np.testing.assert_array_equal(with_border(np.array(border["interior"], float)[..., None])[..., 0], border["tile"])


def test_grid() -> None:
    data = fixture("grid.json")
    volumes = [volume_of(v) for v in data["volumes"]]
    for row in data["queries"]:
        position = np.array([row["position"]])
        assert irradiance.select_volume(volumes, position)[0] == row["volume"]
        base, fraction = irradiance.cell(volumes[row["volume"]], position)
        np.testing.assert_array_equal(base[0], row["base"])
        np.testing.assert_allclose(fraction[0], row["fraction"], atol=1e-8)


def test_irradiance_query() -> None:
    data = fixture("irradiance.json")
    volumes = [volume_of(v) for v in data["volumes"]]
    columns = {k: np.array([row[k] for row in data["queries"]]) for k in data["queries"][0]}
    found = irradiance.sample(volumes, columns["position"], columns["normal"], columns["wo"])
    np.testing.assert_array_equal(found.volume, columns["volume"])
    np.testing.assert_array_equal(found.volumes, columns["volumes"])
    np.testing.assert_array_equal(found.probes, columns["probes"])
    np.testing.assert_allclose(found.weights, columns["weights"], atol=1e-6)
    np.testing.assert_allclose(found.irradiance, columns["irradiance"], atol=1e-6)
