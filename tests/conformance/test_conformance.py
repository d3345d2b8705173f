"""The fixtures are up to date, and the numpy twin and GLSL on every host agree with what they say, reading nothing but them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from bake_core import irradiance
from bake_core.bundle import Atlas, VolumeData
from bake_core.light_field import arriving, light_field, trace
from bake_core.octahedral import dir_to_oct, oct_to_dir, with_border
from bake_core.volume_chains import volume_chain
from tests.conformance import generate
from tests.glsl import Host


def fixture(name: str) -> Any:
    return json.loads((generate.HERE / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["octahedral.json", "grid.json", "irradiance.json", "trace.json"])
def test_fixtures_are_what_the_generator_writes(name: str) -> None:
    assert (generate.HERE / name).read_text(encoding="utf-8") == generate.files()[name], "run: python tests/conformance/generate.py"


def volume_of(row: dict[str, Any]) -> VolumeData:
    atlases = {}
    for name, a in row.get("atlases", {}).items():
        texels = np.array(a["texels"], np.float32).reshape(a["shape"])
        atlases[name] = Atlas(
            name, texels, a["tile"], a["interior"], row["tiles"][0], row["tiles"][1], a["shape"][0], "float", a.get("miss", np.inf)
        )
    probes = np.array(row.get("probes", {"texels": []})["texels"], np.float32).reshape(-1, 4)[: np.prod(row["counts"])]
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


def traced(data: Any) -> tuple[list[Any], Any, Any, Any]:
    """Rays of the fixture; their verdicts as numbers, distances (far for a miss), and the rest of the answers."""
    rays = columns_of(data["queries"], "position", "direction", "roughness")
    words = {word: number for number, word in generate.VERDICTS.items()}
    verdict = np.array([words[row["verdict"]] for row in data["queries"]])
    distance = np.array([np.inf if row["distance"] is None else row["distance"] for row in data["queries"]])
    return rays, verdict, distance, columns_of(data["queries"], "normal", "volume", "probe", "radiance")


def test_tracing() -> None:
    data = fixture("trace.json")
    volumes = [volume_of(v) for v in data["volumes"]]
    for volume, row in zip(volumes, data["volumes"], strict=True):
        for name, chain in row["chains"].items():
            np.testing.assert_allclose(volume_chain(volume, name), np.reshape(chain["texels"], chain["shape"]), rtol=1e-6)
    (o, d, roughness), verdict, distance, (normal, of, probe, radiance) = traced(data)
    found = trace(light_field(volumes), o, d)
    np.testing.assert_array_equal(found.verdict, verdict)
    np.testing.assert_allclose(found.distance, distance, atol=1e-6)
    np.testing.assert_allclose(found.normal, normal, atol=1e-6)
    np.testing.assert_array_equal(found.volume, of)
    np.testing.assert_array_equal(found.probe, probe)
    for r in set(roughness):
        np.testing.assert_allclose(arriving(volumes, found, o, d, r)[roughness == r], radiance[roughness == r], atol=1e-6)


def columns_of(rows: list[dict[str, Any]], *names: str) -> list[Any]:
    return [np.array([row[name] for row in rows]) for name in names]


def test_octahedral_map_in_glsl(host: Host) -> None:
    data = fixture("octahedral.json")
    directions, encoded = columns_of(data["dir_to_oct"], "direction", "oct")
    found = host("void answer(vec4 given[1], out vec4 found[1]) { found[0].xy = obDirToOct(given[0].xyz); }", [directions], 1, ())
    np.testing.assert_allclose(found[:, 0, :2], encoded, atol=3e-7)
    squares, decoded = columns_of(data["oct_to_dir"], "oct", "direction")
    points = np.concatenate([squares, np.zeros((len(squares), 1))], -1)
    found = host("void answer(vec4 given[1], out vec4 found[1]) { found[0].xyz = obOctToDir(given[0].xy); }", [points], 1, ())
    np.testing.assert_allclose(found[:, 0, :3], decoded, atol=3e-7)


def test_grid_in_glsl(host: Host) -> None:
    data = fixture("grid.json")
    # The same three volumes, with what a module is not made without.
    volumes = [volume_of(v) for v in fixture("irradiance.json")["volumes"]]
    positions, volume, base, fraction = columns_of(data["queries"], "position", "volume", "base", "fraction")
    answer = """
    void answer(vec4 given[1], out vec4 found[2]) {
        int v = obSelectVolume(given[0].xyz);
        ObCell cell = obCell(obVolume(v), given[0].xyz);
        found[0] = vec4(vec3(cell.base), float(v));
        found[1] = vec4(cell.fraction, 0.0);
    }
    """
    found = host(answer, [positions], 2, volumes)
    np.testing.assert_array_equal(found[:, 0], np.concatenate([base, volume[:, None]], -1))
    np.testing.assert_allclose(found[:, 1, :3], fraction, atol=2e-6)


def test_irradiance_query_in_glsl(host: Host) -> None:
    data = fixture("irradiance.json")
    volumes = [volume_of(v) for v in data["volumes"]]
    *points, expected = columns_of(data["queries"], "position", "normal", "wo", "irradiance")
    answer = """
    void answer(vec4 given[3], out vec4 found[1]) { found[0].xyz = obIrradiance(given[0].xyz, given[1].xyz, given[2].xyz); }
    """
    found = host(answer, points, 1, volumes)
    brightest = max(float(v.atlases["irradiance"].texels.max()) for v in volumes)
    np.testing.assert_allclose(found[:, 0, :3], expected, atol=5e-6 * brightest)


def test_tracing_in_glsl(host: Host) -> None:
    data = fixture("trace.json")
    volumes = [volume_of(v) for v in data["volumes"]]
    (o, d, roughness), verdict, distance, (normal, of, probe, radiance) = traced(data)
    answer = """
    void answer(vec4 given[3], out vec4 found[4]) {
        ObTrace seen = obTraceRadiance(given[0].xyz, given[1].xyz, given[2].x);
        found[0] = vec4(seen.normal, seen.distance);
        found[1] = vec4(seen.radiance, float(seen.verdict));
        found[2] = vec4(float(seen.volume));
        found[3] = vec4(float(obIndex(obVolume(max(seen.volume, 0)), seen.probe)));
    }
    """
    found = host(answer, [o, d, roughness[:, None] * np.ones(3)], 4, volumes)
    np.testing.assert_array_equal(found[:, 1, 3], verdict)
    np.testing.assert_array_equal(found[:, 2, 0], of)
    np.testing.assert_array_equal(found[of >= 0, 3, 0], probe[of >= 0])
    near = np.isfinite(distance)
    assert (found[~near, 0, 3] > 1e30).all()
    np.testing.assert_allclose(found[near, 0, 3], distance[near], atol=5e-5)
    np.testing.assert_allclose(found[:, 0, :3], normal, atol=1e-6)
    np.testing.assert_allclose(found[:, 1, :3], radiance, atol=2e-4)
