"""What a query's weights depend on, per volume: a default, and the choice that a bake makes by measuring at its scene's surfaces.

One setting does not suit all scenes. Where walls divide cells, a probe that no wall lets see a point must count for nothing; where leaves
and columns are finer than the maps, no probe may see the point at all, and then the mean of some is nearer to the truth than the least
hidden one. So points are drawn on the volume's surfaces, path-traced, and asked for under each candidate.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.bundle import VolumeData
from bake_core.filtering import VISIBILITY_SHARPNESS
from bake_core.irradiance import sample
from bake_core.receiver_irradiance import irradiance_at
from bake_core.receivers import draw_receivers, stands_of
from bake_core.relmse import relative_squares
from bake_core.scene import Scene
from bake_core.tracer import Tracer

F64 = NDArray[np.float64]

# A point is moved by (n · normal_bias + wo · view_bias) · bias_scale · spacing before the walls are looked up: the surface bias of Majercik
# et al. 2021, "Scaling Probe-Based Real-Time Dynamic Global Illumination for Production". Theirs, 0.2, 0.8 and 0.225, was chosen for
# moments, which blur a wall by more. With no bias towards the viewer, matt light does not change as somebody walks by.
# `visibility_softness` is over what part of the distance a shadow of the walls fades: none would be a line, and half floats place a wall
# to 0.0005. Its tail falls as the sixth power, so where no probe sees a point, as in a corner that maps round off, the least hidden one
# answers. `visibility_floor` is where the tail ends: by default so that it is above what float32 holds when it has been cubed by the crush.
PARAMETERS = {
    "normal_bias": 0.15,
    "view_bias": 0.0,
    "bias_scale": 1.0,
    "visibility_floor": 1e-9,
    "visibility_softness": 0.01,
    "visibility_sharpness": float(VISIBILITY_SHARPNESS),
}
# Tried against the default. A floor of 0.2, crushed, lets about 1 % of a neighbouring room's light in; no larger one is ever worth it.
BIASES = (0.05, 0.1, 0.15, 0.2, 0.3)
FLOORS = (1e-9, 0.02, 0.1, 0.2)
FADES = (0.01, 0.03, 0.1)
# The farthest that any choice moves a point.
LARGEST = {**PARAMETERS, "normal_bias": max(BIASES)}

# Points, shared out between volumes, and paths from each for each of four estimates: few points would miss small rooms.
_POINTS, _SCRAMBLES, _PATHS = 2048, 4, 16
_SEED = 0x9A7A3E
# Points at which resolutions are compared with each other, where nothing is traced; and by how much they may differ in the mean of squares.
_MANY, _OFF = 32768, 0.01
# Of a volume among many; and how many must be found at least, for fewer tell nothing.
_LEAST, _FEWEST = 256, 64
# Dark is what receives less than this part of the volume's mean.
_DARK = 0.01
# Standard errors of a difference by which a choice must be better.
_SURE = 3.0
# Of the default's error: less is not worth a difference between volumes.
_WORTH = 0.01
# What a quarter of the bytes is worth: a fortieth of the error, so so much of its square; and of the mean irradiance in the dark.
_MARGIN, _LET_IN = 0.05, 1e-3


@dataclass(frozen=True)
class Choice:
    """What a volume's query uses.

    Attributes
    ----------
    parameters : dict of str to float
    points : int
        Surface points that it was measured at; 0: not measured.
    resolution : int
        Which of the resolutions that visibility maps came at.
    error, default_error : float or None
        Mean square of the relative error at these points with the choice and with the default, bounded:
        :func:`bake_core.relmse.relative_squares`.
    """

    parameters: dict[str, float]
    points: int = 0
    resolution: int = 0
    error: float | None = None
    default_error: float | None = None

    def entry(self) -> dict[str, float | int] | None:
        """What the manifest says of how it was chosen, or None."""
        if self.error is None or self.default_error is None:
            return None
        return {"points": self.points, "error": self.error, "default_error": self.default_error}


def default_choices(volumes: Sequence[Sequence[VolumeData]]) -> list[Choice]:
    """The default for every volume, where there is nothing to measure by."""
    return [Choice(PARAMETERS) for _ in volumes]


def choose_parameters(scene: Scene, tracer: Tracer, volumes: Sequence[Sequence[VolumeData]], *, threads: int) -> list[Choice]:
    """Each volume's parameters: those with the least error at points drawn on its surfaces, or the default where none is surely better.

    Surely: by 1 %, and by three standard errors of the difference, for the best of twenty is partly luck. The error is the mean of bounded
    relative squares, free of the reference's noise. And at dark points the mean must not rise: a leak is worse than its square.

    Then its visibility maps' resolution: the lowest with a mean square at most 5 % above that of the highest, at dark points no more
    light than with it but for a thousandth of the mean, and answers that are the highest's to a hundredth in the mean of squares.

    Parameters
    ----------
    tracer : Tracer
        With the environment.
    volumes : sequence of sequences of VolumeData
        Each volume with visibility maps of one resolution or more, the highest first. With irradiance; those without walls keep the
        default.

    Returns
    -------
    list of Choice
        The same for any number of threads.
    """
    asked = {"irradiance", "walls"}
    points = max(_POINTS // max(len(volumes), 1), _LEAST)
    return [_choose(scene, tracer, ways, points, threads) if asked <= set(ways[0].atlases) else Choice(PARAMETERS) for ways in volumes]


def compile_choice(scene: Scene, tracer: Tracer) -> None:
    """Compile, or fetch from the cache on disk, the kernels that measure: by measuring at no point."""
    receivers = draw_receivers(scene, tracer, (), 0, 0, boxes=scene.bounds)
    stands_of(tracer, receivers.places)
    irradiance_at(tracer, np.zeros((1, 10)), samples=0, scrambles=1, seed=0)


def _choose(scene: Scene, tracer: Tracer, ways: Sequence[VolumeData], points: int, threads: int) -> Choice:
    receivers = draw_receivers(scene, tracer, ways[:1], points, _SEED)
    n = len(receivers)
    if n < _FEWEST:
        return Choice(PARAMETERS)
    stands = stands_of(tracer, receivers.places)
    estimates = irradiance_at(tracer, stands, samples=_PATHS, scrambles=_SCRAMBLES, seed=_SEED, threads=threads)
    size = np.linalg.norm(estimates.mean(0), axis=-1)
    if not size.any():
        return Choice(PARAMETERS, n)
    dark = size < _DARK * size.mean()

    def ask(parameters: dict[str, float], resolution: int = 0) -> F64:
        return sample([replace(ways[resolution], parameters=parameters)], receivers.positions, receivers.normals).irradiance

    def light_in_the_dark(answers: F64) -> float:
        return float(np.linalg.norm(answers[dark], axis=-1).mean()) if dark.any() else 0.0

    default = ask(PARAMETERS)
    best = _Tried(PARAMETERS, relative_squares(default, estimates, bounded=True))
    before, darkest = best.squares, light_in_the_dark(default)
    # What a probe counts for that does not see the point, and where from that is asked; then how gradually, which matters least.
    for names, values in (
        (("normal_bias", "visibility_floor"), itertools.product(BIASES, FLOORS)),
        (("visibility_softness",), ((fade,) for fade in FADES)),
    ):
        kept = best.parameters
        for value in values:
            parameters = {**kept, **dict(zip(names, value, strict=True))}
            answers = ask(parameters)
            squares = relative_squares(answers, estimates, bounded=True)
            if squares.mean() < best.squares.mean() and light_in_the_dark(answers) <= darkest:
                best = _Tried(parameters, squares)
    change = best.squares - before
    if change.mean() + _SURE * change.std() / np.sqrt(len(change)) >= -_WORTH * before.mean():
        best = _Tried(PARAMETERS, before)
    error, resolution = float(best.squares.mean()), 0
    if len(ways) > 1:
        enough, darkest = (1 + _MARGIN) * error, light_in_the_dark(ask(best.parameters)) + _LET_IN * float(size.mean())
        for fewer in _as_the_highest(scene, tracer, ways, best.parameters):
            answers = ask(best.parameters, fewer)
            found = float(relative_squares(answers, estimates, bounded=True).mean())
            if found <= enough and light_in_the_dark(answers) <= darkest:
                error, resolution = found, fewer
    return Choice(best.parameters, n, resolution, error, float(before.mean()))


def _as_the_highest(scene: Scene, tracer: Tracer, ways: Sequence[VolumeData], parameters: dict[str, float]) -> list[int]:
    """Which of the lower resolutions answer as the highest does, to a hundredth in the mean of relative squares.

    Not bounded: one nook that is lit from next door is a small part of any other mean. And nothing is traced, so many points are asked.
    """
    receivers = draw_receivers(scene, tracer, ways[:1], _MANY, _SEED)
    highest, *others = (sample([replace(way, parameters=parameters)], receivers.positions, receivers.normals).irradiance for way in ways)
    if not highest.any():
        return []
    # As many estimates as are asked for, all the same: an answer has no noise.
    truth = np.broadcast_to(highest, (_SCRAMBLES, *highest.shape))
    return [i for i, answers in enumerate(others, 1) if relative_squares(answers, truth).mean() <= _OFF]


class _Tried(NamedTuple):
    """Parameters, and the squared errors (n,) that they give."""

    parameters: dict[str, float]
    squares: F64
