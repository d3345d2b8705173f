"""Baking an example for a test."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.atlas import Layout, unpack
from bake_core.bake import bake
from bake_core.bundle import Bundle, read_bundle
from bake_core.environment import beside
from bake_core.examples import Example
from bake_core.spec import parse_spec

THREADS = os.cpu_count() or 1


def bake_example(folder: Path, example: Example, *, threads: int = THREADS, shards: int = 1, **changes: Any) -> Bundle:
    """Bake an example with some of its spec's keys changed; the bundle as read back from disk. Images lie in the folder."""
    glb, spec = example
    scene = folder / "scene.glb"
    scene.write_bytes(glb)
    bake(scene, parse_spec({**spec, **changes}), folder / "bundle", threads=threads, shards=shards, find=beside(folder))
    return read_bundle(folder / "bundle")


def maps(bundle: Bundle, output: str = "irradiance", volume: int = 0) -> NDArray[np.float64]:
    """Every probe's map without borders, (n, t, t, channels)."""
    v = bundle.volumes[volume]
    a = v.atlases[output]
    return unpack(a.texels, Layout(a.columns, a.rows, a.layers), len(v.states)).astype(np.float64)
