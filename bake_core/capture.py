"""What light probes see: radiance and irradiance come from one path through each texel of a probe's octahedral map, a sample."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.allocation import HALVES, SCRAMBLES, SCRAMBLES_PER_HALF, of_scramble
from bake_core.embree import new_rayhit, rays_traced
from bake_core.environment import has_sky
from bake_core.errors import Cancelled
from bake_core.kernels import CANCELLED, DONE, entry_kernel, kernel
from bake_core.octahedral import texel_cosines, texel_directions
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.seen_lights import TEXELS_PER_LIGHT_SAMPLE, falls_into_texels, sample_lights
from bake_core.tracer import Tracer
from bake_core.transport import trace_path

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# A probe's capture texels are summed in this many blocks, which threads may share: fixed, so that sums are the same bits for any number
# of threads.
BLOCKS = 4
# Paths a thread traces before it asks for more: a few hundred milliseconds' work.
_CHUNK_PATHS = 1 << 18


@kernel
def _morton(row, column):  # type: ignore[no-untyped-def]
    """Neighbours in two dimensions stay close in one: bits in turn (Morton 1966). Up to 2⁸ rows."""
    code = 0
    for bit in range(8):
        code |= (column >> bit & 1) << (2 * bit) | (row >> bit & 1) << (2 * bit + 1)
    return code


# Of a half's samples, a scramble's.
_of_scramble = kernel(of_scramble)


@entry_kernel
def _capture_kernel(t, ray, positions, ids, spans, resolution, blocks, normals, cosines, seed, cancelled, room, irradiance, radiance):  # type: ignore[no-untyped-def]
    """Trace each probe's samples through the capture texels of some of its blocks.

    Parameters
    ----------
    positions : (p, 3) float64, local frame
    ids : (p,) uint64
        What makes each probe's samples its own: its number in the bake, not in the shard.
    spans : (p, HALVES, 2) int64
        Half-open range of samples of each half; sample s is of scramble s % SCRAMBLES_PER_HALF of its half.
    normals : (3, m) float32
        Directions of the irradiance texels' normals.
    cosines : (resolution², m) float32
        Exact ∫ cosθ dω over each capture texel about each normal.
    blocks : (int, int)
        Half-open range out of BLOCKS.
    room : (SCRAMBLES + 1, 4, m) float32, (HALVES, 3) float64
        To work in.
    irradiance : (p, BLOCKS, SCRAMBLES, 3, m) float64, added to
        Σ L cosθ · (solid angle per sample), per block and scramble.
    radiance : (p, BLOCKS, HALVES, resolution², 3) float64 or (p, BLOCKS, HALVES, 0, 3), added to
        Σ L per block, half and capture texel: a block's light samples fall into any.

    Notes
    -----
    A point of the octahedral square stands for dω = dA / |v|³, v being its point on the octahedron |x| + |y| + |z| = 1: a face lies 1/√3
    from
    the centre and is √3 times its projection.

    A texel's part of irradiance is ∫ L f, with f = cosθ dω/dA, over its area. F = ∫ f is known exactly, which makes f a control variate
    (Owen 2013, "Monte Carlo theory, methods and examples", section 8.9): scramble i estimates the texel's part as

        mean_i(L f) + L̄ (F - mean_i(f)),

    the samples' own convolution, corrected for where in the texel they happened to fall. With a coefficient L̄ from the scramble's own
    samples, one sample would be left with L F and no knowledge of how light and cosine go together inside the texel. L̄ is therefore the
    other half's mean (cross-fitting; Avramidis and Wilson 1993, "A Splitting Scheme for Control Variates"): independent of mean_i(f), whose
    mean is F, so nothing biases the sum, at any number of samples; where this pass has none of the other half it is 0. Else, where L is
    constant, the sum is exact (a furnace tests it). Halves are no longer quite independent: their covariance is the square of one's
    cov(L, f).
    """
    ray_bits = ray.view(np.uint32)
    lanes, light = room
    m = normals.shape[1]
    texels = resolution * resolution
    # Light samples a round: a round is one sample through every texel.
    lit = has_sky(t) or t.emitters.cdf.shape[0] > 0
    light_rate = float((texels + TEXELS_PER_LIGHT_SAMPLE - 1) // TEXELS_PER_LIGHT_SAMPLE) if lit else 0.0
    for p in range(positions.shape[0]):
        x0, y0, z0 = positions[p, 0], positions[p, 1], positions[p, 2]
        probe_key = mix64(seed ^ mix64(ids[p]))
        for texel in range(texels * blocks[0] // BLOCKS, texels * blocks[1] // BLOCKS):
            if cancelled[0]:
                return CANCELLED
            row, column = texel // resolution, texel % resolution
            place = _morton(row, column)
            block = texel * BLOCKS // texels
            for half in range(HALVES):
                light[half, 0] = light[half, 1] = light[half, 2] = 0.0
                key = mix64(probe_key + uint64(texel * HALVES + half))
                path_key = mix64(probe_key + uint64((texels + 1) * HALVES + half))
                begun, span = spans[p, half, 0], spans[p, half, 1] - spans[p, half, 0]
                sample = 0
                for j in range(SCRAMBLES_PER_HALF):
                    scramble = half * SCRAMBLES_PER_HALF + j
                    own = lanes[scramble]
                    for i in range(m):
                        own[0, i] = own[1, i] = own[2, i] = own[3, i] = np.float32(0)
                    for _ in range(_of_scramble(begun + span, j) - _of_scramble(begun, j)):
                        # A half's scrambles share out the points of one sequence: each has a run of those of this pass.
                        u, v = sobol_pair(reverse_bits(uint32(begun + sample)), key)
                        # Bounces are stratified over the whole probe: one sequence for all its texels, of which a texel's samples of one
                        # pass are a run, and neighbouring texels' runs follow one another.
                        index = uint32(texels * begun + place * span + sample)
                        reversed_index = reverse_bits(index)
                        sample += 1
                        a = (column + float(u)) * 2 / resolution - 1
                        b = (row + float(v)) * 2 / resolution - 1
                        c = 1 - abs(a) - abs(b)
                        fold = max(-c, 0.0)
                        a += -fold if a >= 0 else fold
                        b += -fold if b >= 0 else fold
                        length = math.sqrt(a * a + b * b + c * c)
                        dx, dy, dz = a / length, b / length, c / length
                        density = texels / 4 * (length * length * length)
                        width = math.sqrt(1 / density)
                        emitted, direct, indirect, _, light_pdf = trace_path(
                            t, ray, ray_bits, x0, y0, z0, dx, dy, dz, reversed_index, index, path_key, False, width, scramble
                        )
                        # What light samples find too, they find better: the balance heuristic leaves this sample its share.
                        share = density / (density + light_rate * light_pdf)
                        red = share * emitted[0] + direct[0] + indirect[0]
                        green = share * emitted[1] + direct[1] + indirect[1]
                        blue = share * emitted[2] + direct[2] + indirect[2]
                        if radiance.shape[3]:
                            rest = 0.0 if falls_into_texels(light_rate * light_pdf, density) else 1 - share
                            radiance[p, block, half, texel, 0] += red + rest * emitted[0]
                            radiance[p, block, half, texel, 1] += green + rest * emitted[1]
                            radiance[p, block, half, texel, 2] += blue + rest * emitted[2]
                        light[half, 0] += red
                        light[half, 1] += green
                        light[half, 2] += blue
                        solid_angle = np.float32(1 / density)
                        fr, fg, fb = np.float32(red), np.float32(green), np.float32(blue)
                        fx, fy, fz = np.float32(dx) * solid_angle, np.float32(dy) * solid_angle, np.float32(dz) * solid_angle
                        for i in range(m):
                            f = max(normals[0, i] * fx + normals[1, i] * fy + normals[2, i] * fz, np.float32(0))
                            own[0, i] += f * fr
                            own[1, i] += f * fg
                            own[2, i] += f * fb
                            own[3, i] += f
            for half in range(HALVES):
                other = HALVES - 1 - half
                drawn = spans[p, other, 1] - spans[p, other, 0]
                per = 1 / drawn if drawn > 0 else 0.0
                mean_r, mean_g, mean_b = (
                    np.float32(per * light[other, 0]),
                    np.float32(per * light[other, 1]),
                    np.float32(per * light[other, 2]),
                )
                light_key = mix64(probe_key + uint64(texels * HALVES + half))
                point = spans[p, half, 0]
                for j in range(SCRAMBLES_PER_HALF):
                    scramble = half * SCRAMBLES_PER_HALF + j
                    count = _of_scramble(spans[p, half, 1], j) - _of_scramble(spans[p, half, 0], j)
                    own, into = lanes[scramble], irradiance[p, block, scramble]
                    weight = np.float32(count)
                    for i in range(m):
                        missed = weight * cosines[texel, i] - own[3, i]
                        into[0, i] += own[0, i] + mean_r * missed
                        into[1, i] += own[1, i] + mean_g * missed
                        into[2, i] += own[2, i] + mean_b * missed
                    if light_rate and texel % TEXELS_PER_LIGHT_SAMPLE == 0:
                        rounds, spare, seen = (point, point + count), lanes[SCRAMBLES], radiance[p, block, half]
                        at = (x0, y0, z0)
                        sample_lights(t, ray, ray_bits, at, texel, texels, rounds, light_rate, light_key, normals, spare, into, seen)
                    point += count
    return DONE


@dataclass(frozen=True)
class Capture:
    """What is captured, the same for all probes of a bake.

    Attributes
    ----------
    resolution, irradiance_resolution : int
        Texels along the capture map's and the irradiance map's side.
    seed : int
    keep_radiance : bool
    """

    resolution: int
    irradiance_resolution: int
    seed: int
    keep_radiance: bool


def capture_radiance(
    tracer: Tracer,
    positions: F64,
    ids: NDArray[np.uint64],
    spans: I64,
    capture: Capture,
    *,
    threads: int,
    cancelled: NDArray[np.uint8],
    advance: Callable[[float], None],
) -> tuple[F64, F64, int]:
    """Sums over ranges of samples for some probes, on several threads.

    Parameters
    ----------
    positions : (p, 3) float64
        Metres, local frame.
    ids : (p,) uint64
        A probe's number in the bake: makes its samples its own, in whatever shard it is traced.
    spans : (p, HALVES, 2) int64
        Half-open range of samples of each probe's halves (:func:`bake_core.allocation.uniform`).
    cancelled : (1,) uint8
        Set it from any thread to stop within one texel.
    advance : callable
        Told the fraction of the work that has been done since it was last called.

    Returns
    -------
    irradiance : (p, SCRAMBLES, irradiance_resolution², 3) float64
        Sums; over the samples of a scramble they give irradiance, no 1/π inside.
    radiance : (p, HALVES, resolution², 3) float64
        Sums; (0, 0, 0, 0) unless it is kept.
    rays : int
        Traced for them: through texels, on from surfaces, towards light.

    Raises
    ------
    Cancelled
    """
    normals, cosines = _irradiance_filter(capture.resolution, capture.irradiance_resolution)
    n = len(positions)
    irradiance = np.zeros((n, SCRAMBLES, normals.shape[1], 3))
    radiance = np.zeros((n, HALVES, capture.resolution**2, 3) if capture.keep_radiance else (0, 0, 0, 0))

    def trace(first: int, end: int, blocks: tuple[int, int]) -> tuple[F64, F64, int]:
        ray = new_rayhit()
        sums = np.zeros((end - first, BLOCKS, SCRAMBLES, 3, normals.shape[1]))
        seen = np.zeros((end - first, BLOCKS, HALVES, capture.resolution**2 if capture.keep_radiance else 0, 3))
        status = _capture_kernel(
            tracer.tables,
            ray,
            positions[first:end],
            ids[first:end],
            spans[first:end],
            capture.resolution,
            blocks,
            normals,
            cosines,
            np.uint64(capture.seed),
            cancelled,
            (np.zeros((SCRAMBLES + 1, 4, normals.shape[1]), np.float32), np.zeros((HALVES, 3))),
            sums,
            seen,
        )
        if status == CANCELLED:
            raise Cancelled
        return sums, seen, rays_traced(ray)

    def gather(first: int, end: int, sums: F64, seen: F64) -> None:
        irradiance[first:end] = np.moveaxis(_sum_blocks(sums), -2, -1)
        if capture.keep_radiance:
            radiance[first:end] = _sum_blocks(seen)

    def trace_probes(first: int, end: int) -> int:
        sums, seen, rays = trace(first, end, (0, BLOCKS))
        gather(first, end, sums, seen)
        advance((end - first) / n)
        return rays

    def trace_block(block: int) -> tuple[F64, F64, int]:
        sums, seen, rays = trace(0, n, (block, block + 1))
        advance(1 / BLOCKS)
        return sums[:, block], seen[:, block], rays

    with ThreadPoolExecutor(threads) as pool:
        if n < 4 * threads:
            # Too few probes to share out: share each probe's blocks.
            sums, seen, counts = zip(*pool.map(trace_block, range(BLOCKS)), strict=True)
            gather(0, n, np.stack(sums, 1), np.stack(seen, 1))
            rays = sum(counts)
        else:
            # Small enough that threads end together, large enough that Python's part is nothing.
            most = int((spans[..., 1] - spans[..., 0]).sum(1).max())
            step = max(1, min(n // (32 * threads), _CHUNK_PATHS // (capture.resolution**2 * max(most, 1))))
            starts = range(0, n, step)
            rays = sum(pool.map(lambda first: trace_probes(first, min(first + step, n)), starts))
    return irradiance, radiance, rays


@cache
def _irradiance_filter(resolution: int, irradiance_resolution: int) -> tuple[F32, F32]:
    """The irradiance texels' normals, (3, m) float32, and the exact cosine integrals of the capture texels about them, (resolution², m)."""
    normals = texel_directions(irradiance_resolution).reshape(-1, 3)
    cosines = texel_cosines(resolution, normals)
    return np.ascontiguousarray(normals.T, dtype=np.float32), np.ascontiguousarray(cosines.T, dtype=np.float32)


def _sum_blocks(sums: F64) -> F64:
    """In one fixed order."""
    total: F64 = sums[:, 0]
    for block in range(1, BLOCKS):
        total = total + sums[:, block]
    return total
