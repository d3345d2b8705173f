"""What a bake has gathered: one shard's sums for one pass, and the whole bake's state between passes.

Both turn into bytes and back, so that a service can commit them and go on after a restart. Adding is done in one order only (passes in
turn, probes apart), so the sums are the same bits however the work was split.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.allocation import HALVES, PILOT_SAMPLES, SCRAMBLES, SCRAMBLES_PER_HALF, Allocation, densities, of_half, of_scramble
from bake_core.convergence import Spread, interval, relative_error, spread
from bake_core.spec import Stop
from bake_core.stored import Stored

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Tally(Stored):
    """One shard's part of one pass.

    Of a probe inside a solid only `backface` is known, of one that is not needed nothing: the k probes of sums and maps are the shard's
    active ones, in order.

    Attributes
    ----------
    first_probe, end_probe : int
        Half-open range of the p probes, numbered through the bake.
    first_sample, end_sample : int
        Half-open range of samples.
    taken : (p, HALVES) int64
        Samples that each half has had at its end.
    irradiance : (k, SCRAMBLES, m, 3) float32
        Sums.
    radiance : (k, HALVES, capture texels, 3) float32
        Sums, or (0, 0, 0, 0).
    visibility : (k, v, v, 3) float32
        Moments, and walls; of the first pass only, else (0, 0, 0, 0). So are the next three.
    backface : (p,) float32
    distance : (k, d²) float32 or (0, 0)
    normal : (k, n², 3) float32 or (0, 0, 0)
    rays : int
        Traced for all of it.
    learning : int
        Rays beside them, of what the light cache has learnt for all of the pass: its first shard tells of them.
    """

    first_probe: int
    end_probe: int
    first_sample: int
    end_sample: int
    taken: I64
    irradiance: F32
    radiance: F32
    visibility: F32
    backface: F32
    distance: F32
    normal: F32
    rays: int
    learning: int


@dataclass
class State(Stored):
    """Everything gathered so far, for all n probes; arrays as in :class:`Tally`, zeros for probes that are not active.

    Attributes
    ----------
    samples : int
        Of the probes that got most.
    eighths : (n, HALVES) int64
        How densely each probe's halves are sampled: :class:`bake_core.allocation.Allocation`.
    needed : (n,) bool
        Which probes are baked, if they stand outside solids.
    """

    samples: int
    taken: I64
    eighths: I64
    needed: NDArray[np.bool_]
    irradiance: F32
    radiance: F32
    visibility: F32
    backface: F32
    distance: F32
    normal: F32
    rays: int

    def add(self, tallies: Sequence[Tally]) -> None:
        """Add one whole pass.

        Raises
        ------
        ValueError
            Where the tallies are not one pass that follows what is here, or leave out a probe.
        """
        ordered = sorted(tallies, key=lambda t: t.first_probe)
        ranges = {(t.first_sample, t.end_sample) for t in ordered}
        edges = [0] + [t.end_probe for t in ordered]
        if len(ranges) != 1 or [t.first_probe for t in ordered] != edges[:-1] or edges[-1] != len(self.irradiance):
            raise ValueError("these tallies are not one pass over all probes")
        first, end = ranges.pop()
        if first != self.samples:
            raise ValueError(f"a pass from sample {first} does not follow {self.samples} samples")
        for t in ordered:
            probes = slice(t.first_probe, t.end_probe)
            if first == 0:
                self.backface[probes] = t.backface
            kept = t.first_probe + np.flatnonzero(self.active()[probes])
            self.taken[probes] = t.taken
            self.irradiance[kept] += t.irradiance
            self.rays += t.rays + t.learning
            if self.radiance.size:
                self.radiance[kept] += t.radiance
            if first == 0:
                for name in ("visibility", "distance", "normal"):
                    if getattr(self, name).size:
                        getattr(self, name)[kept] = getattr(t, name)
        if first == 0:
            # Of what is inside a solid, or needed by nobody, nothing is ever shown.
            self.eighths[~self.active()] = 0
        self.samples = end

    def active(self) -> NDArray[np.bool_]:
        """(n,) bool: probes that are needed and stand outside geometry."""
        return self.needed & outside(self.backface)

    @property
    def allocation(self) -> Allocation:
        """What the next pass means for each probe."""
        return Allocation(self.taken, self.eighths)

    def allocate(self, stop: Stop) -> None:
        """Decide, once the pilot is over, how densely to sample each probe: only where there is an error to reach."""
        if stop.target_error is None or self.samples != PILOT_SAMPLES:
            return
        active = self.active()
        rates = np.zeros((len(active), HALVES))
        drawn = self._drawn()
        for half in range(HALVES):
            own = spread(self.irradiance[active], drawn[active], self._share()[active], half)
            rates[active, half] = own.relative() * PILOT_SAMPLES / HALVES
        self.eighths[active] = densities(rates[active], stop.target_error, stop.max_samples)

    def mean(self, probes: slice | I64 = slice(None)) -> F64:
        """(p, m, 3) irradiance of every texel of some probes."""
        weight = np.repeat(self._per_sample()[probes], SCRAMBLES_PER_HALF, 1)
        mean: F64 = np.einsum("psmc,ps->pmc", self.irradiance[probes], weight)
        return mean

    def mean_radiance(self, probes: slice | I64 = slice(None)) -> F64:
        """(p, capture texels, 3) radiance of every texel of some probes; only where it is kept."""
        mean: F64 = np.einsum("phtc,ph->ptc", self.radiance[probes], self._per_sample()[probes])
        return mean

    def scramble_means(self, probes: slice | I64 = slice(None)) -> F64:
        """(p, SCRAMBLES, m, 3) what each scramble alone says of some probes' irradiance; NaN where it has had no sample."""
        with np.errstate(invalid="ignore"):
            return self.irradiance[probes] / self._drawn()[probes][..., None, None].astype(np.float64)

    def spread(self) -> Spread | None:
        """What the scrambles say of active probes' irradiance; None while not every scramble has had a sample."""
        if self.samples < SCRAMBLES:
            return None
        active = self.active()
        return spread(self.irradiance[active], self._drawn()[active], self._share()[active])

    def mean_interval(self) -> tuple[F64, F64]:
        """(n,) float64 twice: each probe's mean irradiance over texels and colours, and half of its 95 % confidence interval.

        For as many samples as there are scrambles, or more.
        """
        return interval(self.scramble_means().mean((2, 3)), self._share(), self._ratio())

    def texel_interval(self) -> tuple[F64, F64]:
        """(n, m, 3) float64 twice: as :meth:`mean_interval`, of each texel and colour."""
        return interval(self.scramble_means(), self._share(), self._ratio())

    def error(self) -> float | None:
        """DESIGN's error figure; None while it cannot be measured."""
        found = self.spread()
        return None if found is None else relative_error(found)

    def radiance_error(self) -> float | None:
        """As :meth:`error`, of radiance texels: what two halves say of each; None where radiance is not kept or a half has no sample.

        A texel counts as one number, not a probe: its paths are its own, and one degree of freedom says little of a few probes.
        """
        if not self.radiance.size or self.samples < HALVES:
            return None
        active = self.active()
        a, b = np.moveaxis(self.radiance[active] / self.taken[active][:, :, None, None].astype(np.float64), 1, 0)
        square, variance = (((x / 2) ** 2).sum(-1).reshape(-1, 1) for x in (a + b, a - b))
        return relative_error(Spread(square, variance, HALVES - 1))

    def probe_errors(self) -> F64:
        """(n,) float64: each probe's own relative RMS standard error; NaN for inactive ones, and while it cannot be measured."""
        out = np.full(len(self.backface), np.nan)
        found = self.spread()
        if found is not None:
            out[self.active()] = np.sqrt(found.relative())
        return out

    def mean_samples(self) -> float:
        """Of a texel of an active probe."""
        taken = self.taken[self.active()]
        return float(taken.sum(1).mean()) if len(taken) else float(self.samples)

    def uniform_samples(self) -> float | None:
        """How many samples every texel would need for the same error, if all had as many; None while that cannot be measured.

        Each probe's variance is taken to be inversely proportional to its samples, as that of independent ones is.
        """
        found = self.spread()
        if found is None:
            return None
        variance, taken = found.relative(), self.taken[self.active()].sum(1)
        whole = float(variance.sum())
        return float((variance * taken).sum()) / whole if whole > 0 else self.mean_samples()

    def _ratio(self) -> float:
        found = self.spread()
        return 1.0 if found is None else found.ratio

    def _per_sample(self) -> F64:
        """(n, HALVES) float64: what a sample weighs. Halves count alike whatever their numbers of samples: no value has a say in that."""
        nominal = np.array([of_half(self.samples, half) for half in range(HALVES)]) / max(self.samples, 1)
        weight: F64 = nominal / np.maximum(self.taken, 1)
        return weight

    def _drawn(self) -> I64:
        """(n, SCRAMBLES) int64: samples of each scramble."""
        drawn: I64 = of_scramble(self.taken[:, :, None], np.arange(SCRAMBLES_PER_HALF))
        return drawn.reshape(-1, SCRAMBLES)

    def _share(self) -> F64:
        """(n, SCRAMBLES) float64: of the estimate."""
        share: F64 = np.repeat(self._per_sample(), SCRAMBLES_PER_HALF, 1) * self._drawn()
        return share


# A probe that sees back faces over more than a quarter of its sphere stands inside something, or behind it. RTXGI's default, which
# its documentation gives for the same test; a probe beside an open box sees less than that of its back.
BACKFACE_LIMIT = 0.25


def outside(backface: F32) -> NDArray[np.bool_]:
    """Which probes stand outside geometry, by the fraction of their spheres that sees backs."""
    return backface < BACKFACE_LIMIT
