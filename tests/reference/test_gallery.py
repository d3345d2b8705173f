"""Every shared scene, baked with its spec and held to the limits of its page, in small: fewer samples, smaller pictures."""

from __future__ import annotations

from pathlib import Path

import pytest

from bake_core.bake import bake
from bake_core.bundle import read_bundle
from bake_core.cameras import load_cameras
from bake_core.scene_files import load_scene
from bake_core.spec import load_spec, parse_spec
from bake_core.thresholds import load_thresholds
from bake_core.verification import verify
from tests.baking import THREADS
from tests.reference import gallery
from tests.reference.gallery import OWN, PAGE, SCENES

# Where the noise of fewer would be half of the limits: light that comes in through a door, or through narrow streets.
SAMPLES = {"rtxgi_two_rooms": 16, "godot_zdm2": 64}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_a_shared_scene_keeps_its_limits(shared: Path, name: str, tmp_path: Path) -> None:
    scene = shared / "scenes" / f"{name}.glb"
    spec = load_spec(shared / "specs" / f"{name}.json").canonical()
    stop = {"target_error": None, "max_samples": SAMPLES.get(name, 32)}
    bake(scene, parse_spec({**spec, "stop": stop}), tmp_path / "bundle", threads=THREADS)
    cameras, limits = OWN / f"{name}.cameras.json", OWN / f"{name}.thresholds.json"
    report = verify(
        read_bundle(tmp_path / "bundle"),
        load_scene(scene),
        load_cameras(cameras) if cameras.is_file() else None,
        tmp_path / "out",
        width=192,
        height=108,
        # As many as the page has where that has few: with fewer yet, some paths that find the sun would decide about dark streets.
        samples=gallery.SAMPLES.get(name, 32),
        threads=THREADS,
        thresholds=load_thresholds(limits) if limits.is_file() else None,
    )
    assert report["failures"] == []


def test_the_page_shows_every_scene() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [n for n in SCENES if f"\n## {n}\n" not in text] == []
    assert "verification failed" not in text
