"""The irradiance query in numpy: what ``shaders/irradiance.glsl`` computes, for thousands of points at once.

Every function mirrors the GLSL function of the same name; see there for the papers. Texels are the bundle's float32; everything
else is float64, so differences from GLSL are GLSL's rounding (tests hold them to 5e-6 of a volume's brightest texel).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.octahedral import dir_to_oct
from bake_core.placement import cover
from bake_core.shader_constants import finest_first, probe_texels, surface_bias

if TYPE_CHECKING:
    from bake_core.bundle import Atlas, VolumeData
    from bake_core.placement import Volume

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# As in shaders/irradiance.glsl.
FACING_FLOOR = 0.2
CRUSH_THRESHOLD = 0.2
# Points at once: bounds the memory of the 8 corners' texels to some 100 MB.
CHUNK = 1 << 16


@dataclass(frozen=True)
class Samples:
    """Irradiance at n points, and how it came about.

    Attributes
    ----------
    irradiance : (n, 3) float64
        E, no 1/π inside; everything but the direct light of punctual and directional lights.
    weights : (n, 8 k) float64
        Of the probes around each point, eight for each of the volumes that answer, k being the most that do for any point. They sum
        to 1, or are all 0 where no probe is active.
    probes : (n, 8 k) int64
        Flat indices of those probes within their volumes. Corner c is the upper one along x, y, z where its bits 0, 1, 2 are set.
    volumes : (n, 8 k) int64
        Indices of their volumes.
    volume : (n,) int64
        Index of the finest volume around each point; of the nearest one where none is.
    shares : (volumes, n) float64
        How much each volume's answer counts; they sum to 1, or are all 0.
    """

    irradiance: F64
    weights: F64
    probes: I64
    volumes: I64
    volume: I64
    shares: F64


def sample(
    volumes: Sequence[VolumeData], positions: ArrayLike, normals: ArrayLike, wo: ArrayLike | None = None, toward: ArrayLike | None = None
) -> Samples:
    """Irradiance at surface points. Mirrors ``obIrradiance`` and ``obIrradianceToward``.

    Parameters
    ----------
    volumes : sequence of VolumeData
        A bundle's, in its order, each with an irradiance atlas.
    positions : (n, 3) float
        World, metres. Any point is valid: outside all volumes the nearest cell of the nearest volume answers.
    normals : (n, 3) float
        Unit. Not renormalised.
    wo : (n, 3) float, optional
        Unit, to the viewer; the normals where left out.
    toward : (n, 3) float, optional
        Unit, the way that the plane faces on which light arrives; the normals where left out.
    """
    positions = np.asarray(positions, np.float64).reshape(-1, 3)
    normals = np.asarray(normals, np.float64).reshape(-1, 3)
    wo, toward = (normals if d is None else np.asarray(d, np.float64).reshape(-1, 3) for d in (wo, toward))
    n, chosen, reach = len(positions), select_volume(volumes, positions), _reach(volumes, positions)
    # One at least: there may be no points.
    k = int((reach > 0).sum(0).max(initial=1))
    weights, probes, owners = np.zeros((n, k, 8)), np.zeros((n, k, 8), np.int64), np.repeat(chosen, 8 * k).reshape(n, k, 8)
    irradiance, slot, rest, shares = np.zeros((n, 3)), np.zeros(n, np.int64), np.ones(n), np.zeros(reach.shape)
    for v in finest_first(volumes):
        volume = volumes[v]
        table = probe_texels(volume).reshape(-1, 4).astype(np.float64)
        of_volume = np.flatnonzero(rest * reach[v] > 0)
        for first in range(0, len(of_volume), CHUNK):
            at = of_volume[first : first + CHUNK]
            light, part, around = _in_volume(volume, table, positions[at], normals[at], wo[at], toward[at])
            answers = part.any(-1)
            share = rest[at] * reach[v, at] * answers
            rest[at] *= 1 - reach[v, at] * answers
            shares[v, at] = share
            irradiance[at] += share[:, None] * light
            weights[at, slot[at]], probes[at, slot[at]], owners[at, slot[at]] = share[:, None] * part, around, v
            # What has no answer leaves its place to the next.
            slot[at] += answers
    k = int(slot.max(initial=1))
    total = np.where(shares.any(0), shares.sum(0), 1)
    return Samples(
        irradiance / total[:, None],
        (weights[:, :k] / total[:, None, None]).reshape(n, 8 * k),
        probes[:, :k].reshape(n, 8 * k),
        owners[:, :k].reshape(n, 8 * k),
        chosen,
        shares / total,
    )


def _reach(volumes: Sequence[VolumeData], positions: F64) -> F64:
    """How far each volume reaches each point, (volumes, n) float64, from 0 to 1. Mirrors the loop of ``obIrradianceToward``.

    A volume reaches all of its box, and over half a spacing beyond it less and less. The finest one has what it reaches, and leaves the
    rest to the next: a fine volume inside a coarse one fades into it, and neighbours fade into each other. What none reaches, the nearest
    has. One whose probes about the point are all inside geometry has no answer, and leaves all of it to the next.
    """
    nearest = select_volume(volumes, positions)
    out = np.empty((len(volumes), len(positions)))
    for v, volume in enumerate(volumes):
        beyond = (_beyond(volume, positions) / (0.5 * volume.spacing)).max(-1)
        # So little for the nearest counts only where it is alone.
        out[v] = np.maximum(1 - np.minimum(beyond, 1), np.where(nearest == v, 1e-20, 0))
    return out


def select_volume(volumes: Sequence[VolumeData], positions: F64) -> I64:
    """Index of the finest volume that contains each point, of the nearest one where none does. Mirrors ``obSelectVolume``."""
    order = np.array(finest_first(volumes), np.int64)
    squared = np.stack([(_beyond(volumes[v], positions) ** 2).sum(-1) for v in order])
    nearest: I64 = order[squared.argmin(0)]
    return nearest


def _beyond(volume: VolumeData, positions: F64) -> F64:
    """How far outside of a volume's box points are along each axis, (n, 3); an axis with one probe reaches half a spacing to both sides."""
    margin = np.where(volume.counts == 1, 0.5, 0.0) * volume.spacing
    p = positions - volume.origin
    out: F64 = np.maximum(np.maximum(-margin - p, p - (volume.counts - 1) * volume.spacing - margin), 0)
    return out


def covered(volumes: Sequence[VolumeData], positions: ArrayLike) -> NDArray[np.bool_]:
    """Whether each point (n, 3) is within half a spacing of a volume's box: where a bundle's light can be held against the truth.

    Farther out, the nearest cell answers, which is defined but no more than a guess.
    """
    positions = np.asarray(positions, np.float64)
    out = np.zeros(len(positions), np.bool_)
    for volume in volumes:
        last = volume.origin + volume.spacing * (np.asarray(volume.counts) - 1)
        beyond = np.maximum(volume.origin - positions, positions - last)
        out |= (beyond <= cover(volume.spacing)).all(-1)
    return out


def cell(volume: VolumeData | Volume, positions: F64) -> tuple[I64, F64]:
    """The cell around each point, the nearest one where it is outside. Mirrors ``obCell``.

    Returns
    -------
    base : (n, 3) int64
        Lattice index of the cell's lowest probe.
    fraction : (n, 3) float64
        In [0, 1], how far through the cell the point is; 0 along an axis with one probe.
    """
    last = np.asarray(volume.counts) - 1
    g = np.clip((positions - volume.origin) / volume.spacing, 0, last)
    base = np.minimum(np.floor(g), np.maximum(last - 1, 0)).astype(np.int64)
    return base, g - base


def corners(volume: VolumeData | Volume, base: I64) -> Iterator[tuple[I64, I64, I64]]:
    """The eight probes of each cell in turn: where they are from the lowest, (3,), on the lattice, (m, 3), and in flat order, (m,)."""
    counts = np.asarray(volume.counts)
    for corner in range(8):
        upper = np.array([corner & 1, corner >> 1 & 1, corner >> 2])
        lattice = np.minimum(base + upper, counts - 1)
        yield upper, lattice, lattice @ np.array([1, counts[0], counts[0] * counts[1]])


def _in_volume(volume: VolumeData, table: F64, positions: F64, normals: F64, wo: F64, toward: F64) -> tuple[F64, F64, I64]:
    """Mirrors ``obIrradianceInVolume``: irradiance, weights and probes; `table` is the volume's probe table, one row a probe."""
    normal_bias, view_bias = surface_bias(volume)
    biased = positions + normals * normal_bias + wo * view_bias

    def weigh(tile: I64, probe: F64) -> F64:
        return crush(facing(probe - positions, normals) * _visibility(volume, tile, biased - probe))

    return blend(volume, table, positions, toward, weigh)


def blend(volume: VolumeData, table: F64, positions: F64, toward: F64, weigh: Callable[[I64, F64], F64]) -> tuple[F64, F64, I64]:
    """Irradiance of the eight probes around points, by trilinear weights (:func:`tent`) times others.

    Parameters
    ----------
    table : (n, 4) float64
        The volume's probe table.
    positions, toward : (m, 3) float64
    weigh : callable
        Of tiles (m,) and of where their probes stand (m, 3) the other weights, (m,).

    Returns
    -------
    irradiance : (m, 3) float64
    weights : (m, 8) float64
        Of the corners; they sum to 1, or are all 0.
    probes : (m, 8) int64
    """
    n = len(positions)
    base, fraction = cell(volume, positions)
    oct_toward = dir_to_oct(toward)
    probes = np.empty((n, 8), np.int64)
    trilinear, other, light = np.empty((n, 8)), np.empty((n, 8)), np.empty((n, 8, 3))
    for corner, (upper, lattice, probe) in enumerate(corners(volume, base)):
        kept = table[probe, 3] > 0
        # A probe without a tile reads the first one, and counts for nothing.
        tile = np.where(kept, table[probe, 3] - 1, 0).astype(np.int64)
        probes[:, corner] = probe
        other[:, corner] = weigh(tile, volume.origin + volume.spacing * lattice + table[probe, :3]) * kept
        trilinear[:, corner] = tent(fraction - upper, table[probe, :3] / volume.spacing)
        light[:, corner] = bilinear(volume.atlases["irradiance"], tile, oct_toward)
    weights = trilinear * other
    # Where nothing is left, the point stands on a probe, an edge or a face of the grid none of whose probes is active.
    weights = np.where(weights.sum(-1, keepdims=True) > 0, weights, other)
    total = weights.sum(-1, keepdims=True)
    weights = np.divide(weights, total, out=np.zeros_like(weights), where=total > 0)
    return (weights[:, :, None] * light).sum(1), weights, probes


def tent(from_lattice: F64, offset: F64) -> F64:
    """Trilinear weights of probes that have been moved. Mirrors ``obTent``.

    Parameters
    ----------
    from_lattice : (m, 3) float64
        From the probe's lattice point to the point asked for, spacings, in [-1, 1].
    offset : (m, 3) float64
        From its lattice point to the probe, spacings, less than 1.
    """
    from_probe = from_lattice - offset
    out: F64 = np.maximum(1 - np.abs(from_probe) / (1 + np.where(from_probe < 0, offset, -offset)), 0).prod(-1)
    return out


def bilinear(atlas: Atlas, tile: I64, oct_xy: NDArray[np.floating]) -> F64:
    """Bilinear look-up in tiles. Mirrors ``obTile``, ``obTileCoordinates`` and a texture unit.

    Parameters
    ----------
    atlas : Atlas
    tile : (n,) int64
    oct_xy : (n, 2) floating
        Points in [-1, 1]^2.

    Returns
    -------
    (n, channels) float64
    """
    row, column = np.divmod(tile, atlas.columns)
    layer, row = np.divmod(row, atlas.rows)
    # Texel centres are at +0.5; the border is the first texel.
    x = 0.5 + (oct_xy[:, 0] * 0.5 + 0.5) * atlas.interior
    y = 0.5 + (oct_xy[:, 1] * 0.5 + 0.5) * atlas.interior
    x0 = np.clip(np.floor(x), 0, atlas.interior).astype(np.int64)
    y0 = np.clip(np.floor(y), 0, atlas.interior).astype(np.int64)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    column, row = column * atlas.tile + x0, row * atlas.tile + y0
    t = atlas.texels
    low = t[layer, row, column] * (1 - fx) + t[layer, row, column + 1] * fx
    high = t[layer, row + 1, column] * (1 - fx) + t[layer, row + 1, column + 1] * fx
    out: F64 = low * (1 - fy) + high * fy
    return out


def facing(to_probe: F64, normals: F64) -> F64:
    """Mirrors ``obFacing``."""
    wrap = 0.5 + 0.5 * (to_probe * normals).sum(-1) / np.maximum(np.linalg.norm(to_probe, axis=-1), 1e-20)
    out: F64 = wrap * wrap + FACING_FLOOR
    return out


def _visibility(volume: VolumeData, tile: I64, from_probe: F64) -> F64:
    """Mirrors ``obVisibility``."""
    out = np.ones(len(tile))
    r = np.linalg.norm(from_probe, axis=-1)
    atlas = volume.atlases.get("walls")
    if atlas is None:
        return out
    apart = np.flatnonzero(r > 0)
    reach = np.abs(from_probe[apart]).sum(-1) * np.minimum(1, volume.distance_limit / r[apart]) / volume.spacing.min()
    behind = bilinear(atlas, tile[apart], dir_to_oct(from_probe[apart]))[:, 0] * reach - 1
    soft = volume.parameters["visibility_softness"] ** 2
    bound = soft / (soft + behind * behind)
    out[apart] = np.where(behind > 0, np.maximum(bound**3, volume.parameters["visibility_floor"]), 1)
    return out


def crush(weight: F64) -> F64:
    """Mirrors ``obCrush``."""
    return np.where(weight < CRUSH_THRESHOLD, weight**3 / CRUSH_THRESHOLD**2, weight)
