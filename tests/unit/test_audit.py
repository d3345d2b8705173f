"""Audits find what is wrong, confirm what is right, and end in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.audit import Audit, Baked, audit
from bake_core.bake import finish, gather
from bake_core.bundle import Atlas, VolumeData, read_bundle, read_report
from bake_core.clock import Clock
from bake_core.errors import Cancelled
from bake_core.examples import closed_box, cornell, square_emitter, two_rooms
from bake_core.prepared import Prepared, prepare
from bake_core.report import Run
from bake_core.scene_files import load_scene
from bake_core.spec import parse_spec

Array = NDArray[Any]
STOP = {"target_error": None, "max_samples": 64}


def baked(folder: Path, example: tuple[bytes, dict[str, Any]], **changes: Any) -> Baked:
    """A bake and what was read back of it."""
    glb, spec = example
    (folder / "scene.glb").write_bytes(glb)
    prepared = prepare(load_scene(folder / "scene.glb"), parse_spec({**spec, "stop": STOP, **changes}))
    return of(prepared, folder)


def of(prepared: Prepared, folder: Path) -> Baked:
    run = Run(2, 1)
    state = gather(prepared, run, Clock(prepared.spec, None))
    finish(prepared, state, run, folder / "out", audit_seconds=0)
    volumes = read_bundle(folder / "out").volumes
    return Baked(prepared.scene, prepared.spec, prepared.tracer, state, volumes, prepared.positions, prepared.limits)


def small_cornell(**changes: Any) -> tuple[bytes, dict[str, Any]]:
    glb, spec = cornell()
    return glb, {**spec, "volumes": [{"origin": [-0.75, 0.25, -0.75], "spacing": [0.5, 0.5, 0.5], "counts": [4, 4, 4]}], **changes}


def ticking(step: float) -> Callable[[], float]:
    """A clock that goes on by a step at each look."""
    at = 0.0

    def now() -> float:
        nonlocal at
        at += step
        return at

    return now


def thorough(b: Baked) -> Audit:
    """As much work whatever the machine: every look of any kind takes as long by this clock."""
    return audit(b, 0.6, threads=2, now=ticking(0.01))


def spoilt(b: Baked, output: str, change: Callable[[Array], Array]) -> Baked:
    """The same bundle with other values in its files."""

    def of_volume(v: VolumeData) -> VolumeData:
        atlas: Atlas = v.atlases[output]
        return replace(v, atlases={**v.atlases, output: replace(atlas, texels=change(atlas.texels).astype(np.float32))})

    return replace(b, volumes=[of_volume(v) for v in b.volumes])


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Baked:
    return baked(tmp_path_factory.mktemp("cornell"), small_cornell())


def test_an_honest_bake_is_confirmed(box: Baked) -> None:
    found = thorough(box)
    texels = found.texels["irradiance"]
    assert found.stated is not None and found.verdict == "confirmed"
    assert texels.sampling is not None and texels.bias_within is not None
    assert texels.low <= found.stated and texels.sampling < found.stated
    assert abs(texels.bias) <= 2 * texels.bias_within
    assert 0 < texels.encoding < 2.5e-4
    assert found.surfaces is not None and found.surface_bound is not None
    # Between probes, in a box of four of them to a side, a query errs by more than its samples do.
    sampling = found.surfaces.sampling
    assert sampling is not None and sampling < found.surfaces.error and sampling < found.surface_bound


def test_a_wrong_scale_is_found_and_is_neither_sampling_nor_luck(box: Baked) -> None:
    found = thorough(spoilt(box, "irradiance", lambda texels: 1.1 * texels))
    texels = found.texels["irradiance"]
    # What was to be stored is known, so this is what storing did.
    assert texels.encoding == pytest.approx(0.1 / 1.1, rel=0.05)
    assert texels.bias == pytest.approx(0.1 / 1.1, abs=0.03)
    assert texels.low > 0.06


def test_a_bias_of_what_was_to_be_stored_is_filtering_and_refutes(box: Baked) -> None:
    state = replace(box.state, irradiance=(1.15 * box.state.irradiance).astype(np.float32))
    found = thorough(replace(spoilt(box, "irradiance", lambda texels: 1.15 * texels), state=state))
    texels = found.texels["irradiance"]
    assert texels.encoding < 1e-3
    assert texels.filtering == pytest.approx(0.15 / 1.15, rel=0.15)
    assert found.verdict == "refuted"


def test_blunt_visibility_is_found(box: Baked) -> None:
    honest = thorough(box).texels["visibility"]
    blunt = thorough(spoilt(box, "visibility", lambda texels: np.full_like(texels, texels.mean()))).texels["visibility"]
    assert honest.low < 0.02 < 0.2 < blunt.low


def test_a_furnace_has_no_error_but_its_noise(tmp_path: Path) -> None:
    b = baked(tmp_path, closed_box(0.5, 1.0), outputs=["irradiance", "visibility", "radiance"])
    found = thorough(b)
    # Paths of random length under roulette: noise, but none of the bake's.
    assert found.verdict != "refuted"
    for f in found.texels.values():
        assert f.sampling is not None and f.low**2 - f.sampling**2 < 5e-3**2 and f.encoding < 1e-3
    assert found.surfaces is not None and found.surfaces.low < 5e-3


def test_a_probe_beside_an_emitter(tmp_path: Path) -> None:
    """Emitters that a probe sees directly are in both, by different estimators."""
    found = thorough(baked(tmp_path, square_emitter(2.0)))
    texels = found.texels["irradiance"]
    assert texels.low <= 0.01 and texels.bias_within is not None and abs(texels.bias) < max(texels.bias_within, 0.01)


def test_black_is_right(tmp_path: Path) -> None:
    found = thorough(baked(tmp_path, closed_box(0.5, 0.0)))
    assert found.texels["irradiance"].high == 0 and found.verdict == "confirmed"
    assert found.surfaces is not None and found.surfaces.high == 0


def test_the_bound_on_time_is_kept(box: Baked) -> None:
    """By a clock that goes on a tenth of a second at each look."""
    for seconds in (0.0, 1.0, 4.0):
        found = audit(box, seconds, threads=2, now=ticking(0.1))
        # What is made in any case: a first look of each kind, whose end is looked for a few times.
        assert found.seconds <= seconds + 2.5
        assert set(found.texels) == {"irradiance", "visibility"} and found.surfaces is not None


def test_it_is_cancelled(box: Baked) -> None:
    with pytest.raises(Cancelled):
        audit(box, 10.0, threads=2, cancelled=np.ones(1, np.uint8))


def test_nothing_to_look_at(tmp_path: Path) -> None:
    glb, spec = two_rooms()
    b = baked(tmp_path, (glb, spec), volumes=[{"origin": [50, 50, 50], "spacing": [1, 1, 1], "counts": [2, 1, 1]}], outputs=["visibility"])
    found = thorough(b)
    assert found.surfaces is None and set(found.texels) == {"visibility"}
    assert found.verdict == "unresolved"


def test_a_bake_reports_its_audit_unless_it_is_told_not_to(tmp_path: Path, box: Baked) -> None:
    glb, spec = small_cornell()
    (tmp_path / "scene.glb").write_bytes(glb)
    prepared = prepare(load_scene(tmp_path / "scene.glb"), parse_spec({**spec, "stop": {**STOP, "max_samples": 16}}))
    for seconds in (0.05, 0.0):
        run = Run(2, 1, seconds=1.0)
        state = gather(prepared, run, Clock(prepared.spec, None))
        finish(prepared, state, run, tmp_path / "out", audit_seconds=seconds)
        report = read_report(tmp_path / "out")
        page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
        assert report is not None
        if seconds:
            assert report["audit"]["texels"]["irradiance"]["places"] > 0 and "answers at surfaces" in page
        else:
            assert report["audit"] is None and "<h2>Audit</h2><p>None.</p>" in page
    # It is measured in time, so nothing of it is in the manifest.
    assert "audit" not in read_bundle(tmp_path / "out").manifest
