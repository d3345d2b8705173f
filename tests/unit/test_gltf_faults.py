"""Every fault of the corpus is refused with its slug and its place, from a folder and from an upload, without a warning."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from bake_core.errors import SceneError
from bake_core.scene_files import load_scene, load_scene_files
from tests.faults.corpus import corpus
from tests.faults.fault import Fault, changed

FAULTS = corpus()


def test_names_are_unique_and_the_sound_scene_is_sound(tmp_path: Path) -> None:
    assert len({f.name for f in FAULTS}) == len(FAULTS)
    scene = tmp_path / "scene.glb"
    scene.write_bytes(changed())
    assert load_scene(scene).triangle_count == 4


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name[:60])
def test_fault_is_refused_by_name(fault: Fault, tmp_path: Path) -> None:
    path = fault.write(tmp_path)
    began = time.perf_counter()
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert (caught.value.slug, caught.value.where) == (fault.slug, fault.where)
    assert caught.value.message and "\n" not in str(caught.value)
    # No large allocation, no hang: a refusal is quick, even on a busy machine.
    assert time.perf_counter() - began < 5
    if not fault.needs_file_system:
        with pytest.raises(SceneError) as uploaded:
            load_scene_files(fault.root, {name: tmp_path / name for name in fault.files})
        assert (uploaded.value.slug, uploaded.value.where) == (fault.slug, fault.where)
