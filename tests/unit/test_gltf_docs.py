"""docs/scenes.md names every slug that the readers know, and no slug that they do not; its tables are what the code says."""

from __future__ import annotations

import re
from pathlib import Path

from bake_core.scene_coverage import insert
from tests.faults.corpus import corpus

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")

# A mesh of more than 2^28 triangles has no place in a test.
TOO_LARGE_TO_MAKE = {"scene.mesh_too_large"}
# Sound files, whose light the baker refuses: tests/unit/test_endless.py.
NOT_THE_READERS = {"scene.reader_timeout", "scene.reader_memory", "scene.reader_crashed", "scene.light_never_ends"}


def test_every_slug_is_documented_and_has_a_fault() -> None:
    sources = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "bake_core" / "gltf").glob("*.py"))
    slugs = {f"gltf.{s}" for s in re.findall(r'fail\(\s*"([a-z_]+)"', sources)}
    slugs |= {f"gltf.{s}" for s in re.findall(r'\("(unsupported_[a-z_]+)"', sources)}
    slugs |= {"gltf.json_too_deep", "gltf.duplicate_key", "gltf.bad_image"}
    more = "".join((ROOT / "bake_core" / name).read_text(encoding="utf-8") for name in ("zip_files.py", "mesh_files.py"))
    slugs |= set(re.findall(r'"(scene\.[a-z_]+)"', more))
    assert set(re.findall(r"`((?:gltf|scene)\.[a-z_]+)`", PAGE)) == slugs | NOT_THE_READERS
    assert {f.slug for f in corpus()} == slugs - TOO_LARGE_TO_MAKE


def test_tables_are_generated_from_the_code() -> None:
    assert insert(PAGE) == PAGE, "run: python -m bake_core.scene_coverage"
