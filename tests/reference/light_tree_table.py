"""Emitters drawn by a tree against emitters drawn by power alone: ``python -m tests.reference.light_tree_table``.

The table in docs/method.md.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

from bake_core.allocation import Allocation
from bake_core.examples import Example, lamp_corridor, many_lamps
from bake_core.prepared import Prepared
from bake_core.shards import trace_shard
from bake_core.tally import State
from tests.baking import prepared, traced


def lamps_on_a_ceiling(emitters: int) -> Example:
    """:func:`bake_core.examples.many_lamps`, with probes all over the room."""
    glb, spec = many_lamps(emitters)
    return glb, {**spec, "volumes": [{"name": "room", "origin": [-0.6, 0.4, -0.6], "spacing": [0.4, 0.4, 0.4], "counts": [4, 4, 4]}]}


class Race(NamedTuple):
    """What came of both ways.

    `emitters`: emissive triangles. `variances`: of irradiance, relative, by power over by the tree. `seconds`: CPU's, by the tree over by
    power. `difference`: of means, in its standard errors.
    """

    emitters: int
    variances: float
    seconds: float
    difference: float


def race(example: Example, samples: int) -> Race:
    """Both ways, path-traced, the same numbers."""
    tree = prepared(example, integrator="path")
    power = tree.traced_with(replace(tree.tracer, tables=tree.tracer.tables._replace(tree=None)))
    (a, a_seconds), (b, b_seconds) = (_timed(p, samples) for p in (tree, power))
    # Of each probe's mean over all directions; probes' errors are independent.
    off = (a.mean() - b.mean()).mean((1, 2))
    return Race(
        len(tree.tracer.tables.emitters.cdf),
        _relative(b) / _relative(a),
        a_seconds / b_seconds,
        float(off.mean() / (off.std(ddof=1) / len(off) ** 0.5)),
    )


def _timed(p: Prepared, samples: int) -> tuple[State, float]:
    # Compiles, by tracing nothing.
    trace_shard(p, (0, 0), (0, 0), Allocation.start(0), threads=1)
    began = time.process_time()
    return traced(p, (samples // 2, samples)), time.process_time() - began


def _relative(state: State) -> float:
    spread: Any = state.spread()
    return float((spread.variance / (spread.square + spread.floor())).mean())


def _two(x: float) -> str:
    """Two significant digits."""
    return f"{float(f'{x:.2g}'):g}"


def main() -> None:
    """Print it."""
    print("| scene | emissive triangles | squared error | CPU seconds | squared error × seconds |\n| --- | --- | --- | --- | --- |")
    rows: list[tuple[str, Example]] = [("corridor, a lamp each 2 m", lamp_corridor(lamps)) for lamps in (8, 64, 512)]
    rows += [("room, lamps all over its ceiling", lamps_on_a_ceiling(n)) for n in (98, 10_000, 100_000)]
    for name, example in rows:
        found = race(example, 64)
        both = _two(found.variances / found.seconds)
        print(f"| {name} | {found.emitters:,} | 1 / {_two(found.variances)} | {found.seconds:.2f} × | 1 / {both} |")


if __name__ == "__main__":
    main()
