"""What octahedral maps hold: moments of very short and very long distances, distances far from zero, poles and folds."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bake_core.examples import closed_box, plane_under_sun, quads_part
from bake_core.filtering import VISIBILITY_SHARPNESS
from bake_core.gltf.writer import GlbWriter
from bake_core.irradiance import sample
from bake_core.octahedral import texel_directions, texel_solid_angles
from bake_core.stability.case import Baker, Case, Result, at_most, maps, one_probe, samples
from bake_core.stability.scenes import box, scene, slab_distances, under_root

F64 = NDArray[np.float64]
_INSIDE = np.array([0.3, -0.2, 0.5])
# Hits are held this far (barycentric) inside their triangle's edges (bake_core.surfaces), times the longest edge of a 2 m square's halves.
_INSET = 2.0**-17 * 2 * math.sqrt(2)


def _spread(mean: F64, square: F64) -> F64:
    spread: F64 = np.sqrt(np.maximum(square - mean**2, 0))
    return spread


def _moments(size: float) -> Case:
    def run(baker: Baker) -> Result:
        at = _INSIDE * size
        bundle = baker(
            (scene(box(size), 0.5), {"volumes": one_probe((at[0], at[1], at[2]), 2 * size), "outputs": ["visibility"]}), stop=samples(4)
        )
        found = maps(bundle, "visibility")[0].reshape(-1, 2)
        distance = slab_distances(texel_directions(64).reshape(-1, 3), at, size)
        weight = np.maximum(texel_directions(16).reshape(-1, 3) @ texel_directions(64).reshape(-1, 3).T, 0) ** VISIBILITY_SHARPNESS
        weight *= texel_solid_angles(64).reshape(-1)
        weight /= weight.sum(1, keepdims=True)
        mean, square = weight @ distance, weight @ distance**2
        truth = _spread(mean, square)
        lost = np.abs(_spread(found[:, 0], found[:, 1]) / truth - 1).max()
        # In units of the box, the best that half floats could do.
        half = (found / [size, size**2]).astype(np.float16).astype(np.float64)
        lost_by_half = float(np.abs(_spread(half[:, 0], half[:, 1]) * size / truth - 1).max())
        note = (
            "worst relative error of σ = √(E[d²] − E[d]²) against float64. Float32 moments err by 2⁻²⁴ each, σ² by 3·2⁻²⁴ "
            "of the mean's square: "
            f"1 % of σ wants a mean above 330 σ, here it is {float((mean / truth).max()):.0f} σ at most, at any scale. "
            f"Half floats would lose {lost_by_half:.0%} of σ"
        )
        return at_most(0.01, float(lost), note)

    return Case(f"visibility moments at {size:g} m", run)


def _distances(name: str, example: tuple[bytes, F64], tolerance: float, note: str) -> Case:
    glb, shift = example

    def run(baker: Baker) -> Result:
        at = _INSIDE + shift
        spec = {"volumes": one_probe((at[0], at[1], at[2])), "outputs": ["irradiance", "distance"]}
        found = maps(baker((glb, spec), stop=samples(4)), "distance").reshape(-1)
        truth = slab_distances(texel_directions(64).reshape(-1, 3), _INSIDE)
        return at_most(tolerance, float(np.abs(found - truth).max()), note)

    return Case(name, run)


def _far_apart() -> bytes:
    w = GlbWriter()
    for x in (-5e5, 5e5):
        material = w.material("wall", (0.5,) * 3)
        w.node(mesh=w.mesh("box", [quads_part(list(box()), material)]), translation=(x, 0, 0))
    return w.to_glb()


def poles_and_folds(baker: Baker) -> Result:
    """The query on the axes, on the folds and at the corners of the square: the same from every side, and for either zero."""
    bundle = baker(plane_under_sun(), stop=samples(64))
    directions = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    step = 1e-9
    # Each direction, its zeros replaced by ±0 and by ± a hair.
    nudged = [np.where(directions == 0, s * size, directions) for s in signs for size in (0.0, step)]
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.stack([sample(bundle.volumes, np.tile([0.0, 1.0, 0.0], (len(directions), 1)), n / length).irradiance[:, 0] for n in nudged])
    texels = maps(bundle)
    # Bilinear look-up changes by the difference of neighbouring texels in a texel's width, 1/8 of the square here; n moves by 2 hairs.
    bound = 2 * step * 8 * 3 * float(texels.max()) + 2.0**-22 * float(texels.max())
    return at_most(
        bound,
        float(np.ptp(found, axis=0).max()),
        "largest jump of E between the sides of a seam, at 26 directions; what 1e-9 rad can change, and float32",
    )


CASES = (
    _moments(1e-3),
    _moments(1e5),
    _distances(
        "distances in a box moved by 1e6 m",
        (under_root(closed_box(0.5, 1.0)[0], translation=1e6), np.full(3, 1e6)),
        _INSET + 2.0**-21,
        "worst error of a distance, metres, against the slabs: hits are held 2⁻¹⁷ inside their triangles, and float32 counts from the "
        "scene's own middle",
    ),
    _distances(
        "distances in boxes 1e6 m apart",
        (_far_apart(), np.array([5e5, 0, 0])),
        2 * 2.0**-5,
        "worst error of a distance, metres: there is one local zero, 5e5 m away, where float32 knows 2⁻⁵ m; twice that",
    ),
    Case("octahedral poles and folds", poles_and_folds),
)
