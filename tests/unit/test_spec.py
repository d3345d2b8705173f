"""The spec: defaults, what it takes, and every way of getting it wrong, each with its slug and its place."""

from __future__ import annotations

import copy
import json
import time
from pathlib import Path
from typing import Any

import pytest

from bake_core.errors import SpecError
from bake_core.spec import MAX_PROBES, Spec, load_spec, parse_spec

GRID = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [2, 2, 2]}
WHOLE = {
    "version": 1,
    "volumes": [{"name": "a", **GRID}, {"fit": "scene", "spacing": [1, 2, 3]}, {"fit": "node", "node": "N", "counts": [1, 2, 3]}],
    "environment": {"kind": "constant", "radiance": [0.5, 1, 2]},
    "lights": [
        {"kind": "directional", "direction": [0, -1, 0], "irradiance": [1, 1, 1]},
        {"kind": "point", "position": [0, 1, 0], "intensity": [1, 2, 3]},
        {"kind": "spot", "position": [0, 1, 0], "direction": [0, -1, 0], "intensity": [1, 1, 1], "inner_angle": 0.1, "outer_angle": 0.2},
    ],
    "outputs": ["irradiance", "visibility"],
    "resolution": {"irradiance": 8, "visibility": 16, "radiance": 16, "distance": 64, "normal": 64},
    "max_bounces": 4,
    "stop": {"target_error": 0.02, "max_seconds": 60, "max_samples": 256},
    "seed": 18446744073709551615,
}


def changed(path: str, value: Any) -> dict[str, Any]:
    """WHOLE with one field set, or removed where the value is ...; paths as ``volumes/0/spacing``."""
    document: Any = copy.deepcopy(WHOLE)
    *steps, last = [int(s) if s.isdecimal() else s for s in path.split("/")]
    at = document
    for step in steps:
        at = at[step]
    if value is ...:
        del at[last]
    else:
        at[last] = value
    return document  # type: ignore[no-any-return]


def test_a_spec_that_says_everything() -> None:
    spec = parse_spec(WHOLE)
    assert spec.seed == 2**64 - 1 and spec.max_bounces == 4 and len(spec.lights) == 3
    assert spec.volumes[1].fit == "scene" and spec.volumes[2].node == "N"
    # What the manifest records is a spec again, and says the same.
    canonical = spec.canonical()
    assert parse_spec(json.loads(json.dumps(canonical))).canonical() == canonical
    assert [v["name"] for v in canonical["volumes"]] == ["a", "v1", "v2"]


def test_everything_but_volumes_has_a_default() -> None:
    spec = parse_spec({"volumes": [GRID]})
    assert spec == parse_spec({"version": 1, "volumes": [GRID]})
    assert spec.canonical() == {
        "version": 1,
        "volumes": [{"name": "v0", "origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [2, 2, 2]}],
        "environment": {"kind": "constant", "radiance": [0, 0, 0]},
        "lights": [],
        "outputs": "auto",
        "receivers": "everywhere",
        "probes": "auto",
        "resolution": {"irradiance": 8, "visibility": 16, "radiance": None, "distance": 64, "normal": 64},
        "integrator": "auto",
        "max_bounces": None,
        "stop": {"target_error": 0.02, "max_seconds": None, "max_samples": 256},
        "seed": 0,
    }


def test_missing_keys_inside_resolution_and_stop_keep_their_defaults() -> None:
    spec = parse_spec({"volumes": [GRID], "resolution": {"irradiance": 16}, "stop": {"target_error": None}})
    assert (spec.resolution.irradiance, spec.resolution.visibility) == (16, 16)
    assert (spec.stop.target_error, spec.stop.max_samples) == (None, 256)


def test_whole_numbers_may_stand_where_real_ones_do_and_the_other_way_round_not() -> None:
    parse_spec(changed("volumes/0/spacing", [1, 2.5, 3]))
    with pytest.raises(SpecError):
        parse_spec(changed("volumes/0/counts", [1.5, 2, 3]))


@pytest.mark.parametrize(
    ("path", "value", "slug", "where"),
    [
        # Keys.
        ("volumes", ..., "missing_key", "volumes"),
        ("outputz", [], "unknown_key", "outputz"),
        ("volumes/0/spacin", [1, 1, 1], "unknown_key", "volumes[0].spacin"),
        ("environment/colour", [1, 1, 1], "unknown_key", "environment.colour"),
        ("lights/2/angle", 1, "unknown_key", "lights[2].angle"),
        ("lights/2/spot", 1, "unknown_key", "lights[2].spot"),
        ("environment/constant", 1, "unknown_key", "environment.constant"),
        ("resolution/sides", 8, "unknown_key", "resolution.sides"),
        ("stop/when", 8, "unknown_key", "stop.when"),
        ("lights/1/position", ..., "missing_key", "lights[1].position"),
        ("lights/0/kind", ..., "invalid", "lights[0]"),
        # Volumes.
        ("volumes", [], "invalid", "volumes"),
        ("volumes", {}, "invalid", "volumes"),
        ("volumes/0/spacing", [0, 1, 1], "invalid", "volumes[0].spacing[0]"),
        ("volumes/0/spacing", [1, -1, 1], "invalid", "volumes[0].spacing[1]"),
        ("volumes/0/spacing", [1, 1], "missing_key", "volumes[0].spacing[2]"),
        ("volumes/0/spacing", [1, 1, 1, 1], "invalid", "volumes[0].spacing"),
        ("volumes/0/spacing", 1, "invalid", "volumes[0].spacing"),
        ("volumes/0/spacing", ..., "invalid", "volumes[0]"),
        ("volumes/0/spacing", [1e31, 1, 1], "invalid", "volumes[0].spacing[0]"),
        ("volumes/0/origin", [1, "2", 3], "invalid", "volumes[0].origin[1]"),
        ("volumes/0/origin", [1, True, 3], "invalid", "volumes[0].origin[1]"),
        ("volumes/0/origin", [1, None, 3], "invalid", "volumes[0].origin[1]"),
        ("volumes/0/counts", [0, 1, 1], "invalid", "volumes[0].counts[0]"),
        ("volumes/0/counts", [1, 1, -1], "invalid", "volumes[0].counts[2]"),
        ("volumes/0/counts", [256, 256, 257], "too_many_probes", "volumes[0]"),
        ("volumes/0/counts", [10**9, 10**9, 10**9], "too_many_probes", "volumes[0]"),
        ("volumes/0/counts", [10**300, 1, 1], "too_many_probes", "volumes[0]"),
        ("volumes/0/fit", "scene", "invalid", "volumes[0]"),
        ("volumes/0/fit", "room", "invalid", "volumes[0].fit"),
        ("volumes/1/counts", [1, 1, 1], "invalid", "volumes[1]"),
        ("volumes/2/node", ..., "invalid", "volumes[2]"),
        ("volumes/0/name", "", "invalid", "volumes[0].name"),
        ("volumes/0/name", "../up", "invalid", "volumes[0].name"),
        ("volumes/0/name", ".hidden", "invalid", "volumes[0].name"),
        ("volumes/0/name", "a/b", "invalid", "volumes[0].name"),
        ("volumes/0/name", "a\n", "invalid", "volumes[0].name"),
        ("volumes/0/name", "a" * 129, "invalid", "volumes[0].name"),
        ("volumes/0/name", "v1", "invalid", ""),
        ("volumes", [GRID] * 65, "invalid", "volumes"),
        # Light.
        ("environment/radiance", [1, 1, -1], "invalid", "environment.radiance[2]"),
        ("environment/kind", "skybox", "invalid", "environment"),
        ("environment", {"kind": "equirect"}, "missing_key", "environment.image"),
        ("lights/0/direction", [0, 0, 0], "invalid", "lights[0].direction"),
        ("lights/0/irradiance", [1, -1, 1], "invalid", "lights[0].irradiance[1]"),
        ("lights/0/kind", "laser", "invalid", "lights[0]"),
        ("lights/2/inner_angle", 0.3, "invalid", "lights[2]"),
        ("lights/2/outer_angle", 1.6, "invalid", "lights[2]"),
        ("lights/2/inner_angle", -0.1, "invalid", "lights[2].inner_angle"),
        # Outputs, resolution, when to stop.
        ("outputs", "all", "invalid", "outputs"),
        ("outputs", [], "invalid", "outputs"),
        ("outputs", ["irradiance", "colour"], "invalid", "outputs[1]"),
        ("outputs", ["irradiance", "irradiance"], "invalid", ""),
        ("resolution/irradiance", 7, "invalid", "resolution.irradiance"),
        ("resolution/irradiance", 0, "invalid", "resolution.irradiance"),
        ("resolution/distance", 1026, "invalid", "resolution.distance"),
        ("resolution/normal", None, "invalid", "resolution.normal"),
        ("max_bounces", -1, "invalid", "max_bounces"),
        ("max_bounces", 1 << 21, "invalid", "max_bounces"),
        ("stop/target_error", 0, "invalid", "stop.target_error"),
        ("stop/target_error", -0.1, "invalid", "stop.target_error"),
        ("stop/max_seconds", 0, "invalid", "stop.max_seconds"),
        ("stop/max_samples", 0, "invalid", "stop.max_samples"),
        ("stop/max_samples", 1 << 25, "invalid", "stop.max_samples"),
        ("seed", -1, "invalid", "seed"),
        ("seed", 1 << 64, "invalid", "seed"),
        ("seed", "1", "invalid", "seed"),
        ("version", 2, "invalid", "version"),
        ("version", "1", "invalid", "version"),
    ],
)
def test_faults(path: str, value: Any, slug: str, where: str) -> None:
    began = time.perf_counter()
    with pytest.raises(SpecError) as caught:
        parse_spec(changed(path, value))
    e = caught.value
    assert (e.slug, e.where) == (f"spec.{slug}", f"spec: {where}" if where else "spec")
    assert e.exit_code == 2 and e.message and "\n" not in str(e)
    assert time.perf_counter() - began < 1


@pytest.mark.parametrize("document", [None, [], 3, "spec", [{"volumes": [GRID]}]])
def test_what_is_no_object_is_no_spec(document: Any) -> None:
    with pytest.raises(SpecError) as caught:
        parse_spec(document)
    assert caught.value.slug == "spec.invalid"


def test_the_number_of_further_faults_is_told() -> None:
    with pytest.raises(SpecError) as caught:
        parse_spec({**WHOLE, "seed": -1, "max_bounces": -1, "version": 3})
    assert "(and 2 more)" in caught.value.message


def test_the_largest_grid_is_no_fault() -> None:
    assert MAX_PROBES == 2**24
    spec = parse_spec(changed("volumes/0/counts", [256, 256, 256]))
    assert isinstance(spec, Spec)


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "spec.json"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.mark.parametrize(
    ("text", "slug"),
    [
        ("", "bad_json"),
        ("{", "bad_json"),
        ('{"volumes": }', "bad_json"),
        ("{} trailing", "bad_json"),
        (b"\xff\xfe{}", "bad_json"),
        ('{"seed": 1, "seed": 2}', "duplicate_key"),
        ('{"seed": NaN}', "not_finite"),
        ('{"volumes": [{"origin": [0, 0, Infinity], "spacing": [1, 1, 1], "counts": [1, 1, 1]}]}', "not_finite"),
        ('{"volumes": [{"origin": [0, 0, 1e999], "spacing": [1, 1, 1], "counts": [1, 1, 1]}]}', "not_finite"),
        ('{"volumes": ' + "[" * 200_000 + "]" * 200_000 + "}", "json_too_deep"),
        ('{"seed": ' + "1" * 5000 + "}", "bad_json"),
        ('{"stop": {"max_samples": 1e400}, "volumes": [{"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}]}', "invalid"),
    ],
)
def test_files_that_are_no_spec(tmp_path: Path, text: str | bytes, slug: str) -> None:
    began = time.perf_counter()
    with pytest.raises(SpecError) as caught:
        load_spec(written(tmp_path, text))
    assert caught.value.slug == f"spec.{slug}"
    assert caught.value.where.startswith("spec.json")
    assert "\n" not in str(caught.value)
    assert time.perf_counter() - began < 2


def test_a_file_that_is_not_there() -> None:
    with pytest.raises(SpecError) as caught:
        load_spec(Path("nowhere") / "spec.json")
    assert caught.value.slug == "spec.unreadable" and "spec.json" in caught.value.where


def test_a_byte_order_mark_is_allowed(tmp_path: Path) -> None:
    assert load_spec(written(tmp_path, "\ufeff" + json.dumps(WHOLE))) == parse_spec(WHOLE)


def test_specs_handed_out_beside_the_checkout(shared: Path) -> None:
    for path in sorted((shared / "specs").glob("*.json")):
        load_spec(path)
