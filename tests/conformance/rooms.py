"""Rooms made of boxes, and what probes in them see: distances, normals and radiance in closed form, without a bake."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.atlas import layout, pack
from bake_core.bundle import Atlas, VolumeData
from bake_core.octahedral import texel_directions
from tests.conformance import synthetic

F64 = NDArray[np.float64]
MISS = 64.0


@dataclass(frozen=True)
class Room:
    """A box that one is inside of, and solid boxes in it, each (low, high); without its upper side it is open to the sky."""

    walls: tuple[Sequence[float], Sequence[float]] = ((-2.0, 0.0, -2.0), (2.0, 3.0, 2.0))
    solids: tuple[tuple[Sequence[float], Sequence[float]], ...] = ()
    open_top: bool = False

    def hit(self, origins: ArrayLike, directions: ArrayLike) -> tuple[F64, F64]:
        """Distance (inf for none) and normal of what rays from inside meet first, (n,) and (n, 3)."""
        o, d = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = ((np.asarray(corner, np.float64) - o) / d for corner in self.walls)
            leave = np.where(d == 0, np.inf, np.maximum(low, high))
            axis = leave.argmin(-1)
            distance = leave.min(-1)
            normal = -np.sign(np.take_along_axis(d, axis[:, None], 1)) * np.eye(3)[axis]
            if self.open_top:
                distance = np.where((axis == 1) & (d[:, 1] > 0), np.inf, distance)
            for box in self.solids:
                low, high = ((np.asarray(corner, np.float64) - o) / d for corner in box)
                near = np.where(d == 0, -np.inf, np.minimum(low, high))
                far = np.where(d == 0, np.inf, np.maximum(low, high))
                axis, enters = near.argmax(-1), near.max(-1)
                met = (enters > 0) & (enters < far.min(-1)) & (enters < distance)
                distance = np.where(met, enters, distance)
                normal = np.where(met[:, None], -np.sign(np.take_along_axis(d, axis[:, None], 1)) * np.eye(3)[axis], normal)
        return np.asarray(distance), np.where(np.isfinite(distance)[:, None], normal, 0.0)

    def inside(self, points: F64) -> NDArray[np.bool_]:
        """Whether points are in a solid or outside the walls."""
        walls = [np.asarray(corner) for corner in self.walls]
        out = np.asarray(~((points > walls[0]) & (points < walls[1])).all(-1), np.bool_)
        for low, high in self.solids:
            out |= ((points >= np.asarray(low)) & (points <= np.asarray(high))).all(-1)
        return out


def radiance(points: F64) -> F64:
    """Of a surface at a point: smooth, and different everywhere."""
    return np.asarray(1 + 0.5 * np.sin(points @ np.array([[1.0, 0.3, 0.2], [0.2, 1.1, 0.4], [0.5, 0.1, 0.9]])))


def volume(
    room: Room,
    origin: Sequence[float],
    spacing: Sequence[float],
    counts: tuple[int, int, int],
    *,
    n: int = 64,
    normals: int | None = None,
    light: int = 16,
    moved: float = 0.0,
    name: str = "room",
) -> VolumeData:
    """What a bake of the room would have, and light of radiance 1 from all sides; `moved` is a share of the spacing."""
    probes = counts[0] * counts[1] * counts[2]
    shift = (synthetic.sequence(probes * 3, 5).reshape(probes, 3) - 0.5) * 2 * moved * np.asarray(spacing)
    lattice = np.stack(np.unravel_index(np.arange(probes), counts[::-1])[::-1], -1)
    offsets = shift.astype(np.float32)
    stands = np.asarray(origin) + np.asarray(spacing) * lattice + offsets
    kept = np.flatnonzero(~room.inside(stands))
    shape = layout(counts, max(n, light) + 2, len(kept))

    def look(side: int) -> tuple[F64, F64, F64]:
        rays = np.tile(texel_directions(side).reshape(-1, 3), (len(kept), 1))
        eyes = np.repeat(stands[kept], side * side, 0)
        distance, normal = room.hit(eyes, rays)
        sky = ~np.isfinite(distance)
        seen = np.where(sky[:, None], 2.0, radiance(eyes + np.where(sky, 0, distance)[:, None] * rays))
        distance = np.where(sky, MISS, distance)
        return tuple(x.reshape(len(kept), side, side, -1) for x in (distance, normal, seen))  # type: ignore[return-value]

    def atlas(output: str, interior: F64, miss: float = np.inf) -> Atlas:
        side = interior.shape[1]
        texels = pack(interior.astype(np.float32), shape)
        return Atlas(output, texels, side + 2, side, shape.columns, shape.rows, shape.layers, "float", miss)

    atlases = {
        "irradiance": atlas("irradiance", np.full((len(kept), 4, 4, 3), np.pi)),
        "distance": atlas("distance", look(n)[0], MISS),
        "normal": atlas("normal", look(normals or n)[1]),
        "radiance": atlas("radiance", look(light)[2]),
    }
    states = np.zeros(probes, np.uint8)
    states[kept] = 1
    return VolumeData(
        name=name,
        origin=np.asarray(origin, np.float64),
        spacing=np.asarray(spacing, np.float64),
        counts=np.asarray(counts, np.int64),
        states=states,
        offsets=offsets,
        backface=np.zeros(probes, np.float32),
        parameters=dict(synthetic.PARAMETERS),
        distance_limit=1.5 * float(np.linalg.norm(spacing)),
        atlases=atlases,
    )


def rays(room: Room, count: int, seed: int = 0) -> tuple[F64, F64]:
    """Origins in the open, and directions; float32 holds them exactly."""
    rng = np.random.default_rng(seed)
    low, high = (np.asarray(corner) for corner in room.walls)
    points = rng.uniform(low + 0.01, high - 0.01, (4 * count, 3))
    points = points[~room.inside(points)][:count]
    directions = rng.normal(size=(len(points), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return points.astype(np.float32).astype(np.float64), directions.astype(np.float32).astype(np.float64)
