"""Baking an example for a test, or the first steps of it."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

from bake_core.bake import bake, empty_state
from bake_core.bundle import Bundle, read_bundle
from bake_core.environment import beside
from bake_core.examples import Example
from bake_core.prepared import Prepared, prepare
from bake_core.shards import shard_ranges, trace_shard
from bake_core.spec import parse_spec
from bake_core.stability.case import maps
from bake_core.tally import State
from tests.scenes import load_example

__all__ = ["THREADS", "bake_example", "maps", "prepared", "traced"]

THREADS = os.cpu_count() or 1


def bake_example(folder: Path, example: Example, *, threads: int = THREADS, shards: int = 1, **changes: Any) -> Bundle:
    """Bake an example with some of its spec's keys changed; the bundle as read back from disk. Images lie in the folder."""
    glb, spec = example
    scene = folder / "scene.glb"
    scene.write_bytes(glb)
    bake(scene, parse_spec({**spec, **changes}), folder / "bundle", threads=threads, shards=shards, find=beside(folder))
    return read_bundle(folder / "bundle")


def prepared(example: Example, **changes: Any) -> Prepared:
    """An example with some of its spec's keys changed."""
    glb, spec = example
    return prepare(load_example(glb), parse_spec({**spec, **changes}), threads=2)


def traced(p: Prepared, ends: tuple[int, ...] = (16, 32), shards: int = 1, threads: int = 2) -> State:
    """Whole passes, up to each of these samples."""
    state = empty_state(p)
    for samples in pairwise((0, *ends)):
        given = state.allocation
        state.add([trace_shard(p, r, samples, given, threads=threads) for r in shard_ranges(p.probe_count, shards)])
    return state
