"""What a bake has gathered: one shard's sums for one pass, and the whole bake's state between passes.

Both turn into bytes and back, so that a service can commit them and go on after a restart. Adding is done in one order only (passes in
turn, probes apart), so the sums are the same bits however the work was split.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from bake_core.convergence import relative_error

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class _Bytes:
    """Dataclasses of arrays and integers as .npz bytes; the same bytes for the same values."""

    def to_bytes(self) -> bytes:
        out = io.BytesIO()
        np.savez(out, allow_pickle=False, **{f.name: getattr(self, f.name) for f in fields(self)})  # type: ignore[arg-type]
        return out.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            values = {f.name: stored[f.name] for f in fields(cls)}  # type: ignore[arg-type]
        return cls(**{k: int(v) if v.ndim == 0 else v for k, v in values.items()})


@dataclass(frozen=True)
class Tally(_Bytes):
    """One shard's part of one pass.

    Attributes
    ----------
    first_probe, end_probe : int
        Half-open range of probes, numbered through the bake.
    first_sample, end_sample : int
        Half-open range of samples.
    irradiance : (p, scrambles, m, 3) float64
        Sums.
    radiance : (p, capture texels, 3) float64
        Sums, or (0, 0, 0).
    visibility : (p, v, v, 2) float32
        Moments; of the first pass only, else (0, 0, 0, 0). So are the next three.
    backface : (p,) float32
    distance : (p, d²) float32 or (0, 0)
    normal : (p, n², 3) float32 or (0, 0, 0)
    rays : int
        Traced for all of it.
    """

    first_probe: int
    end_probe: int
    first_sample: int
    end_sample: int
    irradiance: F64
    radiance: F64
    visibility: F32
    backface: F32
    distance: F32
    normal: F32
    rays: int


@dataclass
class State(_Bytes):
    """Everything gathered so far, for all probes; arrays as in :class:`Tally`."""

    samples: int
    irradiance: F64
    radiance: F64
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
            self.irradiance[probes] += t.irradiance
            self.rays += t.rays
            if self.radiance.size:
                self.radiance[probes] += t.radiance
            if first == 0:
                self.backface[probes] = t.backface
                for name in ("visibility", "distance", "normal"):
                    if getattr(self, name).size:
                        getattr(self, name)[probes] = getattr(t, name)
        self.samples = end

    def active(self) -> NDArray[np.bool_]:
        """(n,) bool: probes that stand outside geometry."""
        return self.backface < BACKFACE_LIMIT

    def mean(self) -> F64:
        """(n, m, 3) irradiance of every texel."""
        mean: F64 = self.irradiance.sum(1) / self.samples
        return mean

    def scramble_means(self) -> F64:
        """(n, scrambles, m, 3) what each scramble alone says of it; NaN where it has had no sample."""
        scrambles = self.irradiance.shape[1]
        drawn = np.array([-(-(self.samples - i) // scrambles) for i in range(scrambles)], np.float64)
        with np.errstate(invalid="ignore"):
            return self.irradiance / drawn[:, None, None]

    def error(self) -> float | None:
        """DESIGN's error figure; None while it cannot be measured."""
        return relative_error(self.irradiance, self.samples, self.active())


# A probe that sees back faces over more than a quarter of its sphere stands inside something, or behind it. RTXGI's default, which
# its documentation gives for the same test; a probe beside an open box sees less than that of its back.
BACKFACE_LIMIT = 0.25
