"""What probes see: kernels that trace through the texels of a probe's octahedral maps.

Radiance and irradiance come from one path through each capture texel, a sample; distance, normal and back faces from one ray through
the centre of each texel of their own map.
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.embree import new_rayhit
from bake_core.kernels import entry_kernel
from bake_core.octahedral import texel_directions
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.transport import Tracer, find_hit, trace_path

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Independent scrambles of every sample sequence. Their spread is the bake's error: Sobol' points themselves are not independent.
SCRAMBLES = 4
_CANCELLED, _DONE = 1, 0


@entry_kernel  # type: ignore[untyped-decorator]
def _capture_kernel(t, ray, positions, ids, first, end, resolution, normals, seed, cancelled, lanes, irradiance, radiance):  # type: ignore[no-untyped-def]
    """Trace samples [first, end) through every capture texel of every given probe.

    Parameters
    ----------
    positions : (p, 3) float64, local frame
    ids : (p,) uint64
        What makes each probe's samples its own: its number in the bake, not in the shard.
    normals : (3, m) float32
        Directions of the irradiance texels' normals.
    irradiance : (p, SCRAMBLES, m, 3) float64, added to
        Σ L cosθ · (solid angle per sample), per scramble.
    radiance : (p, resolution², 3) float64 or (0, 0, 0), added to
        Σ L per capture texel.

    Notes
    -----
    A point of the octahedral square stands for dω = dA / |v|³, v being its point on the octahedron |x| + |y| + |z| = 1: a face lies 1/√3 from
    the centre and is √3 times its projection. The cosine is taken at each sample's own direction, so the convolution has no texel size in it.
    """
    ray_bits = ray.view(np.uint32)
    m = normals.shape[1]
    texels = resolution * resolution
    for p in range(positions.shape[0]):
        x0, y0, z0 = positions[p, 0], positions[p, 1], positions[p, 2]
        probe_key = mix64(seed ^ mix64(ids[p]))
        for texel in range(texels):
            if cancelled[0]:
                return _CANCELLED
            row, column = texel // resolution, texel % resolution
            for scramble in range(SCRAMBLES):
                key = mix64(probe_key + uint64(texel * SCRAMBLES + scramble))
                for i in range(m):
                    lanes[0, i] = lanes[1, i] = lanes[2, i] = np.float32(0)
                total_r = total_g = total_b = 0.0
                # The first sample of this scramble at or after `first`.
                for sample in range(first + (scramble - first) % SCRAMBLES, end, SCRAMBLES):
                    index = uint32(sample // SCRAMBLES)
                    reversed_index = reverse_bits(index)
                    u, v = sobol_pair(reversed_index, key)
                    a = (column + float(u)) * 2 / resolution - 1
                    b = (row + float(v)) * 2 / resolution - 1
                    c = 1 - abs(a) - abs(b)
                    fold = max(-c, 0.0)
                    a += -fold if a >= 0 else fold
                    b += -fold if b >= 0 else fold
                    length = math.sqrt(a * a + b * b + c * c)
                    dx, dy, dz = a / length, b / length, c / length
                    emitted, direct, indirect, _ = trace_path(t, ray, ray_bits, x0, y0, z0, dx, dy, dz, reversed_index, index, key, False)
                    red, green, blue = (
                        emitted[0] + direct[0] + indirect[0],
                        emitted[1] + direct[1] + indirect[1],
                        emitted[2] + direct[2] + indirect[2],
                    )
                    total_r += red
                    total_g += green
                    total_b += blue
                    if red + green + blue > 0:
                        solid_angle = 4 / (length * length * length) / texels
                        fr, fg, fb = np.float32(red * solid_angle), np.float32(green * solid_angle), np.float32(blue * solid_angle)
                        fx, fy, fz = np.float32(dx), np.float32(dy), np.float32(dz)
                        for i in range(m):
                            cosine = max(normals[0, i] * fx + normals[1, i] * fy + normals[2, i] * fz, np.float32(0))
                            lanes[0, i] += cosine * fr
                            lanes[1, i] += cosine * fg
                            lanes[2, i] += cosine * fb
                for i in range(m):
                    irradiance[p, scramble, i, 0] += lanes[0, i]
                    irradiance[p, scramble, i, 1] += lanes[1, i]
                    irradiance[p, scramble, i, 2] += lanes[2, i]
                if radiance.shape[0]:
                    radiance[p, texel, 0] += total_r
                    radiance[p, texel, 1] += total_g
                    radiance[p, texel, 2] += total_b
    return _DONE


@entry_kernel  # type: ignore[untyped-decorator]
def _distance_kernel(t, ray, positions, directions, cancelled, distance, normal, back):  # type: ignore[no-untyped-def]
    """One ray through each direction: distance (inf for a miss), geometric normal towards the probe, whether it met a back face."""
    ray_bits = ray.view(np.uint32)
    for p in range(positions.shape[0]):
        if cancelled[0]:
            return _CANCELLED
        for i in range(directions.shape[0]):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            hit, s = find_hit(t, ray, ray_bits, positions[p, 0], positions[p, 1], positions[p, 2], dx, dy, dz, False)
            if hit:
                x, y, z = s[0][0] - positions[p, 0], s[0][1] - positions[p, 1], s[0][2] - positions[p, 2]
                distance[p, i] = math.sqrt(x * x + y * y + z * z)
                normal[p, i, 0], normal[p, i, 1], normal[p, i, 2] = s[1][0], s[1][1], s[1][2]
                back[p, i] = not s[5] and not t.materials.double_sided[s[4]]
            else:
                distance[p, i] = np.inf
                normal[p, i, 0] = normal[p, i, 1] = normal[p, i, 2] = 0
                back[p, i] = False
    return _DONE


def capture_radiance(
    tracer: Tracer,
    positions: F64,
    ids: NDArray[np.uint64],
    samples: tuple[int, int],
    *,
    resolution: int,
    irradiance_resolution: int,
    seed: int,
    keep_radiance: bool,
    cancelled: NDArray[np.uint8],
) -> tuple[F64, F64] | None:
    """Sums over a range of samples for some probes; releases the GIL.

    Parameters
    ----------
    positions : (p, 3) float64
        Metres, local frame.
    ids : (p,) uint64
    samples : (int, int)
        Half-open range. Sample s belongs to scramble s % SCRAMBLES.
    resolution, irradiance_resolution : int
        Texels along the capture map's and the irradiance map's side.
    cancelled : (1,) uint8
        Set it from any thread to stop within one texel.

    Returns
    -------
    irradiance : (p, SCRAMBLES, irradiance_resolution², 3) float64
        Sums; over the samples of a scramble they give irradiance, no 1/π inside.
    radiance : (p, resolution², 3) float64
        Sums over all samples; (0, 0, 0) unless `keep_radiance`.
    None where it was cancelled.
    """
    normals = np.ascontiguousarray(texel_directions(irradiance_resolution).reshape(-1, 3).T, dtype=np.float32)
    irradiance = np.zeros((len(positions), SCRAMBLES, normals.shape[1], 3))
    radiance = np.zeros((len(positions), resolution**2, 3) if keep_radiance else (0, 0, 0))
    status = _capture_kernel(
        tracer.tables,
        new_rayhit(),
        np.ascontiguousarray(positions),
        ids,
        samples[0],
        samples[1],
        resolution,
        normals,
        np.uint64(seed),
        cancelled,
        np.zeros_like(normals),
        irradiance,
        radiance,
    )
    return None if status == _CANCELLED else (irradiance, radiance)


def capture_distance(
    tracer: Tracer, positions: F64, resolution: int, *, cancelled: NDArray[np.uint8]
) -> tuple[F64, F32, NDArray[np.bool_]] | None:
    """Distances, normals and back faces through texel centres; releases the GIL.

    Returns
    -------
    distance : (p, resolution²) float64
        Metres; inf where nothing is hit.
    normal : (p, resolution², 3) float32
        Geometric, unit, towards the probe; zeros for a miss.
    back : (p, resolution²) bool
        Back face of a single-sided surface.
    None where it was cancelled.
    """
    directions = texel_directions(resolution).reshape(-1, 3)
    n = len(directions)
    distance, normal = np.empty((len(positions), n)), np.empty((len(positions), n, 3), np.float32)
    back = np.empty((len(positions), n), np.bool_)
    status = _distance_kernel(tracer.tables, new_rayhit(), np.ascontiguousarray(positions), directions, cancelled, distance, normal, back)
    return None if status == _CANCELLED else (distance, normal, back)
