"""Light that never ends: a sealed room that absorbs nothing and holds a lamp has no finite answer, and no bake may look for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import uniform
from bake_core.capture import Capture, capture_radiance
from bake_core.errors import SceneError
from bake_core.scene import Scene
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]

# Light that has bounced so often must have lost half of its energy: where less than 1 part in 12,000 is absorbed or leaves at each bounce
# it has not. A path is then tens of thousands of vertices long, and the bake would take days if its answer were finite.
ENOUGH_BOUNCES = 8192
# A surface that reflects less than this ends light by itself: 0.9999^8192 = 0.44.
_REFLECTS_ALL = 0.9999
# Paths from each probe that is looked at, and from one that looks endless: enough that a share of 0.44 is not taken for more than 0.5
# (a share's σ is at most 0.5/√n: 0.03).
_PATHS, _CONFIRMING_PATHS = 16, 256
# Probes looked at together at first, doubled up to the last: the first lot in a sealed white room takes seconds.
_FEW_PROBES, _MANY_PROBES = 4, 64
_TEXELS = 4


def check_light_ends(scene: Scene, tracer: Tracer, positions: F64, *, threads: int, cancelled: NDArray[np.uint8]) -> None:
    """Refuse a scene in which light goes on for ever; for a bake of unbounded bounces.

    Paths of at most k bounces and of at most 2k, from every probe: energy that decays as q per k bounces adds up to 1 - q and 1 - q², so
    that their quotient is 1 + q. Nothing is traced where every material absorbs.

    Parameters
    ----------
    positions : (n, 3) float64
        Probes, metres, local frame.
    threads : int
        The answer does not depend on it.
    cancelled : (1,) uint8

    Raises
    ------
    SceneError
        ``scene.light_never_ends``; `where` is the probe that found it.
    Cancelled
    """
    used = np.unique(scene.triangle_material)
    if not used.size or scene.materials.base_color[used].max() < _REFLECTS_ALL:
        return

    def left(probes: NDArray[np.int64], paths: int) -> F64:
        """The share q that is left after ENOUGH_BOUNCES, of the channel that keeps most."""
        sums = [
            capture_radiance(
                replace(tracer, tables=tracer.tables._replace(max_bounces=np.int64(bounces))),
                np.ascontiguousarray(positions[probes]),
                probes.astype(np.uint64),
                uniform(len(probes), (0, paths // _TEXELS)),
                Capture(2, 2, seed=paths, keep_radiance=False),
                threads=threads,
                cancelled=cancelled,
                advance=lambda fraction: None,
            )[0].sum((1, 2))
            for bounces in (ENOUGH_BOUNCES, 2 * ENOUGH_BOUNCES)
        ]
        share: F64 = (np.divide(sums[1], sums[0], out=np.ones_like(sums[0]), where=sums[0] > 0) - 1).max(1)
        return share

    first, count = 0, _FEW_PROBES
    while first < len(positions):
        probes = np.arange(first, min(first + count, len(positions)))
        share = left(probes, _PATHS)
        worst = probes[share.argmax() :][:1]
        if share.max() > 0.5 and left(worst, _CONFIRMING_PATHS)[0] > 0.5:
            raise SceneError(
                "scene.light_never_ends",
                f"light that has bounced {ENOUGH_BOUNCES} times has not lost half of its energy: the room is sealed and absorbs nothing; "
                'give the spec "max_bounces", or its walls a base colour below 1',
                f"probe {int(worst[0])}",
            )
        first, count = first + count, min(2 * count, _MANY_PROBES)
