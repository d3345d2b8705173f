"""What will be kept, left out and spent, before it is: selection, plan, and the clock's guesses."""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from bake_core.bake import bake, empty_state, prepare
from bake_core.both_ways import measure
from bake_core.clock import expected_samples
from bake_core.errors import MachineError, SpecError
from bake_core.examples import closed_box, cornell
from bake_core.gltf.writer import GlbWriter
from bake_core.images import read_exr
from bake_core.plan import plan, samples_needed
from bake_core.scene import Scene
from bake_core.selection import select
from bake_core.spec import OUTPUTS, Stop, parse_spec
from tests.scenes import ONE_PROBE, add_square, load, square_scene
from tests.unit.test_transport import load_example


def spec(**changes: Any) -> Any:
    return parse_spec({"volumes": [ONE_PROBE], **changes})


@pytest.mark.parametrize(("material", "glossy"), [({}, False), ({"metallic": 1.0}, False), ({"roughness": 0.5}, True)])
def test_single_directions_are_kept_where_something_reflects_them(material: dict[str, float], glossy: bool) -> None:
    chosen = select(square_scene(**material), spec(), 1)
    assert chosen.outputs == (OUTPUTS if glossy else ("irradiance", "visibility"))
    assert chosen.capture == (64 if glossy else 16)
    assert {x.what for x in chosen.left_out} == set(OUTPUTS) - set(chosen.outputs)
    assert all(x.why and x.bytes for x in chosen.left_out)


def test_a_material_that_nothing_uses_does_not_count() -> None:
    w = GlbWriter()
    add_square(w)
    w.material("spare", metallic=1.0, roughness=0.1)
    assert select(load(w), spec(), 1).outputs == ("irradiance", "visibility")


def test_what_the_spec_demands_goes_first() -> None:
    chosen = select(square_scene(), spec(outputs=["normal", "irradiance"], resolution={"radiance": 32, "normal": 8}), 1)
    assert chosen.outputs == ("irradiance", "normal") and (chosen.capture, chosen.normal) == (32, 8)
    assert chosen.keeps("normal") and not chosen.keeps("visibility")


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_miss_is_longer_than_any_hit_and_says_that_it_is_none(size: float) -> None:
    w = GlbWriter()
    part_matrix = np.diag([size, size, size, 1.0])
    add_square(w, matrix=part_matrix)
    miss = select(load(w), spec(), 1).miss_distance
    assert 4 * 2**0.5 * size * 0.999 <= miss <= 8 * 2**0.5 * size * 1.001
    assert float(miss).hex().startswith("0x1.0000000000000p")


def test_a_plan_says_what_the_bake_then_does(tmp_path: Path) -> None:
    glb, document = closed_box(0.5, 1.0)
    wanted = parse_spec({**document, "stop": {"target_error": None, "max_samples": 4}})
    made = plan(load_example(glb), wanted, threads=1)
    (tmp_path / "scene.glb").write_bytes(glb)
    manifest = bake(tmp_path / "scene.glb", wanted, tmp_path / "out").manifest
    (volume,) = manifest["volumes"]
    assert (list(made.volumes[0].origin), list(made.volumes[0].counts)) == (volume["origin"], volume["counts"])
    assert made.probes == 8 and list(made.outputs) == [a["output"] for a in volume["atlases"]]
    # What only the baked maps can tell comes after it.
    assert [x.entry() for x in made.left_out] == manifest["left_out"][: len(made.left_out)]
    stored = 0
    for atlas in volume["atlases"]:
        pixels, half = read_exr(tmp_path / "out" / atlas["file"], SpecError, "")
        # Of a box without colours one channel is stored.
        stored += pixels[..., 0].size * len(atlas["channels"]) * (2 if half else 4)
    assert made.atlas_bytes == stored
    assert made.paths_per_second > 1e4 and made.memory_bytes > made.atlas_bytes
    assert made.seconds == made.most_seconds >= 8 * 256 * 4 / made.paths_per_second
    demanded = bake(tmp_path / "scene.glb", wanted.model_copy(update={"outputs": OUTPUTS}), tmp_path / "all").manifest
    sizes = {}
    for atlas in demanded["volumes"][0]["atlases"]:
        pixels, half = read_exr(tmp_path / "all" / atlas["file"], SpecError, "")
        sizes[atlas["output"]] = pixels.size * (2 if half else 4)
    assert {x.what: x.bytes for x in made.left_out if x.bytes is not None} == {o: sizes[o] for o in ("radiance", "distance", "normal")}


LIT = {"environment": {"kind": "constant", "radiance": [1.0, 1.0, 1.0]}, "stop": {"target_error": None, "max_samples": 32}}
FOUR = [{"origin": [-0.2, 0.2, -0.2], "spacing": [0.4, 0.4, 0.4], "counts": [2, 2, 2]}]


def test_what_kernels_do_without_is_said_of_each_scene() -> None:
    def of(scene: Scene, **more: Any) -> set[str]:
        return {x.what.removeprefix("code for ") for x in prepare(scene, spec(**more)).left_out if x.what.startswith("code for ")}

    always = {"textures", "sky sampling", "instances"}
    bare = square_scene()
    dark = of(bare)
    assert always | {"gloss", "environment", "emitter sampling", "light sampling"} <= dark
    assert of(bare, environment=LIT["environment"]) == dark - {"environment"}
    sun = {"kind": "directional", "direction": [0, -1, 0], "irradiance": [1, 1, 1]}
    assert of(bare, lights=[sun]) == dark - {"light sampling"}
    assert of(square_scene(roughness=0.5)) == dark - {"gloss"}
    assert of(square_scene(emission=(1.0, 1.0, 1.0))) == dark - {"emitter sampling"}


@pytest.mark.parametrize("kind", ["sky", "lamp"])
def test_nothing_left_out_changes_what_is_kept(kind: str) -> None:
    """Every output demanded back and kernels for textures, holes and gloss: the same irradiance and visibility, to the last bit.

    A verification reads nothing else of such a scene, so both its pictures are the same, too.
    """
    if kind == "sky":
        scene, wanted = square_scene(), parse_spec({"volumes": FOUR, **LIT})
    else:
        glb, document = cornell()
        scene = load_example(glb)
        wanted = parse_spec({**document, "volumes": [{"fit": "scene", "counts": [2, 2, 2]}], "stop": LIT["stop"]})
    both = measure(scene, wanted, threads=1)
    assert both.other == []
    assert {name.split(".")[1] for name in both.same} == {"irradiance", "visibility"}
    assert len(both.everything.digests) == len(both.same) + 3
    assert both.without.error == both.everything.error
    assert both.without.bytes < both.everything.bytes


@pytest.mark.parametrize(
    ("stop", "error", "samples"),
    [
        (Stop(target_error=0.02), 0.04, 128),
        (Stop(target_error=0.02), 0.4, 256),
        (Stop(target_error=0.02), 0.001, 16),
        (Stop(target_error=0.02), None, 256),
        (Stop(target_error=None), 0.001, 256),
        (Stop(target_error=0.02, max_samples=8), 0.001, 8),
    ],
)
def test_samples_that_a_pilot_asks_for(stop: Stop, error: float | None, samples: int) -> None:
    assert samples_needed(spec().model_copy(update={"stop": stop}), error) == samples


def test_a_large_grid_is_planned_without_its_sums_and_refused_by_name_where_they_do_not_fit() -> None:
    """A million probes are 6 GB of sums: a figure in the plan, an error with a slug where a bake begins."""
    large = parse_spec({"volumes": [{"fit": "scene", "counts": [128, 128, 64]}]})
    scene = load_example(closed_box(0.5, 1.0)[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + (2 << 30), hard))
    try:
        made = plan(scene, large, threads=1)
        with pytest.raises(MachineError) as caught:
            empty_state(prepare(scene, large))
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert made.memory_bytes > 2 * 2**20 * 4 * 64 * 3 * 8
    assert caught.value.slug == "machine.no_memory"


def test_a_plan_refuses_what_a_bake_refuses() -> None:
    with pytest.raises(SpecError):
        plan(load_example(cornell()[0]), spec(environment={"kind": "equirect", "image": "sky.exr"}), threads=1)


@pytest.mark.parametrize(
    ("stop", "samples", "error", "expected"),
    [
        (Stop(target_error=0.02), 16, 0.01, 16),
        (Stop(target_error=0.02), 16, 0.04, 64),  # the error falls as the square root at the least
        (Stop(target_error=0.02), 16, 4.0, 256),
        (Stop(target_error=None), 16, 0.01, 256),
        (Stop(target_error=0.02), 16, None, 256),
    ],
)
def test_guesses_of_how_long_it_takes(stop: Stop, samples: int, error: float | None, expected: int) -> None:
    assert expected_samples(stop, samples, error) == expected
