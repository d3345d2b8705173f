"""The audit of a bake: a random sample of what was written, held against paths that know nothing of how it was made.

The mean squared error of stored values x against the truth t is estimated from two independent estimates a and b of t:

    E[(x - a) (x - b)] = (x - t)²,

for the errors of a and b are independent of one another and of x: the audit's own noise adds nothing (as in cross-validated error
estimates; Rousselle, Knaus and Zwicker 2012, "Adaptive Rendering with Non-Local Means Filtering", use two half buffers so). What is found
is split into

- sampling: what the bake's own scrambles say of its variance,
- encoding: what was stored less what was to be stored, exactly,
- filtering: the rest. Bias of whatever stands between paths and numbers; at surfaces also interpolation between probes, and leaks.

Products of differences scatter by σ²/√n over n places, σ² being the variance of a and b. For a given number of paths σ² grows with n, so
few places of many paths know more than many of few, as long as they are a fair sample of the bake's errors: enough paths first, then
places.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import SCRAMBLES, uniform
from bake_core.atlas import layout, pack
from bake_core.audit_rays import lobe_moments, sphere_irradiance
from bake_core.bundle import Atlas, VolumeData
from bake_core.capture import Capture, capture_radiance
from bake_core.convergence import DARK_FRACTION, f95, relative_error, spread
from bake_core.irradiance import bilinear, sample
from bake_core.octahedral import dir_to_oct, texel_directions
from bake_core.receiver_irradiance import irradiance_at
from bake_core.receivers import draw_receivers, stands_of
from bake_core.scene import Scene
from bake_core.spec import Spec
from bake_core.tally import State
from bake_core.tracer import Tracer
from bake_core.walls import coarser

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flag = NDArray[np.uint8]

# The share of a bake's time that its audit may take unless it is told otherwise.
DEFAULT_SHARE = 0.03
# Share of the time left that goes to each of them in turn; what is not used goes to those that follow.
_SHARES = {"visibility": 0.1, "radiance": 0.25, "irradiance": 0.6, "surfaces": 1.0}
# Paths from a place that are enough to go on to more places: texels, probes (whole maps of radiance and of irradiance), points.
_ENOUGH = {"visibility": 256, "radiance": 64, "irradiance": 4096, "surfaces": 512}
# So many places are looked at in any case, by so many paths for each estimate, and not more than so many.
_FEWEST, _PILOT_PATHS, _MOST = 8, 8, 512
# Of what is enough: an audit that has all the time in the world ends.
_MORE_THAN_ENOUGH = 4
# A first look that takes this much of the time tells what the rest will take.
_PILOT_SHARE = 0.05
# An audit that would not have seen an error of so many times what is stated cannot confirm it.
_RESOLUTION = 2.0
# Single precision's, of sums: no error below it is anybody's. And what nobody can see, so that no audit need resolve it.
_ROUNDING, _INVISIBLE = 2.0**-20, 1e-3
_SEED = 0xA0D17


@dataclass(frozen=True)
class Figures:
    """Of one output, or of answers at surfaces. Relative root-mean-squares by DESIGN's metric, but for the bias.

    Attributes
    ----------
    places, paths : int
        Texels or points, and paths for each of the two estimates of each (irradiance: of a probe's texels together).
    error, low, high : float
        Of what is stored, and its 95 % confidence interval; `high` None where a single place tells of none.
    sampling, filtering, encoding : float
        Its parts, √ of mean squares that add up to that of `error`; filtering is 0 where the rest is below 0, which noise can make it.
        None where the bake has too few samples to know its sampling error.
    bias, bias_within : float
        Mean of signed relative differences, stored less true, and half its 95 % confidence interval.
    """

    places: int
    paths: int
    error: float
    low: float
    high: float | None
    sampling: float | None
    filtering: float | None
    encoding: float
    bias: float
    bias_within: float | None


@dataclass(frozen=True)
class Audit:
    """What an audit found.

    Attributes
    ----------
    seconds : float
        That it took.
    stated : float or None
        The bake's error figure.
    verdict : str
        ``confirmed``: the error of irradiance texels may be what is stated, and twice that (or 0.1 %) would have been seen.
        ``refuted``: it is more.
        ``unresolved``: too few paths to tell, or nothing was stated.
    texels : dict of str to Figures
        By output: irradiance, radiance, visibility, those of them that are stored. Distances and normals are single rays: there is
        nothing to differ from.
    surfaces : Figures or None
        Of the query at points on surfaces; None where no surface lies inside the volumes, or no irradiance is stored.
    surface_bound : float or None
        Sampling error at those points, a 95 % upper bound as that of texels.
    """

    seconds: float
    stated: float | None
    verdict: str
    texels: dict[str, Figures]
    surfaces: Figures | None
    surface_bound: float | None


@dataclass(frozen=True)
class Baked:
    """What is audited.

    Attributes
    ----------
    volumes : sequence of VolumeData
        Read back from the bundle's files.
    positions, limits : (n, 3) and (n,) float64
        Probes in the local frame, and their distance limits.
    """

    scene: Scene
    spec: Spec
    tracer: Tracer
    state: State
    volumes: Sequence[VolumeData]
    positions: F64
    limits: F64


def audit(
    baked: Baked, seconds: float, *, threads: int, cancelled: Flag | None = None, now: Callable[[], float] = time.perf_counter
) -> Audit:
    """Look at a random sample again.

    Parameters
    ----------
    seconds : float
        What it may take. One small round of each kind is made in any case.
    threads : int
    cancelled : (1,) uint8, optional
        Set it to 1 from any thread to stop.
    now : callable
        Seconds, from wherever.

    Raises
    ------
    Cancelled
    """
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    began = now()
    random = np.random.default_rng([_SEED, baked.spec.seed])
    active = np.flatnonzero(baked.state.active())
    # Visibility is an output that some volumes may have and others not.
    having = {kind: _having(baked.volumes, kind, active) for kind in ("visibility", "radiance", "irradiance")}
    kinds = [kind for kind, probes in having.items() if len(probes)]
    surfaces = "irradiance" in baked.volumes[0].atlases and baked.scene.triangle_count > 0
    texels: dict[str, Figures] = {}
    found: tuple[Figures, float | None] | None = None

    def look(kind: str) -> _Look:
        left = max(began + seconds - now(), 0.0)
        return _Look(kind, now() + _SHARES[kind] * left, now, threads, flag)

    audits = {"visibility": _visibility, "radiance": _radiance, "irradiance": _irradiance}
    for kind in kinds:
        texels[kind] = audits[kind](baked, random, having[kind], look(kind))
    if surfaces:
        found = _surfaces(baked, look("surfaces"))
    stated = baked.state.error()
    figures, bound = found or (None, None)
    return Audit(now() - began, stated, _verdict(stated, texels.get("irradiance")), texels, figures, bound)


@dataclass(frozen=True)
class _Look:
    """At as many places as there is time for, until `end` as `now` tells it."""

    kind: str
    end: float
    now: Callable[[], float]
    threads: int
    flag: Flag

    def at(self, places: int, trace: Callable[[slice, int, int], F64]) -> tuple[F64, int]:
        """Estimates (2, n, …) of the first n places, which stand in no order, and the paths of each.

        Parameters
        ----------
        trace : callable
            Takes places, a number of paths and a seed's number; two independent estimates.
        """
        few = min(_FEWEST * self.threads, places)
        enough, paths, round_ = _ENOUGH[self.kind], _PILOT_PATHS, 0
        while True:
            began = self.now()
            found = [trace(slice(0, few), paths, round_)]
            took, left = self.now() - began, self.end - self.now()
            if paths >= enough or took >= _PILOT_SHARE * left:
                break
            # Too short to tell what the rest will take.
            paths, round_ = 4 * paths, round_ + 1
        total = left / took * few * paths if took > 0 else math.inf
        if total < few * paths:
            return found[0], paths
        count = int(min(max(total / enough, few), places))
        # A power of two, at which Sobol' points are a net.
        paths = 1 << int(math.log2(max(min(total / count, _MORE_THAN_ENOUGH * enough), _PILOT_PATHS)))
        found = []
        for first in range(0, places, few):
            if first >= few and self.now() >= self.end:
                break
            found.append(trace(slice(first, min(first + few, places)), paths, round_ + 1))
        return np.concatenate(found, 1), paths


def _verdict(stated: float | None, found: Figures | None) -> str:
    """Of sampling and filtering together; what storing costs is stated on its own."""
    if stated is None or found is None:
        return "unresolved"
    stated = max(stated, _ROUNDING)
    if found.low**2 - found.encoding**2 > stated**2:
        return "refuted"
    if found.high is None:
        return "unresolved"
    return "confirmed" if found.high**2 - found.encoding**2 <= max(_RESOLUTION * stated, _INVISIBLE) ** 2 else "unresolved"


def _figures(stored: F64, intended: F64, estimates: F64, variance: F64 | None, mean: float, groups: I64, paths: int) -> Figures:
    """Figures from values and two independent estimates of the truth.

    Parameters
    ----------
    stored, intended : (n, c) float64
        What is in the files, and what was to be.
    estimates : (2, n, c) float64
    variance : (n,) float64
        Of `intended`, by the bake's own word, summed over channels; None where it has none.
    mean : float
        Ē of DESIGN's metric.
    groups : (n,) int64
        Places whose errors go together: of one probe, or of one cell.
    """
    scale = (stored**2).sum(-1) + (DARK_FRACTION * mean) ** 2
    # Nothing at all is dark: what differs from black is then wrong outright.
    scale = np.where(scale > 0, scale, 1.0)
    square, within = _mean((((stored - estimates[0]) * (stored - estimates[1])).sum(-1)) / scale, groups)
    size = np.sqrt(scale)
    bias, bias_within = _mean((stored - estimates.mean(0)).sum(-1) / np.maximum(size, 1e-300) / math.sqrt(stored.shape[-1]), groups)
    sampling = None if variance is None else float((variance / scale).mean())
    encoding = float((((stored - intended) ** 2).sum(-1) / scale).mean())
    return Figures(
        places=len(stored),
        paths=paths,
        error=math.sqrt(max(square, 0.0)),
        low=math.sqrt(max(square - within, 0.0)),
        high=math.sqrt(max(square + within, 0.0)) if math.isfinite(within) else None,
        sampling=None if sampling is None else math.sqrt(sampling),
        filtering=None if sampling is None else math.sqrt(max(square - sampling - encoding, 0.0)),
        encoding=math.sqrt(encoding),
        bias=bias,
        bias_within=bias_within if math.isfinite(bias_within) else None,
    )


def _mean(values: F64, groups: I64) -> tuple[float, float]:
    """A mean and half its 95 % confidence interval, for values that go together in groups (Liang and Zeger 1986's sandwich)."""
    mean = float(values.mean())
    _, group = np.unique(groups, return_inverse=True)
    # All of one group: nothing tells how far they go together.
    sums = np.bincount(group, values - mean) if group.any() else values - mean
    count = len(sums)
    if count < 2:
        return mean, math.inf
    variance = float((sums**2).sum()) / len(values) ** 2 * count / (count - 1)
    return mean, math.sqrt(float(f95(1.0, float(max(count - 1, 3)))) * variance)


def _volume_of(volumes: Sequence[VolumeData], probes: I64) -> tuple[I64, I64]:
    """Which volume each probe of the bake is of, and its number there."""
    first = np.cumsum([0] + [len(v.states) for v in volumes])
    of = np.searchsorted(first, probes, "right") - 1
    return of.astype(np.int64), probes - first[of]


def _having(volumes: Sequence[VolumeData], output: str, probes: I64) -> I64:
    """Those probes whose volume has an output."""
    has = np.array([output in v.atlases for v in volumes])
    of, _ = _volume_of(volumes, probes)
    return probes[np.flatnonzero(has[of])]


def _stored(volumes: Sequence[VolumeData], output: str, probes: I64, texels: I64) -> F64:
    """(n, c) float64: texels out of a bundle's atlases, by the bake's probe number and the texel's."""
    of, probe = _volume_of(volumes, probes)
    tiles = [v.tiles for v in volumes]
    rows = []
    for v, p, texel in zip(of, probe, texels, strict=True):
        atlas, tile = volumes[v].atlases[output], int(tiles[v][p])
        row, column = divmod(int(texel), atlas.interior)
        tile_row, tile_column = divmod(tile % (atlas.columns * atlas.rows), atlas.columns)
        layer = tile // (atlas.columns * atlas.rows)
        rows.append(atlas.texels[layer, tile_row * atlas.tile + 1 + row, tile_column * atlas.tile + 1 + column])
    return np.asarray(rows, np.float64)


def _irradiance(baked: Baked, random: np.random.Generator, active: I64, look: _Look) -> Figures:
    """Of all texels of some probes."""
    side = baked.volumes[0].atlases["irradiance"].interior
    probes = random.permutation(active)[:_MOST]
    positions = np.ascontiguousarray(baked.positions[probes])
    normals = texel_directions(side).reshape(-1, 3)

    def trace(some: slice, paths: int, round_: int) -> F64:
        seed = _seed(baked.spec, "irradiance", round_, some.start)
        return sphere_irradiance(baked.tracer, positions[some], normals, paths, seed, threads=look.threads, cancelled=look.flag)

    estimates, paths = look.at(len(probes), trace)
    probes = probes[: estimates.shape[1]]
    groups, texels = np.repeat(probes, side**2), np.tile(np.arange(side**2), len(probes))
    whole = baked.state.spread()
    intended = np.maximum(baked.state.mean(probes), 0).reshape(-1, 3)
    variance, mean = None, float(np.sqrt((intended**2).sum(-1)).mean())
    if whole is not None:
        variance, mean = whole.variance[np.searchsorted(active, probes)].reshape(-1), float(np.sqrt(whole.square).mean())
    stored = _stored(baked.volumes, "irradiance", groups, texels)
    return _figures(stored, intended, estimates.reshape(2, -1, 3), variance, mean, groups, paths)


def _radiance(baked: Baked, random: np.random.Generator, active: I64, look: _Look) -> Figures:
    """Of whole maps of some probes, by other samples through the same texels: the bake's own kernel, with no filter in between."""
    side = baked.volumes[0].atlases["radiance"].interior
    probes = random.permutation(active)[:_MOST]
    positions = np.ascontiguousarray(baked.positions[probes])

    def trace(some: slice, paths: int, round_: int) -> F64:
        capture = Capture(side, 1, _seed(baked.spec, "radiance", round_), keep_radiance=True)
        at, ids = positions[some], probes[some].astype(np.uint64)
        _, sums, _ = capture_radiance(
            baked.tracer,
            at,
            ids,
            uniform(len(at), (0, 2 * paths)),
            capture,
            threads=look.threads,
            cancelled=look.flag,
            advance=lambda fraction: None,
        )
        return np.moveaxis(sums, 1, 0) / paths

    estimates, paths = look.at(len(probes), trace)
    probes = probes[: estimates.shape[1]]
    groups, texels = np.repeat(probes, side**2), np.tile(np.arange(side**2), len(probes))
    halves = baked.state.radiance[probes] / np.maximum(baked.state.taken[probes], 1)[:, :, None, None].astype(np.float64)
    intended = baked.state.mean_radiance(probes).reshape(-1, 3)
    variance = (((halves[:, 0] - halves[:, 1]) / 2) ** 2).sum(-1).reshape(-1)
    mean = float(np.sqrt((intended**2).sum(-1)).mean())
    stored = _stored(baked.volumes, "radiance", groups, texels)
    return _figures(stored, intended, estimates.reshape(2, -1, 3), variance, mean, groups, paths)


def _visibility(baked: Baked, random: np.random.Generator, active: I64, look: _Look) -> Figures:
    """Of both moments, in units of the distance limit and its square, so that the two are numbers of one kind.

    Where volumes' resolutions differ, of those that have the first one's.
    """
    sides = np.array([v.atlases["visibility"].interior if "visibility" in v.atlases else 0 for v in baked.volumes])
    side = int(sides[sides > 0][0])
    of, _ = _volume_of(baked.volumes, active)
    active = active[sides[of] == side]
    # Each probe at most once while there are enough of them.
    probes = np.concatenate([random.permutation(active) for _ in range(-(-_FEWEST // len(active)))])[:_MOST]
    texels = random.integers(0, side**2, len(probes))
    directions = np.ascontiguousarray(texel_directions(side).reshape(-1, 3)[texels])
    positions, limits = np.ascontiguousarray(baked.positions[probes]), baked.limits[probes]

    def trace(some: slice, paths: int, round_: int) -> F64:
        seed = _seed(baked.spec, "visibility", round_, some.start)
        return lobe_moments(baked.tracer, positions[some], directions[some], limits[some], paths, seed, look.flag)

    estimates, paths = look.at(len(probes), trace)
    some = slice(0, estimates.shape[1])
    probes, texels, unit = probes[some], texels[some], np.stack([limits[some], limits[some] ** 2], -1)
    stored = _stored(baked.volumes, "visibility", probes, texels) / unit
    maps = baked.state.visibility[probes]
    if side != maps.shape[1]:
        maps = coarser(maps, side)
    intended = maps[..., :2].reshape(len(probes), -1, 2)[np.arange(len(probes)), texels] / unit
    mean = float(np.sqrt((stored**2).sum(-1)).mean())
    return _figures(stored, intended, estimates / unit, np.zeros(len(probes)), mean, probes, paths)


def _surfaces(baked: Baked, look: _Look) -> tuple[Figures, float | None] | None:
    """Of the query at points on surfaces; and the bound of its sampling error."""
    receivers = draw_receivers(baked.scene, baked.tracer, baked.volumes, _MOST, _seed(baked.spec, "receivers", 0), cancelled=look.flag)
    if not len(receivers):
        return None
    stands = stands_of(baked.tracer, receivers.places)

    def trace(some: slice, paths: int, round_: int) -> F64:
        seed = _seed(baked.spec, "surfaces", round_, some.start)
        at = np.ascontiguousarray(stands[some])
        return irradiance_at(baked.tracer, at, samples=paths, scrambles=2, seed=seed, threads=look.threads, cancelled=look.flag)

    estimates, paths = look.at(len(receivers), trace)
    n = estimates.shape[1]
    answers = sample(baked.volumes, receivers.positions[:n], receivers.normals[:n])
    scrambles = _answers_of_scrambles(baked, receivers.normals[:n], answers.volumes, answers.probes, answers.weights)
    mean = float(np.sqrt((answers.irradiance**2).sum(-1)).mean())
    if baked.state.samples < SCRAMBLES:
        return _figures(answers.irradiance, answers.irradiance, estimates, None, mean, answers.probes[:, 0], paths), None
    ones = np.ones((n, SCRAMBLES), np.int64)
    found = spread(scrambles[:, :, None, :], ones, ones / SCRAMBLES)
    groups = answers.probes[:, 0]
    figures = _figures(answers.irradiance, scrambles.mean(1), estimates, found.variance[:, 0], mean, groups, paths)
    return figures, relative_error(found)


def _answers_of_scrambles(baked: Baked, normals: F64, volumes: I64, probes: I64, weights: F64) -> F64:
    """(n, SCRAMBLES, 3): what the query would answer from each scramble alone; it is linear in irradiance, its weights know none of it."""
    first = np.cumsum([0] + [len(v.states) for v in baked.volumes])
    touched, index = np.unique(probes + first[volumes], return_inverse=True)
    index = index.reshape(probes.shape)
    side = baked.volumes[0].atlases["irradiance"].interior
    means = baked.state.scramble_means(touched)
    # Probes inside solids have no samples, and weigh nothing.
    means[~baked.state.active()[touched]] = 0
    interior = means.reshape(len(touched) * SCRAMBLES, side, side, 3).astype(np.float32)
    shape = layout((len(interior), 1, 1), side + 2)
    atlas = Atlas("irradiance", pack(interior, shape), side + 2, side, shape.columns, shape.rows, shape.layers, "float")
    toward = dir_to_oct(normals)
    out = np.zeros((len(normals), SCRAMBLES, 3))
    for scramble in range(SCRAMBLES):
        for corner in range(probes.shape[1]):
            light = bilinear(atlas, index[:, corner] * SCRAMBLES + scramble, toward)
            out[:, scramble] += weights[:, corner, None] * light
    return out


def _seed(spec: Spec, what: str, *numbers: int) -> int:
    """None that a bake's samples have, and another for each use."""
    return int(np.random.SeedSequence([_SEED, spec.seed, *what.encode(), *numbers]).generate_state(1, np.uint64)[0])


def compile_audit(tracer: Tracer) -> None:
    """Compile, or fetch from the cache on disk, the kernels of an audit, but for those of :func:`bake_core.parameters.compile_choice`."""
    nothing = np.zeros((0, 3))
    one = np.zeros((1, 3))
    sphere_irradiance(tracer, one, one, 0, 0, threads=1, cancelled=np.zeros(1, np.uint8))
    lobe_moments(tracer, nothing, nothing, np.zeros(0), 0, 0, np.zeros(1, np.uint8))
