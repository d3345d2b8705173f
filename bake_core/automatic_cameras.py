"""Cameras for a scene that has none: inside its volumes, looking at lit surfaces. The same for the same bundle, every time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.bundle import VolumeData
from bake_core.cameras import DEFAULT_YFOV, looking
from bake_core.comparison import LUMINANCE
from bake_core.raster import Rasterizer
from bake_core.scene import Camera, Scene

F64 = NDArray[np.float64]

COUNT = 3
# Glimpses are this large: enough to tell a wall in front of one's nose from a room.
_WIDTH, _HEIGHT = 48, 27
# Vertices of all glimpses together; bounds the search to some seconds on a CPU whatever the scene.
_VERTEX_BUDGET = 30_000_000
_MOST_PLACES, _FEWEST_PLACES, _TURNS = 24, 4, 8
# Looking a little down, as people do: floors show more of a room's light than ceilings.
_PITCH = math.radians(-12)


@dataclass(frozen=True)
class _View:
    position: F64
    towards: F64
    score: float


def automatic_cameras(rasterizer: Rasterizer, scene: Scene, volumes: Sequence[VolumeData]) -> tuple[Camera, ...]:
    """Three cameras at probes' places, or fewer where fewer see anything.

    From places spread over the active probes, glimpses are taken in eight directions about the vertical and towards the middle of all
    places. Those that show much lit, varied surface at a distance win, each next one for being unlike those before it.
    """
    places = _places(volumes, _how_many(scene))
    low, high = places.min(0), places.max(0)
    reach = float(np.linalg.norm(high - low)) or float(max(v.spacing.max() for v in volumes))
    views = []
    for position in places:
        for towards in _directions(position, (low + high) / 2):
            camera = Camera("", looking(position, position + towards), DEFAULT_YFOV)
            picture, distances = rasterizer.glimpse(camera, _WIDTH, _HEIGHT)
            views.append(_View(position, towards, _score((picture.indirect + picture.emission) @ LUMINANCE, distances, reach)))
    chosen: list[_View] = []
    while len(chosen) < COUNT:
        scores = [v.score * math.prod(1 - 0.9 * _alike(v, c, reach) for c in chosen) for v in views]
        best = int(np.argmax(scores))
        if scores[best] <= 0:
            break
        chosen.append(views[best])
    # Nothing is lit anywhere: two ways of seeing that it is dark.
    chosen = chosen or [views[0], views[_TURNS // 2]]
    return tuple(Camera(f"auto{i}", looking(v.position, v.position + v.towards), DEFAULT_YFOV) for i, v in enumerate(chosen))


def _directions(position: F64, middle: F64) -> Iterator[F64]:
    """Unit directions worth looking in from a place."""
    for turn in range(_TURNS):
        angle = 2 * math.pi * turn / _TURNS
        yield np.array([math.sin(angle) * math.cos(_PITCH), math.sin(_PITCH), -math.cos(angle) * math.cos(_PITCH)])
    if (position != middle).any():
        yield (middle - position) / np.linalg.norm(middle - position)


def _how_many(scene: Scene) -> int:
    affordable = _VERTEX_BUDGET // max(1, 3 * scene.triangle_count * (_TURNS + 1))
    return min(_MOST_PLACES, max(_FEWEST_PLACES, affordable))


def _places(volumes: Sequence[VolumeData], count: int) -> F64:
    """Probe positions far from each other, (at most `count`, 3), of those that see the fewest back faces."""
    positions, backs = [], []
    for v in volumes:
        lattice = np.stack(np.unravel_index(np.arange(len(v.states)), tuple(v.counts[::-1]))[::-1], -1)
        usable = v.states > 0 if v.states.any() else np.ones(len(v.states), bool)
        positions.append((v.origin + v.spacing * lattice + v.offsets)[usable])
        backs.append(v.backface[usable])
    position, back = np.concatenate(positions), np.concatenate(backs)
    # A probe that sees back faces stands behind something single-sided, outside of what is to be looked at.
    position = position[back <= max(0.02, float(back.min()))]
    middle = (position.min(0) + position.max(0)) / 2
    chosen = [int(((position - middle) ** 2).sum(1).argmin())]
    distance = ((position - position[chosen[0]]) ** 2).sum(1)
    while len(chosen) < min(count, len(position)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((position - position[chosen[-1]]) ** 2).sum(1))
    return position[chosen]


def _score(light: NDArray[np.floating], distances: F64, reach: float) -> float:
    """How much there is to see: surface that is lit, not right in front of the camera, and not all alike."""
    surface = np.isfinite(distances)
    lit = surface & (light > 0)
    if not lit.any():
        return 0.0
    levels = np.log2(light[lit])
    spread = np.histogram(levels, bins=12, range=(levels.max() - 6, levels.max()))[0] / levels.size
    entropy = float(-(spread[spread > 0] * np.log2(spread[spread > 0])).sum()) / math.log2(12)
    # A fifth of the way across counts as near; a third is as good as any distance.
    near = float((distances[surface] < reach / 5).mean())
    typical = min(1.0, 3 * float(np.median(distances[surface])) / reach)
    return float(lit.mean()) * (1 - 0.9 * near) * typical * (0.25 + entropy)


def _alike(a: _View, b: _View, reach: float) -> float:
    distance = float(np.linalg.norm(a.position - b.position)) / reach
    return math.exp(-((2 * distance) ** 2)) * max(0.0, float(a.towards @ b.towards))
