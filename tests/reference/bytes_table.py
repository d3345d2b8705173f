"""What each output costs a probe and what error that buys, for docs/leaks.md: `python -m tests.reference.bytes_table --page docs/leaks.md`.

Diffuse light: irradiance and walls of some resolutions, asked at the receivers of `octobake verify`, and for :mod:`bake_core.leaks`' ratio.
RTXGI's stands below: its resolutions, DDGI's weights, each figure at the best of the 25 pairs of biases. Glossy light: distance, normal and
radiance in a closed Cornell box with mirrors, asked along the rays of `octobake verify`.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from bake_core.leaks import leak_ratio
from bake_core.light_field import arriving, light_field, trace
from bake_core.prepared import prepare
from bake_core.ray_radiance import measure_radiance
from bake_core.receiver_comparison import compare_receivers, measure_receivers
from bake_core.scene import Scene
from bake_core.scene_files import load_scene
from bake_core.spec import parse_spec
from bake_core.trace_check import compare_traces
from bake_core.tracer import Tracer
from bake_core.volume_chains import CHAINS, chain_size
from tests.reference.baked_scenes import THREADS, Ask, Volumes, bake_at, bytes_of, files_of, markdown, ours, publish
from tests.reference.weights_table import BIASES, PROBE_BYTES, RTXGI, RTXGI_BYTES, ddgi

T = TypeVar("T")

GLOSSY = "mirror_cornell"
ALL = ("irradiance", "visibility", "radiance", "distance", "normal")
IRRADIANCE, WALLS = (6, 8, 16), (8, 16)
DISTANCE, RADIANCE = (16, 32, 64, 128), (32, 64)
# Of each bake; of glossy ones as for the pictures in README.md.
SAMPLES = {"diffuse": 64, "glossy": 24}
# From each receiver and along each ray.
PATHS = 1024


def with_baked(
    name: str, variants: list[dict[str, Any]], samples: int, outputs: tuple[str, ...], look: Callable[[Scene, Tracer, list[Volumes]], T]
) -> T:
    """What `look` makes of a scene's bakes, one for each variant of the spec."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        path, document = files_of(name, folder)
        bakes = [bake_at(path, document, variant, samples, folder, outputs) for variant in variants]
        scene = load_scene(path)
        return look(scene, prepare(scene, parse_spec(document)).tracer, bakes)


def chain_bytes(volumes: Volumes, chain: str) -> int:
    """Of a probe's tile of a chain, which is stored as its map is; "nearest" in floats."""
    width, height = chain_size(volumes[0], chain)
    half = chain == "gloss" and volumes[0].atlases["radiance"].encoding == "half"
    return width * height * CHAINS[chain] * (2 if half else 4)


def diffuse(samples: int, paths: int) -> str:
    variants = [{"resolution": {"irradiance": n, "visibility": m}} for n in IRRADIANCE for m in WALLS]

    def best(ask: Callable[[Ask], float], bakes: list[Volumes]) -> list[float]:
        """Of ours as they are; of RTXGI's, the last one, with whichever biases are best."""
        return [*(ask(ours(b)) for b in bakes[:-1]), min(ask(ddgi(bakes[-1], pair)) for pair in itertools.product(BIASES, BIASES))]

    def errors(scene: Scene, tracer: Tracer, bakes: list[Volumes]) -> list[float]:
        at, _, estimates = measure_receivers(scene, tracer, bakes[0], samples=paths, threads=THREADS)
        return best(lambda ask: compare_receivers(ask(at.positions, at.normals), estimates).relmse or 0, bakes)

    def in_rooms(scene: Scene, tracer: Tracer, bakes: list[Volumes]) -> tuple[list[float], list[float], list[list[int]]]:
        sizes = [[bytes_of(b, name) for name in ("irradiance", "walls", "visibility")] for b in bakes]
        return errors(scene, tracer, bakes), best(leak_ratio, bakes), sizes

    outputs = ("irradiance", "visibility")
    cornell = with_baked("cornell", [*variants, RTXGI], samples, outputs, errors)
    rooms, through, sizes = with_baked("two_rooms", [*variants, RTXGI], samples, outputs, in_rooms)
    stored = [(f"{e}", f"{w}", f"{m}", f"{e + w + PROBE_BYTES}") for e, w, m in sizes[:-1]] + [("256", "", "1024", f"{RTXGI_BYTES}")]
    names = [f"{v['resolution']['irradiance']}², {v['resolution']['visibility']}²" for v in variants] + ["RTXGI: 6², 14²"]
    rows = [
        (name, *held, f"{c:.4f}", f"{r:.4f}", f"{100 * leak:.3f} %")
        for name, held, c, r, leak in zip(names, stored, cornell, rooms, through, strict=True)
    ]
    heads = ("irradiance, walls", "irradiance", "walls", "moments", "read in all", "relMSE, cornell", "relMSE, two_rooms", "leak ratio")
    return markdown(heads, rows)


def glossy(samples: int, paths: int) -> str:
    sides = [(n, 16) for n in DISTANCE] + [(64, r) for r in RADIANCE]
    variants = [{"resolution": {"distance": n, "normal": n, "radiance": r}} for n, r in sides]

    def look(scene: Scene, tracer: Tracer, bakes: list[Volumes]) -> str:
        rays, _, _, estimates = measure_radiance(scene, tracer, bakes[0], samples=paths, threads=THREADS)
        rows = []
        for (distance, radiance), volumes in zip(sides, bakes, strict=True):
            traces = trace(light_field(volumes), rays.origins, rays.directions)
            told = compare_traces(volumes, rays, traces)
            light = compare_receivers(arriving(volumes, traces, rays.origins, rays.directions, 0.0), estimates)
            stored = [bytes_of(volumes, name) for name in ("distance", "normal", "radiance")] + [
                chain_bytes(volumes, chain) for chain in CHAINS
            ]
            figures = (f"{100 * told.agree:.2f} %", f"{100 * told.false_hits:.2f} %", f"{light.relmse:.4f}", f"{light.p95:.3f}")
            rows.append((f"{distance}², {radiance}²", *map(str, stored), str(sum(stored)), *figures))
        heads = ("distance and normal, radiance", "distance", "normal", "radiance", *CHAINS, "in all")
        return markdown((*heads, "agree", "false hits", "relMSE", "95th percentile"), rows)

    return with_baked(GLOSSY, variants, samples, ALL, look)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("kinds", nargs="*", default=["diffuse", "glossy"])
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    for kind in arguments.kinds:
        publish(arguments.page, f"bytes: {kind}", {"diffuse": diffuse, "glossy": glossy}[kind](SAMPLES[kind], PATHS))


if __name__ == "__main__":
    main()
