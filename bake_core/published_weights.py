"""What others would make of a bundle's probes: plain trilinear interpolation, and the weights of DDGI; ours are held against both.

Written from Majercik et al. 2019, "Dynamic Diffuse Global Illumination with Ray-Traced Irradiance Fields", JCGT 8(2), section 5.2, and
Majercik et al. 2021, "Scaling Probe-Based Real-Time Dynamic Global Illumination for Production", JCGT 10(2), section 4.1, which is what
RTXGI's documentation describes: facing, Chebyshev's bound on filtered moments of distance, cubed and no less than 0.05, crushed below
0.2. Irradiance is blended as it is rather than as its root, which is for what the eye sees and not for an error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.irradiance import bilinear, blend, crush, facing, select_volume
from bake_core.octahedral import dir_to_oct
from bake_core.shader_constants import probe_texels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# Along the normal and towards the viewer, parts of the smallest spacing: (n · 0.2 + wo · 0.8) · 0.75 · 0.3 in Majercik et al. 2021.
DDGI_BIASES = (0.045, 0.18)
_FLOOR = 0.05

# Of a volume, positions and normals in it: weights of tiles (m,) of probes that stand at (m, 3).
_Weigh = Callable[[VolumeData, F64, F64], Callable[[I64, F64], F64]]


def trilinear(volumes: Sequence[VolumeData], positions: ArrayLike, normals: ArrayLike) -> F64:
    """Irradiance (n, 3) by trilinear weights alone; probes without a tile count for nothing."""
    return _sample(volumes, positions, normals, lambda volume, p, n: lambda tile, probe: np.ones(len(tile)))


def ddgi(volumes: Sequence[VolumeData], positions: ArrayLike, normals: ArrayLike, biases: tuple[float, float] = DDGI_BIASES) -> F64:
    """Irradiance (n, 3) by the weights of DDGI; the view direction is the normal.

    Parameters
    ----------
    volumes : sequence of VolumeData
        With visibility moments; where there are none, every probe counts as visible.
    biases : (float, float)
        How far a point is moved along its normal and towards the viewer, in units of the smallest spacing.
    """

    def weigh(volume: VolumeData, p: F64, n: F64) -> Callable[[I64, F64], F64]:
        biased = p + n * (sum(biases) * volume.spacing.min())
        return lambda tile, probe: crush(facing(probe - p, n) * _chebyshev(volume, tile, biased - probe))

    return _sample(volumes, positions, normals, weigh)


def _sample(volumes: Sequence[VolumeData], positions: ArrayLike, normals: ArrayLike, weigh: _Weigh) -> F64:
    p, n = (np.asarray(a, np.float64).reshape(-1, 3) for a in (positions, normals))
    chosen, out = select_volume(volumes, p), np.zeros((len(p), 3))
    for v, volume in enumerate(volumes):
        at = chosen == v
        table = probe_texels(volume).reshape(-1, 4).astype(np.float64)
        out[at] = blend(volume, table, p[at], n[at], weigh(volume, p[at], n[at]))[0]
    return out


def _chebyshev(volume: VolumeData, tile: I64, from_probe: F64) -> F64:
    """Donnelly and Lauritzen 2006, "Variance Shadow Maps": the share of a lobe's distances beyond the point's is at most this."""
    atlas = volume.atlases.get("visibility")
    if atlas is None:
        return np.ones(len(tile))
    r = np.minimum(np.linalg.norm(from_probe, axis=-1), volume.distance_limit)
    # A point on a probe has no direction, and is seen.
    towards = np.where(r[:, None] > 0, from_probe, [0.0, 0.0, 1.0])
    mean, square = bilinear(atlas, tile, dir_to_oct(towards)).T
    beyond = np.maximum(r - mean, 0)
    variance = np.maximum(square - mean * mean, 1e-5 * square)
    return np.where(beyond > 0, np.maximum((variance / (variance + beyond * beyond)) ** 3, _FLOOR), 1)
