"""docs/scenes.md names every slug and every extension that the reader knows, and no slug that it does not."""

from __future__ import annotations

import re
from pathlib import Path

from bake_core.gltf import extensions
from tests.faults.corpus import corpus

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")


def test_every_slug_is_documented_and_has_a_fault() -> None:
    sources = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "bake_core" / "gltf").glob("*.py"))
    slugs = {f"gltf.{s}" for s in re.findall(r'fail\(\s*"([a-z_]+)"', sources)}
    slugs |= {f"gltf.{s}" for s in re.findall(r'\("(unsupported_[a-z_]+)"', sources)}
    slugs |= {"gltf.json_too_deep", "gltf.duplicate_key"}
    assert set(re.findall(r"`(gltf\.[a-z_]+)`", PAGE)) == slugs
    assert {f.slug for f in corpus()} == slugs


def test_every_extension_is_documented() -> None:
    assert all(f"`{name}`" in PAGE for name in (*extensions.READ, *extensions.REFUSED))
