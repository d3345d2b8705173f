"""Emitters drawn by a tree against emitters drawn by power alone: ``python -m tests.reference.light_tree_table``.

The table in docs/method.md.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from bake_core.allocation import Allocation
from bake_core.bake import empty_state
from bake_core.examples import Example, lamp_corridor, many_lamps
from bake_core.prepared import Prepared, prepare
from bake_core.scene_files import load_scene
from bake_core.shards import trace_shard
from bake_core.spec import parse_spec
from bake_core.tally import State

# Of a room of 2 m, in the place of the one probe that its own spec has.
_IN_ROOM = {"name": "room", "origin": [-0.6, 0.4, -0.6], "spacing": [0.4, 0.4, 0.4], "counts": [4, 4, 4]}
SCENES: dict[str, Callable[[int], Example]] = {"corridor, a lamp each 2 m": lamp_corridor, "room, lamps all over its ceiling": many_lamps}


class Race(NamedTuple):
    """What came of both ways.

    `variances`: by power over by the tree, of irradiance, relative. `seconds`: CPU's, by the tree over by power. `difference`: of means,
    in its standard errors.
    """

    variances: float
    seconds: float
    difference: float


def race(example: Example, samples: int) -> Race:
    """Both ways, path-traced, the same numbers."""
    glb, document = example
    volumes = [_IN_ROOM] if document["volumes"][0]["counts"] == [1, 1, 1] else document["volumes"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.glb"
        path.write_bytes(glb)
        tree = prepare(load_scene(path), parse_spec({**document, "volumes": volumes, "integrator": "path"}), threads=2)
    power = tree.traced_with(replace(tree.tracer, tables=tree.tracer.tables._replace(tree=None)))
    (a, a_seconds), (b, b_seconds) = (_traced(p, samples) for p in (tree, power))
    # Of each probe's mean over all directions; probes' errors are independent.
    off = (a.mean() - b.mean()).mean((1, 2))
    return Race(_relative(b) / _relative(a), a_seconds / b_seconds, float(off.mean() / (off.std(ddof=1) / len(off) ** 0.5)))


def _traced(prepared: Prepared, samples: int) -> tuple[State, float]:
    # Compiles, by tracing nothing.
    trace_shard(prepared, (0, 0), (0, 0), Allocation.start(0), threads=1)
    state, began = empty_state(prepared), time.process_time()
    for part in pairwise((0, samples // 2, samples)):
        state.add([trace_shard(prepared, (0, prepared.probe_count), part, state.allocation, threads=2)])
    return state, time.process_time() - began


def _relative(state: State) -> float:
    spread: Any = state.spread()
    return float((spread.variance / (spread.square + spread.floor())).mean())


def _two(x: float) -> str:
    """Two significant digits."""
    return f"{float(f'{x:.2g}'):g}"


def main() -> None:
    """Print it."""
    print("| scene | emissive triangles | squared error | CPU seconds | squared error × seconds |\n| --- | --- | --- | --- | --- |")
    for name, made in SCENES.items():
        for size in (8, 64, 512) if made is lamp_corridor else (98, 10_000, 100_000):
            found = race(made(size), 64)
            triangles = 2 * size if made is lamp_corridor else size
            both = _two(found.variances / found.seconds)
            print(f"| {name} | {triangles:,} | 1 / {_two(found.variances)} | {found.seconds:.2f} × | 1 / {both} |")


if __name__ == "__main__":
    main()
