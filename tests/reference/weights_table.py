"""The tables of docs/leaks.md: `python -m tests.reference.weights_table [SCENE...]`, and with `--leaks` what gets through a wall of 2 cm.

A scene is an example's name, or that of a file in `../shared/scenes` that has its spec in `../shared/specs`. Each is baked with the same
samples as ours is stored by default, again with its probes on their lattice, with its visibility's resolution left open, and with RTXGI's
resolutions, of which moments are kept in full floats here, where RTXGI rounds them. All are asked for irradiance at the receivers of
`octobake verify`, RTXGI's with each of 5 × 5 biases; and at as many points in the open, about random directions. `--page docs/leaks.md`
puts the rows of the scenes named into the page, and leaves the others'.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bake_core import published_weights
from bake_core.examples import two_rooms
from bake_core.irradiance import sample
from bake_core.leaks import leak_ratio
from bake_core.prepared import prepare
from bake_core.receiver_comparison import ReceiverFigures, compare_receivers, measure_receivers
from bake_core.receiver_irradiance import irradiance_at
from bake_core.scene import Scene
from bake_core.scene_files import load_scene
from bake_core.spec import parse_spec
from bake_core.tracer import Tracer
from tests.reference.baked_scenes import F64, THREADS, Ask, Volumes, bake_at, bytes_of, files_of, markdown, ours, publish

SCENES = ("two_rooms", "tunnel", "cornell", "rtxgi_cornell", "rtxgi_two_rooms", "godot_zdm2")
# Parts of the smallest spacing: each of RTXGI's two, from none that matters to beyond what a cell can bear.
BIASES = (0.01, 0.05, 0.1, 0.2, 0.3)
# RTXGI's: 6 texels of 4 bytes, 14 of 4 and borders, and 8 bytes of the probe's own; in all 1,288.
RTXGI = {"resolution": {"irradiance": 6, "visibility": 14}, "probes": "lattice"}
RTXGI_BYTES = 1288
# Of the probe table.
PROBE_BYTES = 16
# From each point in the open, where no small dark place decides.
OPEN_PATHS = 1024


class Row(NamedTuple):
    """Error at receivers, bytes a probe, relMSE in the open."""

    on: ReceiverFigures
    size: int
    open: float


def with_parameters(volumes: Volumes, bias: float, fade: float) -> Volumes:
    changed = {"normal_bias": bias, "visibility_softness": fade}
    return tuple(replace(v, parameters={**v.parameters, **changed}) for v in volumes)


def grazing(volumes: Volumes) -> Ask:
    """As a renderer asks: from a viewer who looks along the surface, at 80° to its normal."""

    def ask(positions: F64, normals: F64) -> F64:
        across = np.roll(np.eye(3), 1, 0)[np.abs(normals).argmax(-1)]
        wo = np.cos(np.radians(80)) * normals + np.sin(np.radians(80)) * across
        return sample(volumes, positions, normals, wo).irradiance

    return ask


def ddgi(volumes: Volumes, biases: tuple[float, float]) -> Ask:
    return lambda positions, normals: published_weights.ddgi(volumes, positions, normals, biases)


def in_the_open(scene: Scene, tracer: Tracer, volumes: Volumes, count: int, paths: int) -> tuple[F64, F64, F64]:
    """Points (n, 3) anywhere in the first volume's box, directions (n, 3), and four estimates of irradiance (4, n, 3).

    Points that no light reaches are left out: they are inside solids.
    """
    random = np.random.default_rng(0)
    volume = volumes[0]
    points = volume.origin + random.random((count, 3)) * (volume.counts - 1) * volume.spacing
    about = random.normal(size=(count, 3))
    about /= np.linalg.norm(about, axis=1, keepdims=True)
    stands = np.concatenate([points - scene.origin, about, about, np.zeros((count, 1))], 1)
    estimates = irradiance_at(tracer, stands, samples=paths // 4, scrambles=4, seed=0, threads=THREADS)
    reached = estimates.any((0, 2))
    return points[reached], about[reached], estimates[:, reached]


def compare(name: str, samples: int, paths: int) -> str:
    """A scene's section: what each way to store and to weigh costs, and how far it is from the truth."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        scene_path, document = files_of(name, folder)
        mine = bake_at(scene_path, document, {}, samples, folder)
        still = bake_at(scene_path, document, {"probes": "lattice"}, samples, folder)
        spare = bake_at(scene_path, document, {"resolution": {"visibility": None}}, samples, folder)
        theirs = bake_at(scene_path, document, RTXGI, samples, folder)
        scene = load_scene(scene_path)
        tracer = prepare(scene, parse_spec(document)).tracer
        receivers, answers, estimates = measure_receivers(scene, tracer, mine, samples=paths, threads=THREADS)
        points, about, arrives = in_the_open(scene, tracer, mine, len(receivers), min(paths, OPEN_PATHS))

    def figures(ask: Ask) -> ReceiverFigures:
        return compare_receivers(ask(receivers.positions, receivers.normals), estimates)

    def row(ask: Ask, size: int) -> Row:
        return Row(figures(ask), size, compare_receivers(ask(points, about), arrives).relmse or 0)

    swept = {pair: figures(ddgi(theirs, pair)) for pair in itertools.product(BIASES, BIASES)}
    best = min(swept, key=lambda pair: swept[pair].relmse or 0)
    own = compare_receivers(answers, estimates)
    rows = {
        "trilinear": row(lambda p, n: published_weights.trilinear(theirs, p, n), RTXGI_BYTES),
        "DDGI, published biases": row(ddgi(theirs, published_weights.DDGI_BIASES), RTXGI_BYTES),
        f"DDGI, best of 25: {best[0]:g}, {best[1]:g}": row(ddgi(theirs, best), RTXGI_BYTES),
        "octobake": row(ours(mine), held(mine)),
        "octobake, probes on their lattice": row(ours(still), held(still)),
        f"octobake, walls of {spare[0].atlases['walls'].interior}²": row(ours(spare), held(spare)),
    }
    others = [figures(ours(with_parameters(mine, bias, fade))).relmse or 0 for bias in (0.1, 0.15, 0.2) for fade in (0.01, 0.02, 0.05)]
    least = swept[best].relmse or 0
    cells = [
        (
            way,
            f"{r.size}",
            f"{r.on.relmse:.4f}",
            f"{r.on.p95:.3f}",
            f"{r.on.mean_ratio:.3f}",
            f"{least / (r.on.relmse or 1):.2f}",
            f"{r.open:.4f}",
        )
        for way, r in rows.items()
    ]
    return (
        f"`{name}`: {len(receivers)} receivers; relMSE of the reference's own noise {own.reference_noise:.1g}, of octobake with biases "
        f"from 0.1 to 0.2 and fades from 1 % to 5 % {min(others):.4f} to {max(others):.4f}\n\n"
        + markdown(("", "bytes a probe", "relMSE", "95th percentile", "mean ratio", "best of 25 over it", "relMSE in the open"), cells)
    )


def held(volumes: Volumes) -> int:
    return PROBE_BYTES + sum(bytes_of(volumes, name) for name in ("irradiance", "walls"))


def leaks() -> str:
    """The leak ratio by scale, resolution and way to ask."""
    rows = []
    for scale, side in ((1.0, 16), (1.0, 14), (1.0, 12), (1.0, 10), (1.0, 8), (1e-3, 16), (1e4, 16)):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            glb, document = two_rooms(scale=scale)
            (folder / "scene.glb").write_bytes(glb)
            maps = {"resolution": {"visibility": side}}
            volumes = bake_at(folder / "scene.glb", document, maps, 16, folder)
            theirs = bake_at(folder / "scene.glb", document, {**maps, "probes": "lattice"}, 16, folder)
        ways = [
            leak_ratio(lambda p, n, v=theirs: published_weights.trilinear(v, p, n), scale),  # type: ignore[misc]
            leak_ratio(ddgi(theirs, published_weights.DDGI_BIASES), scale),
            min(leak_ratio(ddgi(theirs, pair), scale) for pair in itertools.product(BIASES, BIASES)),
            leak_ratio(ours(volumes), scale),
            leak_ratio(grazing(volumes), scale),
        ]
        rows.append((f"{scale:g}", f"{side}²", *(f"{100 * way:.3f} %" for way in ways)))
    return markdown(("scale", "maps", "trilinear", "DDGI", "best of 25", "octobake", "seen along"), rows)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--paths", type=int, default=1024, help="from each receiver")
    parser.add_argument("--leaks", action="store_true")
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    if arguments.leaks:
        publish(arguments.page, "leaks", leaks())
        return
    for name in arguments.scenes:
        publish(arguments.page, name, compare(name, arguments.samples, arguments.paths))


if __name__ == "__main__":
    main()
