"""The tables of docs/leaks.md: `python tests/reference/weights_table.py [SCENE...]`, and with `--leaks` what gets through a wall of 2 cm.

A scene is an example's name, or that of a file in `../shared/scenes` that has its spec in `../shared/specs`. Each is baked with the same
samples as ours is stored by default, again with its probes relocated, and with RTXGI's resolutions, of which moments are kept in full
floats here, where RTXGI rounds them. All are asked for irradiance at the receivers of `octobake verify`, RTXGI's with each of 5 × 5 biases.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from numpy.typing import NDArray

from bake_core import published_weights
from bake_core.bake import bake
from bake_core.bundle import VolumeData, read_bundle
from bake_core.examples import Example, cornell, tunnel, two_rooms
from bake_core.irradiance import sample
from bake_core.leaks import leak_ratio
from bake_core.prepared import prepare
from bake_core.receiver_comparison import ReceiverFigures, compare_receivers, measure_receivers
from bake_core.scene_files import load_scene
from bake_core.spec import parse_spec

F64 = NDArray[np.float64]
Volumes = tuple[VolumeData, ...]

SHARED = Path(__file__).resolve().parents[3] / "shared"
EXAMPLES: dict[str, Callable[[], Example]] = {"cornell": cornell, "two_rooms": two_rooms, "tunnel": tunnel}
# Parts of the smallest spacing: each of RTXGI's two, from none that matters to beyond what a cell can bear.
BIASES = (0.01, 0.05, 0.1, 0.2, 0.3)
THREADS = os.cpu_count() or 1
# RTXGI's: 6 texels of 4 bytes, 14 of 4 and borders, and 8 bytes of the probe's own; in all 1,288.
RTXGI = {"irradiance": 6, "visibility": 14}
# From each receiver.
PATHS = 1024


def bytes_of(volumes: Volumes) -> int:
    """What a renderer holds for a probe: irradiance and walls with their borders, and its row of the probe table."""
    sizes = {"half": 2, "float": 4}
    held = [volumes[0].atlases[name] for name in ("irradiance", "walls")]
    return 16 + sum(a.tile**2 * int(a.texels.shape[-1]) * sizes[a.encoding] for a in held)


def ours(volumes: Volumes) -> Callable[[F64, F64], F64]:
    return lambda positions, normals: sample(volumes, positions, normals).irradiance


def with_parameters(volumes: Volumes, bias: float, fade: float) -> Volumes:
    changed = {"normal_bias": bias, "visibility_softness": fade}
    return tuple(replace(v, parameters={**v.parameters, **changed}) for v in volumes)


def grazing(volumes: Volumes) -> Callable[[F64, F64], F64]:
    """As a renderer asks: from a viewer who looks along the surface, at 80° to its normal."""

    def ask(positions: F64, normals: F64) -> F64:
        across = np.roll(np.eye(3), 1, 0)[np.abs(normals).argmax(-1)]
        wo = np.cos(np.radians(80)) * normals + np.sin(np.radians(80)) * across
        return sample(volumes, positions, normals, wo).irradiance

    return ask


def ddgi(volumes: Volumes, biases: tuple[float, float]) -> Callable[[F64, F64], F64]:
    return lambda positions, normals: published_weights.ddgi(volumes, positions, normals, biases)


def bake_at(scene: Path, document: dict[str, object], resolution: dict[str, int], samples: int, folder: Path) -> Volumes:
    stop = {"target_error": None, "max_samples": samples}
    spec = parse_spec({**document, "outputs": ["irradiance", "visibility"], "resolution": resolution, "stop": stop})
    bake(scene, spec, folder / "bundle", threads=THREADS, audit_seconds=0)
    return read_bundle(folder / "bundle").volumes


def files_of(name: str, folder: Path) -> tuple[Path, dict[str, object]]:
    if name in EXAMPLES:
        glb, document = EXAMPLES[name]()
        (folder / "scene.glb").write_bytes(glb)
        return folder / "scene.glb", document
    return SHARED / "scenes" / f"{name}.glb", json.loads((SHARED / "specs" / f"{name}.json").read_text())


def compare(name: str, samples: int) -> None:
    """Print a scene's rows."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        scene_path, document = files_of(name, folder)
        mine = bake_at(scene_path, document, {}, samples, folder)
        moved = bake_at(scene_path, {**document, "probes": "relocated"}, {}, samples, folder)
        theirs = bake_at(scene_path, document, RTXGI, samples, folder)
        scene = load_scene(scene_path)
        tracer = prepare(scene, parse_spec(document)).tracer
        receivers, answers, estimates = measure_receivers(scene, tracer, mine, samples=PATHS, threads=THREADS)

        def figures(ask: Callable[[F64, F64], F64]) -> ReceiverFigures:
            return compare_receivers(ask(receivers.positions, receivers.normals), estimates)

        swept = {pair: figures(ddgi(theirs, pair)) for pair in itertools.product(BIASES, BIASES)}
        best = min(swept, key=lambda pair: swept[pair].relmse or 0)
        rows = {
            "trilinear": (figures(lambda p, n: published_weights.trilinear(theirs, p, n)), 1288),
            "DDGI, published biases": (figures(ddgi(theirs, published_weights.DDGI_BIASES)), 1288),
            f"DDGI, best of 25: {best[0]:g}, {best[1]:g}": (swept[best], 1288),
            "octobake": (compare_receivers(answers, estimates), bytes_of(mine)),
            "octobake, probes relocated": (figures(ours(moved)), bytes_of(moved)),
        }
        least = swept[best].relmse or 0
        gains = [least / f.relmse for f, _ in list(rows.values())[3:] if f.relmse]
        noise = rows["octobake"][0].reference_noise
        print(f"{name}: {len(receivers)} receivers, noise {noise:.1g}; best of 25 over octobake: {', '.join(f'{g:.2f}' for g in gains)}")
        others = [figures(ours(with_parameters(mine, bias, fade))).relmse or 0 for bias in (0.1, 0.15, 0.2) for fade in (0.01, 0.02, 0.05)]
        print(f"  octobake with biases from 0.1 to 0.2 and fades from 1 % to 5 %: relMSE from {min(others):.4f} to {max(others):.4f}")
        for way, (f, size) in rows.items():
            print(
                f"  {way:32s} {size:5d} B  relMSE {f.relmse:8.4f}  95th percentile {f.p95:6.3f}  mean ratio {f.mean_ratio:6.3f}", flush=True
            )


def leaks() -> None:
    """Print the leak ratio by scale, resolution and way to ask."""
    print(f"{'scale':>6s} {'maps':>5s} {'trilinear':>10s} {'DDGI':>9s} {'best of 25':>10s} {'octobake':>10s} {'seen along':>10s}")
    for scale, side in ((1.0, 16), (1.0, 14), (1.0, 12), (1.0, 10), (1.0, 8), (1e-3, 16), (1e4, 16)):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            glb, document = two_rooms(scale=scale)
            (folder / "scene.glb").write_bytes(glb)
            volumes = bake_at(folder / "scene.glb", document, {"visibility": side}, 16, folder)
        ways = [
            leak_ratio(lambda p, n, v=volumes: published_weights.trilinear(v, p, n), scale),  # type: ignore[misc]
            leak_ratio(ddgi(volumes, published_weights.DDGI_BIASES), scale),
            min(leak_ratio(ddgi(volumes, pair), scale) for pair in itertools.product(BIASES, BIASES)),
            leak_ratio(ours(volumes), scale),
            leak_ratio(grazing(volumes), scale),
        ]
        print(f"{scale:6g} {side:4d}² " + " ".join(f"{100 * way:9.3f}%" for way in ways), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="*", default=[*EXAMPLES])
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--leaks", action="store_true")
    arguments = parser.parse_args()
    if arguments.leaks:
        leaks()
        return
    for name in arguments.scenes:
        compare(name, arguments.samples)


if __name__ == "__main__":
    main()
