"""A small bundle made of arithmetic, for every test of the irradiance query: no bake, no files, the same on every machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bake_core.atlas import layout, pack
from bake_core.bundle import Atlas, VolumeData

# Shadows thirty times softer than a bake's: there, rounding of float32 in a point's direction is up to a thousandth of a shadow's width.
PARAMETERS = {
    "normal_bias": 0.2,
    "view_bias": 0.8,
    "bias_scale": 0.225,
    "visibility_floor": 0.05,
    "visibility_softness": 0.3,
    "visibility_sharpness": 50.0,
}


def sequence(count: int, first: int = 0) -> NDArray[np.float64]:
    """Numbers in [0, 1) that fill it evenly: multiples of 1/1024, so that halves, floats and JSON hold them exactly."""
    golden = (np.arange(first, first + count) + 1) * 0.6180339887498949 % 1
    return np.asarray(np.floor(golden * 1024) / 1024)


def atlas(output: str, interior: NDArray[np.float64], counts: tuple[int, int, int], inactive: tuple[int, ...] = ()) -> Atlas:
    """Pack (probes, n, n, channels), less those that are inactive, into a volume's layout."""
    n = interior.shape[1]
    kept = np.delete(interior, inactive, 0).astype(np.float32)
    shape = layout(counts, n + 2, len(kept))
    return Atlas(output, pack(kept, shape), n + 2, n, shape.columns, shape.rows, shape.layers, "float")


def volume(
    name: str,
    origin: tuple[float, float, float],
    spacing: tuple[float, float, float],
    counts: tuple[int, int, int],
    *,
    seed: int = 0,
    inactive: tuple[int, ...] = (),
    moved: bool = False,
    walls: bool = True,
    n: int = 4,
) -> VolumeData:
    """A volume whose texels are all different, and whose distances lie around its cell's size, so that all weights matter."""
    probes = counts[0] * counts[1] * counts[2]
    diagonal = float(np.hypot(np.hypot(spacing[0], spacing[1]), spacing[2]))
    light = sequence(probes * n * n * 3, seed).reshape(probes, n, n, 3) * 2
    atlases = {"irradiance": atlas("irradiance", light, counts, inactive)}
    if walls:
        distance = (0.25 + sequence(probes * n * n, seed + 7).reshape(probes, n, n, 1)) * diagonal
        atlases["walls"] = atlas("walls", min(spacing) / distance, counts, inactive)
    states = np.ones(probes, np.uint8)
    states[list(inactive)] = 0
    offsets = ((sequence(probes * 3, seed + 3).reshape(probes, 3) - 0.5) * 0.5 * np.asarray(spacing) * moved).astype(np.float32)
    return VolumeData(
        name=name,
        origin=np.asarray(origin, np.float64),
        spacing=np.asarray(spacing, np.float64),
        counts=np.asarray(counts, np.int64),
        states=states,
        offsets=offsets,
        backface=np.zeros(probes, np.float32),
        parameters=dict(PARAMETERS),
        distance_limit=1.5 * diagonal,
        atlases=atlases,
    )


def volumes() -> tuple[VolumeData, ...]:
    """Three volumes that together have what there is.

    One inside another, probes off their lattice, dead ones, a cell of dead ones only, an axis of one probe, no walls.
    """
    return (
        volume("fine", (-1.0, 0.0, 0.5), (0.5, 0.25, 1.0), (2, 3, 2), seed=1, inactive=(0, 1), moved=True),
        volume("coarse", (-4.0, -2.0, -3.0), (3.0, 2.0, 2.5), (3, 3, 3), seed=2, inactive=(1, 13, 14, 16, 17, 22, 23, 25, 26)),
        volume("flat", (6.0, 0.0, 0.0), (1.0, 1.0, 2.0), (3, 1, 2), seed=3, walls=False),
    )


DIRECTIONS = np.array(
    [
        *([s * (a == i) for i in range(3)] for a in range(3) for s in (1.0, -1.0)),
        [0.0, -0.0, -1.0],
        [-0.0, 0.0, -1.0],
        [-0.0, -0.0, 1.0],
        [-0.0, 1.0, 0.0],
        [1.0, -0.0, -0.0],
        [0.6, 0.8, 0.0],
        [0.6, 0.8, -0.0],
        [-0.6, 0.8, 0.0],
        [-0.6, -0.8, -0.0],
        [0.6, 0.0, -0.8],
        [0.6, -0.0, -0.8],
        [0.0, -0.6, -0.8],
        [-0.0, 0.6, -0.8],
        [2 / 3, 1 / 3, -2 / 3],
        [-1 / 3, 2 / 3, 2 / 3],
        [-2 / 3, -2 / 3, -1 / 3],
    ]
)


def points(count: int, seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Positions, normals and view directions: in and around :func:`volumes`, on probes, faces and edges, and far outside."""
    lattice = [v.origin + v.spacing * np.stack(np.unravel_index(np.arange(len(v.states)), v.counts[::-1])[::-1], -1) for v in volumes()]
    halfway = [nodes[:-1] / 2 + nodes[1:] / 2 for nodes in lattice]
    far = np.array([[1e4, 0, 0], [-1e4, 1e4, 3], [0, 0, -1e6], [-40, 40, 40]])
    special = np.concatenate([*lattice, *halfway, far])
    spread = np.stack([sequence(count, seed + k * count) for k in range(3)], -1) * [16, 9, 9] - [6, 4, 4.5]
    positions = np.concatenate([special, spread]).astype(np.float32).astype(np.float64)
    n = len(positions)
    angle = sequence(n, seed + 5) * 2 * np.pi
    z = sequence(n, seed + 9) * 2 - 1
    normals = np.stack([np.cos(angle) * np.sqrt(1 - z * z), np.sin(angle) * np.sqrt(1 - z * z), z], -1)
    normals[: len(DIRECTIONS)] = DIRECTIONS
    normals[len(special) : len(special) + len(DIRECTIONS)] = DIRECTIONS
    wo = np.roll(normals, 1, 0)
    wo[(normals * wo).sum(-1) < 0] *= -1
    return positions, normals.astype(np.float32).astype(np.float64), wo.astype(np.float32).astype(np.float64)
