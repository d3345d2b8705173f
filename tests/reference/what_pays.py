"""What smaller maps and fewer bounces would cost and save on the shared scenes: ``python -m tests.reference.what_pays``.

The tables in docs/method.md that say why a bake leaves out neither.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import PILOT_SAMPLES, Allocation
from bake_core.bake import empty_state
from bake_core.environment import beside
from bake_core.octahedral import dir_to_oct, with_border
from bake_core.prepared import prepare
from bake_core.scene_files import load_scene
from bake_core.shards import trace_shard
from bake_core.spec import load_spec
from bake_core.tally import State

SHARED = Path(__file__).parents[3] / "shared"
SCENES = ("rtxgi_cornell", "rtxgi_two_rooms", "godot_zdm2", "atrium")
_PROBES, _DIRECTIONS, _FINEST = 64, 2000, 16


def traced(scene: str, **changes: Any) -> State:
    """Probes spread evenly through a shared scene's bake, after a pilot's samples; the same random numbers for any resolution."""
    path = SHARED / "specs" / f"{scene}.json"
    spec = load_spec(path).model_copy(update={"integrator": "path", **changes})
    prepared = prepare(load_scene(SHARED / "scenes" / f"{scene}.glb"), spec, beside(path.parent))
    chosen = np.unique(np.linspace(0, prepared.probe_count - 1, _PROBES).astype(int))
    positions, limits, units = (a[chosen] for a in (prepared.positions, prepared.limits, prepared.units))
    few = replace(prepared, positions=positions, limits=limits, units=units)
    state = empty_state(few)
    state.add([trace_shard(few, (0, len(chosen)), (0, PILOT_SAMPLES), Allocation.start(len(chosen)), threads=2)])
    return state


def looked_up(state: State, side: int, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(active probes, directions, 3): maps read as a bilinear sampler does."""
    maps = np.asarray(np.maximum(state.mean(), 0).reshape(-1, side, side, 3)[state.active()], np.float32)
    texels = with_border(maps).astype(np.float64)
    place = (dir_to_oct(directions.astype(np.float32)) * 0.5 + 0.5) * side + 0.5
    first = np.clip(np.floor(place).astype(int), 0, side)
    (x, y), (u, v) = first.T, (place - first).T[..., None]
    upper = texels[:, y, x] * (1 - u) + texels[:, y, x + 1] * u
    lower = texels[:, y + 1, x] * (1 - u) + texels[:, y + 1, x + 1] * u
    out: NDArray[np.float64] = upper * (1 - v) + lower * v
    return out


def main() -> None:
    """Print both tables."""
    directions = np.random.default_rng(1).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    print("relative RMS against 16×16 maps, DESIGN's metric, by side of irradiance maps")
    for scene in SCENES:
        resolution = load_spec(SHARED / "specs" / f"{scene}.json").resolution
        maps = {
            n: looked_up(traced(scene, resolution=resolution.model_copy(update={"irradiance": n})), n, directions)
            for n in (4, 6, 8, _FINEST)
        }
        truth = maps.pop(_FINEST)
        square = (truth**2).sum(-1)
        floor = (0.05 * np.sqrt(square).mean()) ** 2
        print(scene, *(f"{n}: {np.sqrt((((m - truth) ** 2).sum(-1) / (square + floor)).mean()):.1%}" for n, m in maps.items()))
    print("rays, and mean irradiance, of at most k bounces, as parts of those of unbounded ones")
    for scene in SCENES:
        whole = traced(scene, max_bounces=None)
        cut = {k: traced(scene, max_bounces=k) for k in (4, 8, 16, 32)}
        mean = whole.mean()[whole.active()].mean()
        print(scene, *(f"{k}: {s.rays / whole.rays:.2%} {s.mean()[s.active()].mean() / mean:.3%}" for k, s in cut.items()))


if __name__ == "__main__":
    main()
