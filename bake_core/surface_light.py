"""The light cache over a bake's passes: each stage is a function of scene, spec and its number alone, so that any process can make it."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import FIRST_SAMPLES, HALVES, SCRAMBLES
from bake_core.cache_cells import FEWEST, average, codes
from bake_core.cache_guide import FEWEST_POINTS, GROUP_BYTES, Guide
from bake_core.cache_points import Points, find_points, gather_light
from bake_core.light_cache import AXIS_CELLS, LightCache, empty_cache
from bake_core.spec import Spec
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]
Flag = NDArray[np.uint8]

# Paths that the cache learns from, over those that read it: where squared error times seconds is least, which is a flat valley.
_SHARE = 0.5
# From one point in the first stage: its ray from the probe costs little beside them.
_PATHS = 16
# Of a layer that only teaches the next one, so many times fewer: where bounces are limited and there are many such layers, whose noise is
# averaged over all that a point sees; and where there is one in the first stage alone, whose light all later ones go on with.
_TEACHING_MANY, _TEACHING_ONE = 8, 2
# What it learns from ends in cells of the layer below that are this many times their size away, or more.
_FAR = 3.0
# Where bounces are limited, every one has a layer of its own, but for the first of more than so many: those are path-traced.
_MOST_LAYERS = 6
# Probes that points are looked for from, and points in the end: what a large bake holds of them, some 600 MB.
_MOST_PROBES, _MOST_POINTS = 1 << 14, 1 << 21
# The smallest cells of the first stage, in the smallest spacing of probes; how many sizes there are up to the largest spacing.
_SMALLEST = 1 / 8
_SIZES = 4
_MOST_SIZES = 12
# Fewer probes have nothing to share.
FEWEST_PROBES = 64
# Of what probes see, this much must be in the cache for it to pay.
_COVERED = 0.5
# A point twice, while cells are made of it; a cell with its place in the table, in all sizes together.
_POINT_BYTES, _LIGHT_BYTES, _CELL_BYTES = 2 * 90, 2 * 24, 4 * (SCRAMBLES * 12 + 32 + 32) // 3
_SEED = 0x11C4C3E5
# What the guide takes, over the points of the first stage.
_GUIDE_BYTES = GROUP_BYTES // FEWEST_POINTS
# Cells about which it is learnt where light comes from are so many sizes larger than the smallest.
_GUIDE_LEVEL = 3
# What makes a point's paths other ones in each layer, and once they are guided by what those of the first stage found.
_KEYS = np.random.default_rng(_SEED).integers(1 << 64, size=(2, _MOST_LAYERS), dtype=np.uint64)


@dataclass(eq=False)
class SurfaceLight:
    """What is known of the light on surfaces when a pass begins.

    Stage s is what a bake of 16 · 2ˢ samples learns from: half as many paths as it traces itself, from points that its probes see. Both
    the points and the paths from each grow, and every second stage cells are half as large, so that what they smooth away goes to zero
    as well.

    Light is learnt in layers. Paths of the lowest are traced to their ends; those of the next one end at the first surface that the layer
    below knows, as a sweep of a radiosity solution does (Cohen and Wallace 1993, "Radiosity and Realistic Image Synthesis", section 5.3).
    Where bounces are limited, a layer knows light of so many of them, and the highest, of one less than a path may have, is what the
    bake reads. Where they are not, there are two of the same light, and from the second stage on the one before is the lower one.

    Half of all paths go where those of the first stage before them found light (:mod:`bake_core.cache_guide`).

    ``dataclasses.replace`` makes one of another seed or tracer, that has learnt nothing yet.

    Attributes
    ----------
    tracer : Tracer
        Without a cache.
    positions : (n, 3) float64
        Of all probes, local frame.
    units : (n,) float64
        Each one's smallest spacing, metres.
    texels : int
        Of a probe's capture map.
    seed : int
    cached : float
        The share of what probes see that is known at first (:meth:`survey`).
    """

    tracer: Tracer
    positions: F64
    units: F64
    texels: int
    seed: int
    cached: float = 0.0

    def __post_init__(self) -> None:
        self._seed = self.seed ^ _SEED
        some = np.random.default_rng(self._seed).permutation(len(self.positions))[:_MOST_PROBES]
        self._positions = np.ascontiguousarray(self.positions[np.sort(some)])
        self._smallest, self._largest = float(self.units.min()), float(self.units.max())
        # Of each probe and scramble.
        self._first_paths = max(round(_SHARE * self.texels * FIRST_SAMPLES / SCRAMBLES), 1)
        self._most_rounds = max(_MOST_POINTS // max(self.probes * SCRAMBLES, 1), 1)
        self._lock = threading.Lock()
        self.forget()

    @property
    def _limited(self) -> bool:
        return bool(self.tracer.tables.max_bounces < np.iinfo(np.int32).max)

    @property
    def probes(self) -> int:
        """How many it learns from: all, or as many as a large bake has of them."""
        return len(self._positions)

    def of_some(self, probes: int) -> SurfaceLight:
        """What so many of its probes would learn, or all of fewer."""
        return replace(self, positions=np.random.default_rng(self._seed).permutation(self._positions)[:probes])

    def survey(self, threads: int) -> float:
        """The share of what probes see that the first stage will know where nothing is in the way; no path is traced for it."""
        never = np.zeros(1, np.uint8)
        found = find_points(self.tracer, self._positions, (0, self.rounds(0)), self._seed, threads=threads, cancelled=never)
        grid = self._grid(0)
        code = codes(grid, found.points) >> np.uint64(3 * (int(grid[4]) - 1))
        _, cell, count = np.unique(code, return_inverse=True, return_counts=True)
        return float((count[cell] >= HALVES * FEWEST).sum() / found.met) if found.met else 0.0

    def known(self, samples: int, *, threads: int, cancelled: Flag) -> Tracer:
        """What a pass that ends at so many samples traces with.

        Raises
        ------
        Cancelled
            What is known stays as it was.
        """
        stage = _stage(samples)
        with self._lock:
            if stage < self._learnt:
                self.forget()
            while self._learnt < stage:
                self._learn(self._learnt + 1, threads, cancelled)
            return self._cached

    def rays(self, samples: tuple[int, int]) -> int:
        """Rays that it took to learn what a pass over these samples is the first to know, once :meth:`known` has been asked."""
        return sum(self._rays[_stage(samples[0]) + 1 if samples[0] else 0 : _stage(samples[1]) + 1])

    def bytes(self, samples: int) -> int:
        """What is held at most, once so many samples have been taken."""
        first, points = (self.probes * SCRAMBLES * self.rounds(stage) for stage in (0, _stage(samples)))
        return first * _GUIDE_BYTES + points * (_POINT_BYTES + len(self._bounces) * _LIGHT_BYTES + _CELL_BYTES // (HALVES * FEWEST))

    def blank(self) -> Tracer:
        """The tracer with a cache that knows nothing: for kernels that are to be compiled, and who starts to learn."""
        return _with(self.tracer, empty_cache(SCRAMBLES))

    def compile(self) -> None:
        """Compile, or fetch from the cache on disk, the kernels that learn: from no point."""
        never, points = np.zeros(1, np.uint8), Points.none()
        find_points(self.tracer, self._positions, (0, 0), self._seed, threads=1, cancelled=never)
        nobody = np.zeros(0, np.int64)
        gather_light(self.blank(), points, self._guide, nobody, (0, 1), teach=False, threads=1, cancelled=never)
        average(self.tracer, points, 1, self._grid(0), threads=1)

    def forget(self) -> None:
        """Hold nothing any more; whoever asks again has it learnt anew."""
        self._learnt, self._points, self._cached = -1, Points.none(), self.blank()
        self._light = [np.zeros((0, 3)) for _ in self._bounces]
        self._rays: list[int] = []
        self._guide = Guide.of(np.zeros(0, np.uint64))

    @property
    def _bounces(self) -> list[int]:
        """Of the light that each layer knows, the lowest first."""
        most = int(self.tracer.tables.max_bounces)
        if not self._limited:
            return [most, most]
        return list(range(max(most - _MOST_LAYERS, 1), most))

    def _learn(self, stage: int, threads: int, cancelled: Flag) -> None:
        bounces, grid = self._bounces, self._grid(stage)
        before, now = self.rounds(stage - 1) if stage else 0, self.rounds(stage)
        found = find_points(self.tracer, self._positions, (before, now), self._seed, threads=threads, cancelled=cancelled)
        old, points, rays = len(self._points), self._points + found.points, found.rays
        # Without limits the last stage knows of the same light, and better than a lower layer would.
        lowest = 1 if stage and not self._limited else 0
        light, known = [*self._light], self._cached if lowest else self.blank()
        about = codes(self._grid(0), points) >> np.uint64(3 * _GUIDE_LEVEL)
        guide = self._guide if stage else Guide.of(about)
        rows = guide.rows(about)
        for layer in range(lowest, len(bounces)):
            teacher = _teaching(known, bounces[layer])
            light[layer] = np.concatenate([self._light[layer], np.zeros((len(points) - old, 3))])
            of_layer = replace(points, key=points.key ^ _KEYS[min(stage, 1), layer], light=light[layer])
            paths = self.paths(stage, layer)
            for part, first in ((slice(old), self.paths(stage - 1, layer) if stage else 0), (slice(old, None), 0)):
                asked = (of_layer[part], guide, rows[part], (first, paths))
                rays += gather_light(teacher, *asked, teach=not stage, threads=threads, cancelled=cancelled)
            cache, traced = average(self.tracer, of_layer, paths, grid, threads=threads)
            known, rays = _with(self.tracer, cache), rays + traced
        self._learnt, self._points, self._light, self._cached, self._guide = stage, points, light, known, guide
        self._rays.append(rays)

    def rounds(self, stage: int) -> int:
        """Points of each probe and scramble; the paths from each make up for the stages in which they do not grow."""
        return min(max(self._first_paths // _PATHS, 1) << ((stage + 1) // 2), self._most_rounds)

    def paths(self, stage: int, layer: int = -1) -> int:
        """From each point, of a layer; of the highest, which is what is read, if none is given."""
        paths = (self._first_paths << stage) // self.rounds(stage)
        if layer not in (-1, len(self._bounces) - 1):
            paths //= _TEACHING_MANY if self._limited else _TEACHING_ONE
        return max(paths, 1)

    def _grid(self, stage: int) -> F64:
        smallest = self._smallest * _SMALLEST / 2 ** (stage // 2)
        sizes = _SIZES + math.ceil(math.log2(self._largest / self._smallest)) + stage // 2
        middle = (self._positions.min(0) + self._positions.max(0)) / 2
        # Not a multiple of anything, lest walls lie on the edges of cells.
        corner = middle - (AXIS_CELLS / 2 + 0.37) * smallest
        return np.array([*corner, smallest, min(sizes, _MOST_SIZES), 1, 1 if self._limited else np.inf, 0], np.float64)


def _stage(samples: int) -> int:
    return max(samples // FIRST_SAMPLES, 1).bit_length() - 1


def surface_light(spec: Spec, tracer: Tracer, positions: F64, units: F64, texels: int, *, threads: int) -> SurfaceLight | None:
    """The cache that a spec asks for; None where every path shall be traced to its end.

    ``auto`` takes the cache where paths bounce, many probes share what they see, and half of that is matt surfaces that are seen often
    enough. Parameters are :class:`SurfaceLight`'s.
    """
    bounces = tracer.tables.max_bounces
    if spec.integrator == "path" or bounces < 2 or (spec.integrator == "auto" and len(positions) < FEWEST_PROBES):
        return None
    light = SurfaceLight(tracer, positions, units, texels, spec.seed)
    light.cached = light.survey(threads)
    return light if light.cached >= _COVERED or spec.integrator == "cache" else None


def _teaching(tracer: Tracer, bounces: int) -> Tracer:
    """For paths of so many bounces, with a cache that does not answer beside where it is asked from.

    What it smooths there would be seen at large, and smoothed again.
    """
    cache = tracer.tables.cache
    assert cache is not None
    far = cache._replace(grid=np.array([*cache.grid[:7], _FAR]))
    return replace(tracer, tables=tracer.tables._replace(cache=far, max_bounces=np.int64(bounces)))


def _with(tracer: Tracer, cache: LightCache) -> Tracer:
    return replace(tracer, tables=tracer.tables._replace(cache=cache))
