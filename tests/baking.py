"""Baking an example for a test."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from bake_core.bake import bake
from bake_core.bundle import Bundle, read_bundle
from bake_core.environment import beside
from bake_core.examples import Example
from bake_core.spec import parse_spec
from bake_core.stability.case import maps

__all__ = ["THREADS", "bake_example", "maps"]

THREADS = os.cpu_count() or 1


def bake_example(folder: Path, example: Example, *, threads: int = THREADS, shards: int = 1, **changes: Any) -> Bundle:
    """Bake an example with some of its spec's keys changed; the bundle as read back from disk. Images lie in the folder."""
    glb, spec = example
    scene = folder / "scene.glb"
    scene.write_bytes(glb)
    bake(scene, parse_spec({**spec, **changes}), folder / "bundle", threads=threads, shards=shards, find=beside(folder))
    return read_bundle(folder / "bundle")
