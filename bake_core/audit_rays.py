"""What audits trace from probes: light over the whole sphere for irradiance, distances in a lobe for visibility.

No texel, control variate or filter is in these estimators, which is what makes them fit to judge those that have them. Of irradiance at
surfaces, :mod:`bake_core.receiver_irradiance` is the judge.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.embree import new_rayhit
from bake_core.environment import has_sky, sample_sky
from bake_core.errors import Cancelled
from bake_core.filtering import VISIBILITY_SHARPNESS
from bake_core.kernels import CANCELLED, DONE, either, entry_kernel, kernel
from bake_core.light_tree import pick_emitter
from bake_core.next_event import sample_emitter
from bake_core.sampling import basis, mix64, reverse_bits, sobol_pair
from bake_core.surfaces import INFINITE, blocked, find_surface, surface
from bake_core.tracer import Tracer
from bake_core.transport import trace_path

F64 = NDArray[np.float64]

_HALVES = 2
_UNIFORM_PDF = 1 / (4 * math.pi)


def sphere_irradiance(
    tracer: Tracer, positions: F64, normals: F64, samples: int, seed: int, *, threads: int, cancelled: NDArray[np.uint8]
) -> F64:
    """Irradiance about many normals at once from paths in all directions, twice and independently.

    Paths leave uniformly over the sphere, and with each of them goes one sample of the emitters and one of the sky; the balance heuristic
    weighs them (Veach 1997). A path counts for every normal that it is above.

    Parameters
    ----------
    positions : (p, 3) float64
        Local frame, metres.
    normals : (m, 3) float64
        Unit.
    samples : int
        Paths from each position for each of the two estimates.
    threads : int
        The result does not depend on it.

    Returns
    -------
    (2, p, m, 3) float64
        No 1/π inside.

    Raises
    ------
    Cancelled
    """
    out = np.zeros((_HALVES, len(positions), len(normals), 3))
    key = np.uint64(seed)

    def trace(i: int) -> int:
        # Rows of their own: a kernel is compiled for each way that an array may lie in memory.
        into = np.zeros((_HALVES, 1, len(normals), 3))
        status: int = _sphere_kernel(tracer.tables, new_rayhit(), positions[i : i + 1], normals, i, samples, key, cancelled, into)
        out[:, i] = into[:, 0]
        return status

    with ThreadPoolExecutor(threads) as pool:
        if any(status == CANCELLED for status in pool.map(trace, range(len(positions)))):
            raise Cancelled
    return out


@kernel
def _add(normals, gain, radiance, d, out):  # type: ignore[no-untyped-def]
    for i in range(normals.shape[0]):
        cosine = normals[i, 0] * d[0] + normals[i, 1] * d[1] + normals[i, 2] * d[2]
        if cosine > 0:
            out[i, 0] += gain * cosine * radiance[0]
            out[i, 1] += gain * cosine * radiance[1]
            out[i, 2] += gain * cosine * radiance[2]


def _sky_light(t, ray, ray_bits, x, y, z, u, v, gain, normals, out):  # type: ignore[no-untyped-def]
    radiance, d, pdf = sample_sky(t.sky, np.float64(u), np.float64(v))
    if pdf > 0 and not blocked(t, ray, ray_bits, x, y, z, d[0], d[1], d[2], INFINITE):
        _add(normals, gain / (_UNIFORM_PDF + pdf), radiance, d, out)
    return True


_add_sky_light = either("sky")(_sky_light)(lambda t, ray, ray_bits, x, y, z, u, v, gain, normals, out: False)


@entry_kernel
def _sphere_kernel(t, ray, positions, normals, first, samples, seed, cancelled, out):  # type: ignore[no-untyped-def]
    ray_bits = ray.view(np.uint32)
    for p in range(positions.shape[0]):
        x, y, z = positions[p, 0], positions[p, 1], positions[p, 2]
        for half in range(out.shape[0]):
            key = mix64(mix64(seed) + (uint64(half) << uint64(32)) + uint64(first + p))
            light_key = mix64(key)
            into = out[half, p]
            gain = 1.0 / samples
            for sample in range(samples):
                if cancelled[0]:
                    return CANCELLED
                index = uint32(sample)
                reversed_index = reverse_bits(index)
                u, v = sobol_pair(reversed_index, key)
                dz = 1 - 2 * float(u)
                sine, phi = math.sqrt(max(1 - dz * dz, 0.0)), 2 * math.pi * float(v)
                d = (sine * math.cos(phi), sine * math.sin(phi), dz)
                # Of no width: a look-up in a texture that is as fine as it can be is no estimate of what a wider one would have found.
                emitted, direct, indirect, _, light_pdf = trace_path(
                    t, ray, ray_bits, x, y, z, d[0], d[1], d[2], reversed_index, index, key, False, 0.0, 0
                )
                share = _UNIFORM_PDF / (_UNIFORM_PDF + light_pdf)
                radiance = (
                    share * emitted[0] + direct[0] + indirect[0],
                    share * emitted[1] + direct[1] + indirect[1],
                    share * emitted[2] + direct[2] + indirect[2],
                )
                _add(normals, gain / _UNIFORM_PDF, radiance, d, into)
                if t.emitters.cdf.shape[0]:
                    a, b = sobol_pair(reversed_index, light_key)
                    emitter, chance, rest = pick_emitter(t, (x, y, z), np.float64(a))
                    le, w, pdf, end = sample_emitter(t, x, y, z, emitter, chance, np.float32(rest), b)
                    if pdf > 0 and not blocked(t, ray, ray_bits, x, y, z, end[0] - x, end[1] - y, end[2] - z, np.float32(1)):
                        _add(normals, gain / (_UNIFORM_PDF + pdf), le, w, into)
                if has_sky(t):
                    a, b = sobol_pair(reversed_index, light_key + uint64(2))
                    _add_sky_light(t, ray, ray_bits, x, y, z, a, b, gain, normals, into)
    return DONE


def lobe_moments(
    tracer: Tracer, positions: F64, directions: F64, limits: F64, samples: int, seed: int, cancelled: NDArray[np.uint8]
) -> F64:
    """Mean and mean squared distance over cosⁿ lobes, twice and independently.

    Parameters
    ----------
    positions, directions : (n, 3) float64
        Local frame, metres; unit.
    limits : (n,) float64
        Metres; distances are clamped to it, misses too.
    samples : int
        Rays for each of the two estimates.

    Returns
    -------
    (2, n, 2) float64
        Metres and m².

    Raises
    ------
    Cancelled
    """
    out = np.zeros((_HALVES, len(positions), 2))
    if _lobe_kernel(tracer.tables, new_rayhit(), positions, directions, limits, samples, np.uint64(seed), cancelled, out) == CANCELLED:
        raise Cancelled
    return out


@entry_kernel
def _lobe_kernel(t, ray, positions, directions, limits, samples, seed, cancelled, out):  # type: ignore[no-untyped-def]
    """Directions have pdf (n + 1) cosⁿθ / 2π: Walter et al. 2007's Phong sampling, cosθ = u^(1 / (n + 1))."""
    ray_bits = ray.view(np.uint32)
    for i in range(positions.shape[0]):
        if cancelled[0]:
            return CANCELLED
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        nx, ny, nz = directions[i, 0], directions[i, 1], directions[i, 2]
        tx, ty, tz, bx, by, bz = basis(np.float32(nx), np.float32(ny), np.float32(nz))
        for half in range(out.shape[0]):
            key = mix64(mix64(seed) + (uint64(half) << uint64(32)) + uint64(i))
            mean = square = 0.0
            for sample in range(samples):
                u, v = sobol_pair(reverse_bits(uint32(sample)), key)
                cosine = (1 - float(u)) ** (1 / (VISIBILITY_SHARPNESS + 1.0))
                sine, phi = math.sqrt(max(1 - cosine * cosine, 0.0)), 2 * math.pi * float(v)
                a, b = sine * math.cos(phi), sine * math.sin(phi)
                dx, dy, dz = a * tx + b * bx + cosine * nx, a * ty + b * by + cosine * ny, a * tz + b * bz + cosine * nz
                distance = limits[i]
                if find_surface(t, ray, ray_bits, x, y, z, dx, dy, dz):
                    point, _, _, _, _, _, _, _, _, _ = surface(t, ray_bits, ray, dx, dy, dz)
                    px, py, pz = point[0] - x, point[1] - y, point[2] - z
                    distance = min(distance, math.sqrt(px * px + py * py + pz * pz))
                mean += distance
                square += distance * distance
            out[half, i, 0], out[half, i, 1] = mean / samples, square / samples
    return DONE
