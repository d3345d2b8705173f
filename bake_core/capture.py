"""What light probes see: radiance and irradiance come from one path through each texel of a probe's octahedral map, a sample."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.allocation import HALVES, SCRAMBLES, SCRAMBLES_PER_HALF, of_scramble
from bake_core.embree import LANES, Packet, new_packet, new_rayhit, rays_traced, set_lane, take_lane
from bake_core.environment import has_sky
from bake_core.errors import Cancelled
from bake_core.kernels import CANCELLED, DONE, entry_kernel, kernel
from bake_core.octahedral import texel_cosines, texel_directions
from bake_core.ray_log import ask_packet
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.seen_lights import TEXELS_PER_LIGHT_SAMPLE, capture_density, falls_into_texels, sample_lights
from bake_core.tracer import Tracer
from bake_core.transport import trace_on

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# A probe's capture texels are summed in this many blocks, which threads may share: fixed, so that sums are the same bits for any number
# of threads.
BLOCKS = 4
# Paths a thread traces before it asks for more: a few hundred milliseconds' work.
_CHUNK_PATHS = 1 << 18
# Samples whose cosines are summed at once.
_TOGETHER = 2


@kernel
def _morton(row, column):  # type: ignore[no-untyped-def]
    """Neighbours in two dimensions stay close in one: bits in turn (Morton 1966). Up to 2⁸ rows."""
    code = 0
    for bit in range(8):
        code |= (column >> bit & 1) << (2 * bit) | (row >> bit & 1) << (2 * bit + 1)
    return code


# Of a half's samples, a scramble's.
_of_scramble = kernel(of_scramble)


@kernel
def _through_texel(row, column, u, v, resolution):  # type: ignore[no-untyped-def]
    """The unit direction through a point of a texel."""
    a = (column + float(u)) * 2 / resolution - 1
    b = (row + float(v)) * 2 / resolution - 1
    c = 1 - abs(a) - abs(b)
    fold = max(-c, 0.0)
    a += -fold if a >= 0 else fold
    b += -fold if b >= 0 else fold
    length = math.sqrt(a * a + b * b + c * c)
    return a / length, b / length, c / length


@kernel
def _add_cosines(normals, samples, own):  # type: ignore[no-untyped-def]
    """Samples' light times their cosines about every normal, and the cosines alone; so many together that sums are fetched less often.

    Parameters
    ----------
    samples : (_TOGETHER, 6) float32
        Direction times solid angle, and light.
    own : (4, m) float32, added to
    """
    ax, ay, az, ar, ag, ab = samples[0]
    bx, by, bz, br, bg, bb = samples[1]
    for i in range(normals.shape[1]):
        f = max(normals[0, i] * ax + normals[1, i] * ay + normals[2, i] * az, np.float32(0))
        g = max(normals[0, i] * bx + normals[1, i] * by + normals[2, i] * bz, np.float32(0))
        own[0, i] += f * ar + g * br
        own[1, i] += f * ag + g * bg
        own[2, i] += f * ab + g * bb
        own[3, i] += f + g


class _Room(NamedTuple):
    """What a thread works in.

    Attributes
    ----------
    packet : Packet
    ways : (LANES, 3) float64
        Directions of its rays, which has them in float32.
    waiting : (_TOGETHER, 6) float32
        For :func:`_add_cosines`.
    sums : (SCRAMBLES + 1, 4, m) float32
        Of a texel, by scramble; the last is for light samples.
    light : (HALVES, 3) float64
        Of a texel, by half.
    """

    packet: Packet
    ways: F64
    waiting: F32
    sums: F32
    light: F64


def _new_room(m: int) -> _Room:
    sums = np.zeros((SCRAMBLES + 1, 4, m), np.float32)
    return _Room(new_packet(), np.zeros((LANES, 3)), np.zeros((_TOGETHER, 6), np.float32), sums, np.zeros((HALVES, 3)))


@kernel
def _look_through(t, room, x, y, z, texel, resolution, key, spans, numbers):  # type: ignore[no-untyped-def]
    """Ask for some of the rays of a probe through a texel together; they are numbered through both halves."""
    row, column = texel // resolution, texel % resolution
    first_span = spans[0, 1] - spans[0, 0]
    for number in range(numbers[0], numbers[1]):
        half = 0 if number < first_span else 1
        point = spans[half, 0] + number - half * first_span
        u, v = sobol_pair(reverse_bits(uint32(point)), mix64(key + uint64(texel * HALVES + half)))
        lane = number - numbers[0]
        way = room.ways[lane]
        way[0], way[1], way[2] = _through_texel(row, column, u, v, resolution)
        set_lane(room.packet, lane, x, y, z, way[0], way[1], way[2])
    ask_packet(t, room.packet)


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
    room : _Room
    irradiance : (p, BLOCKS, SCRAMBLES, 3, m) float64, added to
        Σ L cosθ · (solid angle per sample), per block and scramble.
    radiance : (p, BLOCKS, HALVES, resolution², 3) float64 or (p, BLOCKS, HALVES, 0, 3), added to
        Σ L per block, half and capture texel: a block's light samples fall into any.

    Notes
    -----
    A point of the octahedral square stands for dω = dA / |v|³, v being its point on the octahedron |x| + |y| + |z| = 1: a face lies 1/√3
    from the centre and is √3 times its projection.

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
    m = normals.shape[1]
    texels = resolution * resolution
    # Light samples a round: a round is one sample through every texel.
    lit = has_sky(t) or t.emitters.cdf.shape[0] > 0
    light_rate = float((texels + TEXELS_PER_LIGHT_SAMPLE - 1) // TEXELS_PER_LIGHT_SAMPLE) if lit else 0.0
    for p in range(positions.shape[0]):
        x0, y0, z0 = positions[p, 0], positions[p, 1], positions[p, 2]
        probe_key = mix64(seed ^ mix64(ids[p]))
        first_span = spans[p, 0, 1] - spans[p, 0, 0]
        both = first_span + spans[p, 1, 1] - spans[p, 1, 0]
        for texel in range(texels * blocks[0] // BLOCKS, texels * blocks[1] // BLOCKS):
            if cancelled[0]:
                return CANCELLED
            place = _morton(texel // resolution, texel % resolution)
            block = texel * BLOCKS // texels
            room.light[:] = 0.0
            number = 0
            for scramble in range(SCRAMBLES):
                half, j = scramble // SCRAMBLES_PER_HALF, scramble % SCRAMBLES_PER_HALF
                begun, end = spans[p, half, 0], spans[p, half, 1]
                path_key = mix64(probe_key + uint64((texels + 1) * HALVES + half))
                own, light = room.sums[scramble], room.light[half]
                own[:] = np.float32(0)
                # A half's scrambles share out the points of one sequence: each has a run of those of this pass.
                count = _of_scramble(end, j) - _of_scramble(begun, j)
                for i in range(count):
                    lane = number % LANES
                    if lane == 0:
                        numbers = (number, min(number + LANES, both))
                        _look_through(t, room, x0, y0, z0, texel, resolution, probe_key, spans[p], numbers)
                    # Bounces are stratified over the whole probe: one sequence for all its texels, of which a texel's samples of one
                    # pass are a run, and neighbouring texels' runs follow one another.
                    index = uint32(texels * begun + place * (end - begun) + number - half * first_span)
                    number += 1
                    dx, dy, dz = room.ways[lane]
                    density = capture_density((dx, dy, dz), texels)
                    width = math.sqrt(1 / density)
                    take_lane(room.packet, lane, ray, ray_bits)
                    emitted, direct, indirect, _, light_pdf = trace_on(
                        t, ray, ray_bits, x0, y0, z0, dx, dy, dz, reverse_bits(index), index, path_key, False, width, scramble
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
                    light[0] += red
                    light[1] += green
                    light[2] += blue
                    solid_angle = np.float32(1 / density)
                    waits = room.waiting[i % _TOGETHER]
                    waits[0], waits[1], waits[2] = np.float32(dx) * solid_angle, np.float32(dy) * solid_angle, np.float32(dz) * solid_angle
                    waits[3], waits[4], waits[5] = red, green, blue
                    if i % _TOGETHER == _TOGETHER - 1:
                        _add_cosines(normals, room.waiting, own)
                if count % _TOGETHER:
                    room.waiting[count % _TOGETHER :] = np.float32(0)
                    _add_cosines(normals, room.waiting, own)
            for half in range(HALVES):
                other = HALVES - 1 - half
                drawn = spans[p, other, 1] - spans[p, other, 0]
                per = 1 / drawn if drawn > 0 else 0.0
                mean_r, mean_g, mean_b = (
                    np.float32(per * room.light[other, 0]),
                    np.float32(per * room.light[other, 1]),
                    np.float32(per * room.light[other, 2]),
                )
                light_key = mix64(probe_key + uint64(texels * HALVES + half))
                point = spans[p, half, 0]
                for j in range(SCRAMBLES_PER_HALF):
                    scramble = half * SCRAMBLES_PER_HALF + j
                    count = _of_scramble(spans[p, half, 1], j) - _of_scramble(spans[p, half, 0], j)
                    own, into = room.sums[scramble], irradiance[p, block, scramble]
                    weight = np.float32(count)
                    for i in range(m):
                        missed = weight * cosines[texel, i] - own[3, i]
                        into[0, i] += own[0, i] + mean_r * missed
                        into[1, i] += own[1, i] + mean_g * missed
                        into[2, i] += own[2, i] + mean_b * missed
                    if light_rate and texel % TEXELS_PER_LIGHT_SAMPLE == 0:
                        rounds, spare, seen = (point, point + count), room.sums[SCRAMBLES], radiance[p, block, half]
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
            _new_room(normals.shape[1]),
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
