"""Radiance of probes against Mitsuba 3's: the same scenes, probes, octahedral texels and numbers of bounces, by someone else's code.

The pictures are handed out in shared/peers: two runs each of 8,192 samples in every texel of 64 probes.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core.allocation import uniform
from bake_core.capture import Capture, capture_radiance
from bake_core.gltf.reader import load_scene
from bake_core.prepared import prepare
from bake_core.spec import parse_spec
from tests.baking import THREADS

F64 = NDArray[np.float64]
# Independent bakes, whose spread is our own noise, and samples in a texel of each.
SEEDS, SAMPLES = 8, 256


@contextmanager
def _scenes(peers: Path, folder: Path) -> Iterator[ModuleType]:
    """The peers' scene generator, told to write to a folder."""
    spec = importlib.util.spec_from_file_location("peer_scenes", peers / "scenes.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    before = os.environ.get("PEER_SCENES")
    os.environ["PEER_SCENES"] = str(folder)
    try:
        spec.loader.exec_module(module)
        yield module
    finally:
        os.environ.pop("PEER_SCENES")
        if before is not None:
            os.environ["PEER_SCENES"] = before


def bake(peers: Path, folder: Path, name: str, samples: int, chosen: NDArray[np.int64]) -> F64:
    """Radiance of some of the 512 probes, (SEEDS, n, 16, 16, 3)."""
    with _scenes(peers, folder) as scenes:
        groups, extras = getattr(scenes, name)()
        scenes.write_glb(str(folder / f"{name}.glb"), groups, extras)
    low, high = np.array(extras["grid_min"]), np.array(extras["grid_max"])
    spacing = (high - low) / 8
    sun = [{"kind": "directional", "direction": extras["sun_dir"], "irradiance": extras["sun_irradiance"]}]
    document = {
        "volumes": [{"origin": (low + spacing / 2).tolist(), "spacing": spacing.tolist(), "counts": [8, 8, 8]}],
        "environment": {"kind": "constant", "radiance": extras["sky"]},
        "lights": sun if any(extras["sun_irradiance"]) else [],
        "outputs": ["radiance"],
        "resolution": {"radiance": 16},
        "max_bounces": 4,
    }
    prepared = prepare(load_scene(folder / f"{name}.glb"), parse_spec(document))
    flag = np.zeros(1, np.uint8)
    out = np.empty((SEEDS, len(chosen), 16, 16, 3))
    for seed in range(SEEDS):
        _, radiance, _ = capture_radiance(
            prepared.tracer,
            np.ascontiguousarray(prepared.positions[chosen]),
            chosen.astype(np.uint64),
            uniform(len(chosen), (0, samples)),
            Capture(16, 8, seed, True),
            threads=THREADS,
            cancelled=flag,
            advance=lambda _: None,
        )
        out[seed] = radiance.sum(1).reshape(out.shape[1:]) / samples
    return out


def references(peers: Path, name: str) -> F64:
    """Both runs, (2, 64, 16, 16, 3)."""
    runs = []
    for run in "AB":
        with np.load(peers / "refs" / f"{name}_oct_{run}.npz") as f:
            runs.append(f["spp8192"].astype(np.float64))
    return np.stack(runs)


@pytest.fixture
def peers(shared: Path) -> Path:
    if not (shared / "peers" / "scenes.py").is_file():
        pytest.skip("no peers/ in the shared folder: Mitsuba's pictures are not ours to ship")
    return shared / "peers"


def z_scores(ours: F64, theirs: F64) -> F64:
    """Per texel and channel, ours against the mean of theirs, over what noise both are estimated to have, (64, 16, 16, 3)."""
    own = ours.var(0, ddof=1) / len(ours)
    half = (theirs[0] - theirs[1]) ** 2 / 4
    # Two runs tell a texel's noise badly; it is taken to be spread over texels like ours, unless it is seen to be more.
    reference = np.maximum(own * (half.sum() / own.sum()), half)
    # A sliver of light that none of our samples met has no variance either: one sample in all of them may have been unlucky. (A probe
    # inside a box sees nothing at all.)
    brightest = np.maximum(theirs.max(axis=(0, 2, 3), keepdims=True)[0], 1e-6)
    sliver = (brightest / (16 * len(ours) * SAMPLES)) ** 2
    scores: F64 = (ours.mean(0) - theirs.mean(0)) / np.sqrt(own + reference + sliver)
    return scores


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell", "atrium"])
def test_radiance_agrees_within_noise(peers: Path, tmp_path: Path, name: str) -> None:
    chosen = np.sort(np.random.default_rng(1).choice(512, 64, replace=False))
    ours, theirs = bake(peers, tmp_path, name, SAMPLES, chosen), references(peers, name)
    z = z_scores(ours, theirs)
    middle = np.sort(np.abs(z), axis=None)[: int(0.99 * z.size)]
    spread = float(np.sqrt((middle**2).mean()))
    difference = (ours.mean(0) - theirs.mean(0)) / theirs.mean()
    by_probe, by_direction = (float(np.abs(difference.mean(axes)).max()) for axes in ((1, 2, 3), (0, 3)))
    report = (
        f"{name}: Z without its largest 1 % has rms {spread:.3f}, {(np.abs(z) > 4).mean():.2%} of texels are beyond 4, "
        f"means differ by {difference.mean():+.3%}, one probe's by {by_probe:.2%}, one direction's by {by_direction:.2%}"
    )
    print(report)
    # A normal distribution without its largest 1 % has 0.96; with 7 degrees of freedom in the noise, 1.06.
    assert 0.85 < spread < 1.15, report
    assert (np.abs(z) > 4).mean() < 0.01, report
    assert abs(difference.mean()) < 1e-3, report
    assert by_probe < 0.01 and by_direction < 0.02, report


def test_truncated_furnace(peers: Path, tmp_path: Path) -> None:
    """Le (1 + a + … + a⁴) = 0.9 · 1.9375 in every texel."""
    radiance = bake(peers, tmp_path, "furnace", 16, np.arange(0, 512, 37))
    assert radiance.mean() == pytest.approx(1.74375, rel=1e-3)
