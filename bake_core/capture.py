"""What probes see: kernels that trace through the texels of a probe's octahedral maps.

Radiance and irradiance come from one path through each capture texel, a sample; distance, normal and back faces from one ray through
the centre of each texel of their own map.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.allocation import HALVES, SCRAMBLES, SCRAMBLES_PER_HALF
from bake_core.embree import new_rayhit, rays_traced
from bake_core.environment import has_sky, sample_sky
from bake_core.errors import Cancelled
from bake_core.kernels import CANCELLED, DONE, either, entry_kernel, kernel
from bake_core.light_tree import pick_emitter
from bake_core.next_event import sample_emitter
from bake_core.octahedral import texel_cosines, texel_directions
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.surfaces import INFINITE, blocked, find_surface, surface
from bake_core.tracer import Tracer
from bake_core.transport import trace_path

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# A probe's capture texels are summed in this many blocks, which threads may share: fixed, so that sums are the same bits for any number
# of threads.
BLOCKS = 4
# Emitters and sky seen directly are also sampled as lights, once for this many capture texels: a capture ray either hits a lamp or misses
# it, and the edge of a 1 m² lamp 1 m away costs 0.2 % of irradiance at 256 samples; with one shadow ray to four paths it costs 0.05 %.
_TEXELS_PER_LIGHT_SAMPLE = 4
# Of radiance only lights that are so much denser sampled this way are: a texel that a lamp fills has no error but that of their number.
_RADIANCE_CUTOFF = 4.0
# Paths a thread traces before it asks for more: a few hundred milliseconds' work.
_CHUNK_PATHS = 1 << 18


@kernel
def _add_light(gain, radiance, d, normals, lanes):  # type: ignore[no-untyped-def]
    """Radiance from a direction into the irradiance about every normal."""
    fr, fg, fb = np.float32(gain * radiance[0]), np.float32(gain * radiance[1]), np.float32(gain * radiance[2])
    fx, fy, fz = np.float32(d[0]), np.float32(d[1]), np.float32(d[2])
    for i in range(normals.shape[1]):
        f = max(normals[0, i] * fx + normals[1, i] * fy + normals[2, i] * fz, np.float32(0))
        lanes[0, i] += f * fr
        lanes[1, i] += f * fg
        lanes[2, i] += f * fb


@kernel
def _capture_density(d, texels):  # type: ignore[no-untyped-def]
    """Of capture rays in a unit direction, a round; its 1-norm takes it onto the octahedron."""
    reach = 1 / (abs(d[0]) + abs(d[1]) + abs(d[2]))
    return texels / 4 * (reach * reach * reach)


@kernel
def _capture_texel(d, texels):  # type: ignore[no-untyped-def]
    """Which one a unit direction leads through: that of :func:`bake_core.octahedral.dir_to_oct`."""
    resolution = round(math.sqrt(texels))
    reach = 1 / (abs(d[0]) + abs(d[1]) + abs(d[2]))
    x, y = d[0] * reach, d[1] * reach
    if d[2] < 0:
        x, y = math.copysign(1 - abs(y), x), math.copysign(1 - abs(x), y)
    row, column = int((y + 1) / 2 * resolution), int((x + 1) / 2 * resolution)
    return min(row, resolution - 1) * resolution + min(column, resolution - 1)


@kernel
def _add_sample(radiance, d, pdf, texels, rate, normals, lanes, seen):  # type: ignore[no-untyped-def]
    """Light that was drawn in a direction, into irradiance and into the capture texel there; the balance heuristic's share of it."""
    density = _capture_density(d, texels)
    gain = 1 / (density + rate * pdf)
    _add_light(gain, radiance, d, normals, lanes)
    if seen.shape[0] and rate * pdf > _RADIANCE_CUTOFF * density:
        texel = _capture_texel(d, texels)
        seen[texel, 0] += density * gain * radiance[0]
        seen[texel, 1] += density * gain * radiance[1]
        seen[texel, 2] += density * gain * radiance[2]


def _add_sky(t, ray, ray_bits, position, u, v, texels, rate, normals, lanes, seen):  # type: ignore[no-untyped-def]
    radiance, d, pdf = sample_sky(t.sky, np.float64(u), np.float64(v))
    if pdf > 0 and not blocked(t, ray, ray_bits, position[0], position[1], position[2], d[0], d[1], d[2], INFINITE):
        _add_sample(radiance, d, pdf, texels, rate, normals, lanes, seen)
    return True


# One sample of the sky, where there is one.
_add_sample_of_sky = either("sky")(_add_sky)(lambda t, ray, ray_bits, position, u, v, texels, rate, normals, lanes, seen: False)


@kernel
def _sample_lights(t, ray, ray_bits, position, texel, texels, rounds, rate, key, normals, lanes, irradiance, seen):  # type: ignore[no-untyped-def]
    """What comes straight from emitters and sky, one sample of each a round; its weight is what the balance heuristic leaves to it.

    Parameters
    ----------
    rounds : (int, int)
        Half-open range of points of the half's sequence; one a round.
    rate : float
        Light samples a round over the whole probe.
    irradiance : (3, m) float64, added to
    seen : (texels, 3) or (0, 3) float64, added to
        Radiance of capture texels, where it is kept.
    """
    m = normals.shape[1]
    for i in range(m):
        lanes[0, i] = lanes[1, i] = lanes[2, i] = np.float32(0)
    for point in range(rounds[0], rounds[1]):
        # One sequence over the whole probe: rounds follow one another in it, so a pass is one run of points.
        reversed_index = reverse_bits(uint32((point * texels + texel) // _TEXELS_PER_LIGHT_SAMPLE))
        u, v = sobol_pair(reversed_index, key)
        if t.emitters.cdf.shape[0]:
            # The number that picks the emitter goes on to place the point on it: all emitters together are stratified as one square.
            # Where its bits are too few for both, the emitter is one of very many, or so faint that capture rays have its share.
            emitter, chance, rest = pick_emitter(t, position, np.float64(u))
            le, d, pdf, end = sample_emitter(t, position[0], position[1], position[2], emitter, chance, np.float32(rest), v)
            x, y, z = end[0] - position[0], end[1] - position[1], end[2] - position[2]
            if pdf > 0 and not blocked(t, ray, ray_bits, position[0], position[1], position[2], x, y, z, np.float32(1)):
                _add_sample(le, d, pdf, texels, rate, normals, lanes, seen)
        # Emitters and sky may share their numbers: each sum stays unbiased.
        _add_sample_of_sky(t, ray, ray_bits, position, u, v, texels, rate, normals, lanes, seen)
    for i in range(m):
        irradiance[0, i] += lanes[0, i]
        irradiance[1, i] += lanes[1, i]
        irradiance[2, i] += lanes[2, i]


@kernel
def _morton(row, column):  # type: ignore[no-untyped-def]
    """Neighbours in two dimensions stay close in one: bits in turn (Morton 1966). Up to 2⁸ rows."""
    code = 0
    for bit in range(8):
        code |= (column >> bit & 1) << (2 * bit) | (row >> bit & 1) << (2 * bit + 1)
    return code


@kernel
def _count(span, j):  # type: ignore[no-untyped-def]
    """How many of a half's samples [span[0], span[1]) are of its scramble j."""
    return (span[1] - j + SCRAMBLES_PER_HALF - 1) // SCRAMBLES_PER_HALF - (span[0] - j + SCRAMBLES_PER_HALF - 1) // SCRAMBLES_PER_HALF


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
    mean is F, so nothing biases the sum, at any number of samples; where this pass has none of the other half it is 0. Where L is constant
    the sum is exact (a furnace tests it). Halves are no longer quite independent: the covariance of two is the square of one's cov(L, f).
    """
    ray_bits = ray.view(np.uint32)
    lanes, light = room
    m = normals.shape[1]
    texels = resolution * resolution
    # Light samples a round: a round is one sample through every texel.
    lit = has_sky(t) or t.emitters.cdf.shape[0] > 0
    light_rate = float((texels + _TEXELS_PER_LIGHT_SAMPLE - 1) // _TEXELS_PER_LIGHT_SAMPLE) if lit else 0.0
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
                    for _ in range(_count(spans[p, half], j)):
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
                            rest = 1 - share if light_rate * light_pdf <= _RADIANCE_CUTOFF * density else 0.0
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
                if drawn == 0 and spans[p, other, 1] == 0:
                    # The only sample of all has nobody else to ask.
                    other, drawn = half, spans[p, half, 1]
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
                    count = _count(spans[p, half], j)
                    own, into = lanes[scramble], irradiance[p, block, scramble]
                    weight = np.float32(count)
                    for i in range(m):
                        missed = weight * cosines[texel, i] - own[3, i]
                        into[0, i] += own[0, i] + mean_r * missed
                        into[1, i] += own[1, i] + mean_g * missed
                        into[2, i] += own[2, i] + mean_b * missed
                    if light_rate and texel % _TEXELS_PER_LIGHT_SAMPLE == 0:
                        rounds, spare, seen = (point, point + count), lanes[SCRAMBLES], radiance[p, block, half]
                        at = (x0, y0, z0)
                        _sample_lights(t, ray, ray_bits, at, texel, texels, rounds, light_rate, light_key, normals, spare, into, seen)
                    point += count
    return DONE


@entry_kernel
def _distance_kernel(t, ray, positions, directions, cancelled, distance, normal, back):  # type: ignore[no-untyped-def]
    """One ray through each direction: distance (inf for a miss), geometric normal towards the probe, whether it met a back face."""
    ray_bits = ray.view(np.uint32)
    for p in range(positions.shape[0]):
        if cancelled[0]:
            return CANCELLED
        for i in range(directions.shape[0]):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            distance[p, i] = np.inf
            normal[p, i, 0] = normal[p, i, 1] = normal[p, i, 2] = 0
            back[p, i] = False
            x, y, z = positions[p, 0], positions[p, 1], positions[p, 2]
            if find_surface(t, ray, ray_bits, x, y, z, dx, dy, dz):
                point, n, _, _, material, front, _, _, _, _ = surface(t, ray_bits, ray, dx, dy, dz)
                x, y, z = point[0] - x, point[1] - y, point[2] - z
                distance[p, i] = math.sqrt(x * x + y * y + z * z)
                normal[p, i, 0], normal[p, i, 1], normal[p, i, 2] = n[0], n[1], n[2]
                back[p, i] = not front and not t.materials.double_sided[material]
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


def capture_distance(
    tracer: Tracer, positions: F64, resolution: int, *, cancelled: NDArray[np.uint8]
) -> tuple[F64, F32, NDArray[np.bool_], int]:
    """Distances, normals and back faces through texel centres; releases the GIL.

    Parameters
    ----------
    positions : (p, 3) float64
        Metres, local frame.
    resolution : int
        Texels along the map's side.
    cancelled : (1,) uint8

    Returns
    -------
    distance : (p, resolution²) float64
        Metres; inf where nothing is hit.
    normal : (p, resolution², 3) float32
        Geometric, unit, towards the probe; zeros for a miss.
    back : (p, resolution²) bool
        Back face of a single-sided surface.
    rays : int
        Traced for them.

    Raises
    ------
    Cancelled
    """
    directions = texel_directions(resolution).reshape(-1, 3)
    n = len(directions)
    distance, normal = np.empty((len(positions), n)), np.empty((len(positions), n, 3), np.float32)
    back = np.empty((len(positions), n), np.bool_)
    ray = new_rayhit()
    if _distance_kernel(tracer.tables, ray, positions, directions, cancelled, distance, normal, back) == CANCELLED:
        raise Cancelled
    return distance, normal, back, rays_traced(ray)
