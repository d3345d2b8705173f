"""What will be kept, left out and spent, before it is: selection, plan, and the clock's guesses."""

from __future__ import annotations

import math
import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from bake_core.allocation import FULL, HALVES, PILOT_SAMPLES, Allocation
from bake_core.bake import bake, empty_state
from bake_core.both_ways import measure
from bake_core.clock import expected_samples
from bake_core.convergence import error_bound
from bake_core.errors import MachineError, SpecError
from bake_core.examples import closed_box, cornell
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.images import read_exr
from bake_core.placement import place
from bake_core.plan import Pilot, doubt, plan, samples_needed
from bake_core.prepared import prepare
from bake_core.scene import Scene
from bake_core.selection import Selection, select
from bake_core.spec import OUTPUTS, Stop, parse_spec
from tests.scenes import ONE_PROBE, QUAD, SQUARE, add_square, load, load_example, square_scene


def spec(**changes: Any) -> Any:
    return parse_spec({"volumes": [ONE_PROBE], **changes})


def chosen_of(scene: Scene, **changes: Any) -> Selection:
    wanted = spec(**changes)
    volumes = place(scene, wanted)
    return select(scene, wanted, volumes, [v.positions() - scene.origin for v in volumes])


@pytest.mark.parametrize(("material", "glossy"), [({}, False), ({"metallic": 1.0}, False), ({"roughness": 0.5}, True)])
def test_single_directions_are_kept_where_something_reflects_them(material: dict[str, float], glossy: bool) -> None:
    chosen = chosen_of(square_scene(**material))
    assert chosen.outputs == (("irradiance", "radiance", "distance", "normal") if glossy else ("irradiance",))
    assert chosen.capture == (64 if glossy else 16)
    assert {x.what for x in chosen.left_out} == set(OUTPUTS) - set(chosen.outputs)
    assert all(x.why and x.bytes for x in chosen.left_out)


def test_gloss_out_of_the_volumes_reach_is_none() -> None:
    """A mirror 0.4 m below a probe, 0.6 m below, which is beyond half a spacing, and there as an instance."""
    for y, copies, reflects in ((-0.4, 1, True), (-0.6, 1, False), (-0.4, 2, True), (-0.6, 2, False)):
        w = GlbWriter()
        square = w.mesh("square", [Part(SQUARE, QUAD, material=w.material("mirror", metallic=1.0, roughness=0.1))])
        for i in range(copies):
            w.node(f"mirror {i}", mesh=square, translation=(0.25 * i, y, 0))
        add_square(w, "matt", matrix=np.diag([3.0, 1, 3.0, 1]))
        chosen = chosen_of(load(w))
        assert chosen.keeps("radiance") == reflects and chosen.capture == (64 if reflects else 16)
        assert reflects or any("within the volumes' reach" in x.why for x in chosen.left_out)


def test_a_material_that_nothing_uses_does_not_count() -> None:
    w = GlbWriter()
    add_square(w)
    w.material("spare", metallic=1.0, roughness=0.1)
    assert chosen_of(load(w)).outputs == ("irradiance",)


def test_what_the_spec_demands_goes_first() -> None:
    chosen = chosen_of(square_scene(), outputs=["normal", "irradiance"], resolution={"radiance": 32, "normal": 8})
    assert chosen.outputs == ("irradiance", "normal") and (chosen.capture, chosen.normal) == (32, 8)
    assert chosen.keeps("normal") and not chosen.keeps("visibility")


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_miss_is_longer_than_any_hit_and_says_that_it_is_none(size: float) -> None:
    w = GlbWriter()
    part_matrix = np.diag([size, size, size, 1.0])
    add_square(w, matrix=part_matrix)
    miss = chosen_of(load(w)).miss_distance
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
    assert made.probes == 8 and list(made.outputs) == [a["output"] for a in volume["atlases"] if a["output"] != "walls"]
    # What only the baked maps can tell comes after it.
    assert [x.entry() for x in made.left_out] == manifest["left_out"][: len(made.left_out)]
    stored = 0
    for atlas in volume["atlases"]:
        pixels, half = read_exr(tmp_path / "out" / atlas["file"], SpecError, "")
        # Of a box without colours one channel is stored.
        stored += pixels[..., 0].size * len(atlas["channels"]) * (2 if half else 4)
    assert made.atlas_bytes == stored
    assert made.paths_per_second > 1e4 and made.memory_bytes > made.atlas_bytes
    # All eight are the pilot, so that nothing is in doubt.
    assert made.least_seconds == made.seconds == made.greatest_seconds == made.most_seconds >= 8 * 256 * 4 / made.paths_per_second
    demanded = bake(tmp_path / "scene.glb", wanted.model_copy(update={"outputs": OUTPUTS}), tmp_path / "all").manifest
    sizes = {}
    for atlas in demanded["volumes"][0]["atlases"]:
        pixels, half = read_exr(tmp_path / "all" / atlas["file"], SpecError, "")
        sizes[atlas["output"]] = pixels.size * (2 if half else 4)
    sizes["visibility"] += sizes["walls"]
    assert {x.what: x.bytes for x in made.left_out if x.bytes is not None} == {o: sizes[o] for o in OUTPUTS if o != "irradiance"}


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
    assert of(square_scene(emission=(1.0, 1.0, 1.0))) == dark - {"emitter sampling"} | {"light tree"}


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
    # Nothing stands between the square and the probes above it.
    assert {name.split(".")[1] for name in both.same} == ({"irradiance"} if kind == "sky" else {"irradiance", "visibility", "walls"})
    # And the walls beside visibility.
    assert len(both.everything.digests) == len(OUTPUTS) + 1
    assert both.without.error == both.everything.error
    assert both.without.bytes < both.everything.bytes


def pilot(error: float, *, fall: float = 1.0, probes: int = 8, **changes: Any) -> Pilot:
    """One after which the bake's error figure would be `error`; every probe errs alike, and gets as many samples."""
    variance = np.ones(probes)
    variance *= (error / error_bound(variance, 14, 1.0, 4.0)) ** 2
    taken = np.full((probes, HALVES), PILOT_SAMPLES // HALVES)
    everybody = np.ones(probes, np.bool_)
    made = Pilot(np.ones(probes), 0.5, everybody, variance, 14, 1.0, fall, Allocation(taken, np.full((probes, HALVES), FULL)), 4.0, 0.0)
    return replace(made, **changes)


@pytest.mark.parametrize(
    ("stop", "error", "fall", "samples"),
    [
        (Stop(target_error=0.02), 0.0399, 1.0, 128),
        (Stop(target_error=0.02), 0.0399, 2.0, 64),
        (Stop(target_error=0.02), 0.4, 1.0, 256),
        (Stop(target_error=0.02), 0.001, 1.0, 16),
        (Stop(target_error=None), 0.001, 1.0, 256),
        (Stop(target_error=0.02, max_samples=8), 0.001, 1.0, 8),
    ],
)
def test_samples_that_a_pilot_asks_for(stop: Stop, error: float, fall: float, samples: int) -> None:
    found, taken = samples_needed(stop, pilot(error, fall=fall))
    assert found == samples and (taken == samples).all()


def test_probes_that_get_less_make_a_bake_shorter() -> None:
    """Half of them err little and get an eighth of the samples: of 256, they take the pilot's 32."""
    given = pilot(0.05).allocation
    given.eighths[4:] = 1
    variance = pilot(0.05).variance * np.repeat([2.0, 1e-3], 4)
    few = pilot(0.05, variance=variance, allocation=given, active=np.arange(9) < 8, seconds=np.arange(9.0))
    samples, taken = samples_needed(Stop(target_error=0.01, max_samples=256), few)
    assert samples == 256 and taken.tolist() == [256] * 4 + [32] * 4
    # The ninth is inside a solid.
    assert few.cost(taken).tolist() == [0.5 + 256 * i for i in range(4)] + [0.5 + 32 * i for i in range(4, 8)] + [0.5]


def test_no_active_probe_is_done_at_once() -> None:
    nobody = pilot(0.05, variance=np.zeros(0), allocation=Allocation.start(0))
    assert samples_needed(Stop(target_error=0.01), nobody)[0] == 16


def test_a_few_probes_leave_doubt_and_all_of_them_none() -> None:
    """Of intervals about the mean of 32 skewed values, about 95 % hold the mean of the 3,200 that they are of."""
    random = np.random.default_rng(0)
    held = []
    for _ in range(400):
        values = random.lognormal(0, 0.8, 3200)
        few = random.choice(values, 32, replace=False)
        held.append(abs(math.log(few.mean() / values.mean())) <= math.log(doubt(few, 100.0)))
    assert 0.9 <= np.mean(held) <= 0.98
    assert doubt(np.arange(5.0), 1.0) == 1.0 and doubt(np.ones(1), 9.0) == 1.0 and doubt(np.zeros(4), 9.0) == 1.0


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
