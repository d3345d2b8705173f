"""What a bake needs before its first ray: probes in their places, what is kept, what rays ask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bake_core.environment import Find, no_images, read_environment
from bake_core.parameters import LARGEST
from bake_core.placement import Volume, place
from bake_core.reach import probes_about_surfaces
from bake_core.relocation import relocate
from bake_core.relocation_trial import Trial, try_relocation
from bake_core.scene import Scene
from bake_core.sealed import is_sealed
from bake_core.selection import LeftOut, Selection, select
from bake_core.shader_constants import biases
from bake_core.spec import Spec
from bake_core.surface_light import SurfaceLight, surface_light
from bake_core.tracer import Tracer
from bake_core.unneeded import unneeded

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class Prepared:
    """A function of scene and spec only.

    Attributes
    ----------
    positions : (n, 3) float64
        Of all probes of all volumes in turn, local frame.
    offsets : (n, 3) float32
        By how much they were moved from their lattice points.
    limits, units : (n,) float64
        Each probe's distance limit, and the smallest spacing of its volume, metres.
    trials : tuple of Trial or None
        Each volume's, where it was to be found out whether its probes should move.
    needed : (n,) bool
        Which of them are baked at all, unless they turn out to stand inside a solid.
    tracer : Tracer
        What probes are traced with.
    whole : Tracer
        The scene as it is: what audits look at. It has an environment that `tracer` may do without.
    light : SurfaceLight or None
        The cache of indirect light that passes read; None where every path is traced to its end.
    """

    scene: Scene
    spec: Spec
    volumes: tuple[Volume, ...]
    selection: Selection
    tracer: Tracer
    whole: Tracer
    positions: NDArray[np.float64]
    offsets: NDArray[np.float32]
    trials: tuple[Trial | None, ...]
    limits: NDArray[np.float64]
    units: NDArray[np.float64]
    needed: NDArray[np.bool_]
    light: SurfaceLight | None

    @property
    def probe_count(self) -> int:
        return len(self.positions)

    def traced_with(self, tracer: Tracer) -> Prepared:
        """The same bake by other tables of the same scene."""
        light = self.light and replace(self.light, tracer=tracer)
        return replace(self, tracer=tracer, whole=tracer, light=light)

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Outputs first, then what kernels do without."""
        return self.selection.left_out + unneeded(self.tracer.tables, sealed=self.tracer is not self.whole)


def prepare(
    scene: Scene, spec: Spec, find: Find = no_images, *, threads: int = 1, trials: tuple[Trial | None, ...] | None = None
) -> Prepared:
    """Place the probes, choose the outputs, build the acceleration structure.

    Parameters
    ----------
    threads : int
        The result is the same for any number.
    trials : tuple of Trial or None, optional
        What preparing the same came to elsewhere: nothing is measured again.
    find : callable, optional
        Where an image that the spec names lies; in what is prepared it is named by its digest.

    Raises
    ------
    SpecError, SceneError
    """
    volumes = place(scene, spec)
    environment, named = read_environment(spec.environment, find)
    spec = spec.model_copy(update={"environment": named})
    positions = np.concatenate([v.positions() for v in volumes]) - scene.origin
    whole = Tracer.build(scene, spec, environment)
    offsets, trials = _relocated(scene, spec, whole, volumes, positions, threads, trials)
    positions = positions + offsets
    stand = [
        s if own.any() else _corners(v) - scene.origin
        for v, s, own in zip(volumes, _by_volume(volumes, positions), _by_volume(volumes, offsets), strict=True)
    ]
    selection = select(scene, spec, volumes, stand)
    units = np.concatenate([np.full(v.probe_count, v.spacing.min()) for v in volumes])
    shines = environment.sky is not None or bool(environment.constant.any())
    tracer = whole.without_environment() if shines and is_sealed(scene, whole, positions) else whole
    return Prepared(
        scene=scene,
        spec=spec,
        volumes=volumes,
        selection=selection,
        tracer=tracer,
        whole=whole,
        positions=positions,
        offsets=offsets,
        trials=trials,
        limits=np.concatenate([np.full(v.probe_count, v.distance_limit) for v in volumes]),
        units=units,
        needed=needed_probes(scene, volumes) if spec.receivers == "surfaces" else np.ones(len(positions), np.bool_),
        light=surface_light(spec, tracer, positions, units, selection.capture**2, threads=threads),
    )


def _relocated(
    scene: Scene,
    spec: Spec,
    tracer: Tracer,
    volumes: Sequence[Volume],
    positions: NDArray[np.float64],
    threads: int,
    known: tuple[Trial | None, ...] | None,
) -> tuple[NDArray[np.float32], tuple[Trial | None, ...]]:
    """Offsets of all volumes' probes in turn, and what was measured to decide on them."""
    may = [spec.relocates(v.probe_count) for v in volumes]
    if not any(may):
        return np.zeros(positions.shape, np.float32), (None,) * len(volumes)
    offsets, trials = _by_volume(volumes, relocate(tracer, volumes, positions)), list(known or [None] * len(volumes))
    for i, volume in enumerate(volumes):
        if known is None and may[i] and spec.probes == "auto" and offsets[i].any():
            trials[i] = try_relocation(scene, tracer, volume, offsets[i].astype(np.float64), len(volumes), threads=threads)
        trial = trials[i]
        if not may[i] or (trial is not None and not trial.moved):
            offsets[i] = np.zeros_like(offsets[i])
    return np.concatenate(offsets), tuple(trials)


def _by_volume(volumes: Sequence[Volume], values: NDArray[T]) -> list[NDArray[T]]:
    """What all volumes' probes have in turn, volume by volume."""
    return np.split(values, np.cumsum([v.probe_count for v in volumes])[:-1])


def _corners(volume: Volume) -> NDArray[np.float64]:
    """The outermost lattice points, (8, 3), world."""
    upper = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)])
    corners: NDArray[np.float64] = volume.origin + upper * (np.asarray(volume.counts) - 1) * volume.spacing
    return corners


def needed_probes(scene: Scene, volumes: Sequence[Volume]) -> NDArray[np.bool_]:
    """Which probes any query on a surface asks, (n,) bool, of all volumes in turn: :func:`bake_core.reach.probes_about_surfaces`.

    Surfaces are taken as far off as a query moves its point before it asks for visibility, which bounds what a renderer does to points.
    """
    counts = [np.asarray(v.counts, np.int64) for v in volumes]
    margins = [sum(biases(LARGEST, v.spacing, n)) for v, n in zip(volumes, counts, strict=True)]
    return np.concatenate([probes_about_surfaces(scene, v, margin) for v, margin in zip(volumes, margins, strict=True)])
