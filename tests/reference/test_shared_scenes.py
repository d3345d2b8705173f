"""Scenes from elsewhere, which lie beside a checkout and are no part of it; their answers are known without a reference picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.bake import bake
from bake_core.bundle import Bundle, read_bundle
from bake_core.spec import load_spec, parse_spec
from tests.baking import THREADS, maps

Array = NDArray[Any]


def baked(shared: Path, folder: Path, name: str, **changes: Any) -> Bundle:
    """A scene with its spec, some of whose keys are changed."""
    spec = parse_spec({**load_spec(shared / "specs" / f"{name}.json").canonical(), **changes})
    bake(shared / "scenes" / f"{name}.glb", spec, folder / name, threads=THREADS)
    return read_bundle(folder / name)


def test_rtxgi_furnace(shared: Path, tmp_path: Path) -> None:
    """A white slab under a white sky: radiance is 1 in every direction, irradiance π at every probe, those below the slab included."""
    bundle = baked(shared, tmp_path, "rtxgi_furnace")
    texels = maps(bundle)
    assert len(texels) == 192
    np.testing.assert_allclose(texels.mean((1, 2, 3)), math.pi, rtol=2e-3)
    np.testing.assert_allclose(texels, math.pi, rtol=2e-3)
    assert bundle.volumes[0].states.all()


@pytest.mark.slow
def test_rtxgi_two_rooms(shared: Path, tmp_path: Path) -> None:
    """The closed room is exactly dark, the open one is lit through its door, and probes under the ground see back faces."""
    bundle = baked(shared, tmp_path, "rtxgi_two_rooms", stop={"target_error": None, "max_samples": 4})
    volume = bundle.volumes[0]
    texels, tiles, backface = maps(bundle), volume.tiles, volume.backface
    x, y, z = volume.positions().T
    tall = (x > -96) & (x < 96) & (y > 0) & (y < 46)
    closed, opened, below = tall & (z > -96) & (z < -2), tall & (z > 2) & (z < 96), y < 0
    assert closed.sum() > 200 and opened.sum() > 200 and below.sum() > 500
    assert not texels[tiles[closed]].any()
    assert (texels[tiles[opened]].mean((1, 2, 3)) > 0).all()
    assert (backface[below] > 0.25).all() and not volume.states[below].any()
    assert volume.states[closed | opened].all()


@pytest.mark.slow
def test_rtxgi_cornell(shared: Path, tmp_path: Path) -> None:
    """Lit through its open front by the sun alone: more light in than out is impossible, and the coloured walls colour."""
    bundle = baked(shared, tmp_path, "rtxgi_cornell", stop={"target_error": 0.05, "max_samples": 64})
    texels = maps(bundle)
    assert np.isfinite(texels).all() and (texels >= 0).all()
    # The sun's irradiance is 1 on a plane facing it: no surface reflects a radiance of more than 1/π, nor 20 bounces more than a few.
    assert 0 < texels.max() < math.pi
    assert bundle.manifest["error"]["value"] < 0.15
