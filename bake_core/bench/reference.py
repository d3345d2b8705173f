"""What a race is judged by: radiance and irradiance of some of a spec's probes, in two independent halves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.bundle import Bundle
from bake_core.errors import InputError
from bake_core.octahedral import convolved

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# relMSE = mean((x - r)² / (r² + ε)): what is darker than 0.1 counts as if it were that bright, or one black texel would outweigh all.
EPSILON = 0.01


class Maps(NamedTuple):
    """Of some probes.

    Attributes
    ----------
    radiance : (..., side, side, 3) float64
    irradiance : (..., m, m, 3) float64
        Over π: what radiance of all directions alike would give, so that both are judged alike.
    """

    radiance: F64
    irradiance: F64

    def of(self, chosen: I64) -> Maps:
        """Of some of its probes."""
        return Maps(*(maps[chosen] for maps in self))


def stored_maps(bundle: Bundle) -> Maps:
    """Every probe's maps as a bundle has them; zero where a probe has none."""
    found = []
    for output, scale in (("radiance", 1.0), ("irradiance", np.pi)):
        tiles = []
        for v in bundle.volumes:
            maps = v.maps(output)
            tiles.append(np.zeros((len(v.states), *maps.shape[1:])))
            tiles[-1][v.states == 1] = maps / scale
        found.append(np.concatenate(tiles))
    return Maps(*found)


def convolved_maps(radiance: F64, m: int) -> Maps:
    """What texels of radiance say of irradiance in m × m directions: each one's mean times the cosine's exact integral over it."""
    return Maps(radiance, convolved(radiance, m) / np.pi)


@dataclass(frozen=True)
class Reference:
    """Of the probes `chosen`; the maps of `halves` have one more axis in front, of 1 or 2 independent runs."""

    chosen: I64
    halves: Maps
    words: str

    @property
    def mean(self) -> Maps:
        return Maps(*(np.asarray(half.mean(0)) for half in self.halves))

    def noise(self) -> float | None:
        """Its own relMSE of radiance: either half is as far from their mean as that, in the mean, is from the truth."""
        return relative_mse(self.halves.radiance[0], self.mean.radiance) if len(self.halves.radiance) > 1 else None

    def keep(self, path: Path) -> None:
        """Into an .npz that :func:`read_reference` takes."""
        path.parent.mkdir(parents=True, exist_ok=True)
        radiance, irradiance = (half.astype(np.float32) for half in self.halves)
        np.savez(path, chosen=self.chosen, radiance=radiance, irradiance=irradiance)


def relative_mse(found: F64, truth: F64) -> float:
    """Mean of (x - r)² / (r² + ε)."""
    return float(((found - truth) ** 2 / (truth**2 + EPSILON)).mean())


def read_reference(path: Path, probes: int, side: int, m: int) -> Reference:
    """One that was kept.

    Parameters
    ----------
    probes, side, m : int
        Of the race that it shall judge; texels along the sides of maps of radiance and irradiance.

    Raises
    ------
    InputError
        ``bench.bad_reference``.
    """
    what = (
        f"must be an .npz with chosen (n,) below {probes}, radiance (1 or 2, n, {side}, {side}, 3) and irradiance over π, "
        f"(…, n, {m}, {m}, 3); delete it to have it made anew"
    )
    try:
        with np.load(path, allow_pickle=False) as stored:
            chosen = stored["chosen"].astype(np.int64)
            halves = Maps(*(stored[name].astype(np.float64) for name in Maps._fields))
    except (OSError, ValueError, KeyError) as e:
        raise InputError("bench.bad_reference", what, str(path)) from e
    right = chosen.ndim == 1 and len(chosen) and chosen.min() >= 0 and chosen.max() < probes
    for maps, texels in zip(halves, (side, m), strict=True):
        right = right and len(maps) in (1, 2) and len(maps) == len(halves[0]) and bool(np.isfinite(maps).all())
        right = right and maps.shape[1:] == (len(chosen), texels, texels, 3)
    if not right:
        raise InputError("bench.bad_reference", what, str(path))
    return Reference(chosen, halves, f"{path.name}, {len(halves.radiance)} runs at {len(chosen)} probes")
