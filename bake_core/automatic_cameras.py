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
from bake_core.irradiance import covered
from bake_core.raster import Rasterizer
from bake_core.scene import Camera, Scene

F64 = NDArray[np.float64]

COUNT = 3
# Glimpses are this large: enough to tell a wall in front of one's nose from a room.
_WIDTH, _HEIGHT = 48, 27
# Vertices of all glimpses together; bounds the search to some seconds on a CPU whatever the scene.
_VERTEX_BUDGET = 30_000_000
_MOST_PLACES, _FEWEST_PLACES, _TURNS = 40, 5, 8
# Looking a little down, as people do: floors show more of a room's light than ceilings.
_PITCH = math.radians(-12)
# Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences": the root of x⁴ = x + 1 spreads points in three dimensions.
_SPREAD = 1 / 1.2207440846057596 ** np.arange(1, 4)


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
    glimpses = []
    for position in places:
        for towards in _directions(position, (low + high) / 2):
            camera = Camera("", looking(position, position + towards), DEFAULT_YFOV)
            picture, points = rasterizer.glimpse(camera, _WIDTH, _HEIGHT)
            light = (picture.indirect + picture.emission) @ LUMINANCE
            # What lies beyond the volumes is not worth looking at: the bundle promises nothing there.
            light[~covered(volumes, points.reshape(-1, 3)).reshape(light.shape)] = 0
            glimpses.append((position, towards, light, np.linalg.norm(points - position, axis=-1)))
    views = _scored(glimpses, reach)
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
    """Probe positions spread over the volumes, (at most `count`, 3), of those that see the fewest back faces."""
    positions, backs = [], []
    for v in volumes:
        usable = v.states == 1 if (v.states == 1).any() else np.ones(len(v.states), bool)
        positions.append(v.positions()[usable])
        backs.append(v.backface[usable])
    position, back = np.concatenate(positions), np.concatenate(backs)
    # A probe that sees back faces stands behind something single-sided, outside of what is to be looked at.
    position = position[back <= max(0.02, float(back.min()))]
    low, high = position.min(0), position.max(0)
    wanted = low + (high - low) * ((0.5 + np.arange(count)[:, None] * _SPREAD) % 1)
    nearest = [int(((position - w) ** 2).sum(1).argmin()) for w in wanted]
    return position[list(dict.fromkeys(nearest))]


def _scored(glimpses: Sequence[tuple[F64, F64, NDArray[np.floating], F64]], reach: float) -> list[_View]:
    """Views with their scores, from (place, direction, light, distances)."""
    shining = np.concatenate([light[light > 0] for _, _, light, _ in glimpses])
    # A fiftieth of what is bright here: less is a dark room, perhaps with light leaking into it.
    dark = 0.02 * float(np.quantile(shining, 0.9)) if shining.size else 0.0
    lit_around = {tuple(place): 0.0 for place, _, _, _ in glimpses}
    around: dict[tuple[float, ...], list[F64]] = {place: [] for place in lit_around}
    for place, _, light, distances in glimpses:
        lit_around[tuple(place)] += float((light > dark).mean())
        around[tuple(place)].append(distances[np.isfinite(distances)])
    most = max(lit_around.values())
    out = []
    for place, towards, light, distances in glimpses:
        # A place with lit surface all around is inside of something; the open front of a room will do, a field is the last place to go.
        inside = min(1.0, 1.5 * lit_around[tuple(place)] / most) ** 3 if most else 0.0
        # What is near is judged by the room that one stands in as well as by the whole.
        room = np.concatenate(around[tuple(place)])
        scale = math.sqrt(reach * min(reach, float(np.quantile(room, 0.75)))) if room.size else reach
        out.append(_View(place, towards, inside * _score(np.where(light > dark, light, 0), distances, scale)))
    return out


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
