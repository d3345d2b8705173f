"""Path-traced irradiance about normals at points, on surfaces and in the open: the truth that a bundle's answers are held against.

What arrives is measured as the query defines it: everything but the direct light of punctual and directional lights. Paths leave a point
by the cosine, and one sample of the emitters and one of the sky go with each, weighted by the balance heuristic (Veach 1997): the same
estimators as at any other vertex of a path, and no probe, texel or filter in between.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.embree import new_rayhit
from bake_core.environment import has_sky
from bake_core.errors import Cancelled
from bake_core.kernels import CANCELLED, DONE, entry_kernel
from bake_core.materials import no_gloss
from bake_core.next_event import from_emitters, from_sky
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.tracer import Tracer
from bake_core.transport import trace_by_cosine

F64 = NDArray[np.float64]

# Points a thread takes at once: a fraction of a second's work.
_CHUNK = 32


def irradiance_at(
    tracer: Tracer,
    stands: F64,
    *,
    samples: int,
    scrambles: int,
    seed: int,
    threads: int = 1,
    advance: Callable[[float], None] | None = None,
    cancelled: NDArray[np.uint8] | None = None,
) -> F64:
    """Irradiance at points by path tracing, to the spec's `max_bounces`; the same bits for any number of threads.

    Parameters
    ----------
    stands : (n, 10) float64
        Local frame: point, geometric and shading normal, and how far to leave the surface (0 in the open, where both normals are one). Of
        receivers: ``stands_of(tracer, receivers.places)``.
    samples : int
        Paths from each point for each estimate.
    scrambles : int
        Independent estimates: their mean is the result, their spread its standard error.
    advance : callable, optional
        Told the fraction of the work that has been done since it was last called.
    cancelled : (1,) uint8, optional
        Set it from any thread to stop within one point.

    Returns
    -------
    (scrambles, n, 3) float64
        E about the shading normal, no 1/π inside. As surfaces reflect it: directions that the shading normal's hemisphere has below the
        surface count mirrored (:mod:`bake_core.materials`).

    Raises
    ------
    Cancelled
    """
    return estimate(
        _irradiance_kernel,
        tracer,
        stands,
        samples=samples,
        scrambles=scrambles,
        seed=seed,
        threads=threads,
        advance=advance,
        cancelled=cancelled,
    )


def estimate(
    kernel: Callable[..., int],
    tracer: Tracer,
    rows: F64,
    *,
    samples: int,
    scrambles: int,
    seed: int,
    threads: int = 1,
    advance: Callable[[float], None] | None = None,
    cancelled: NDArray[np.uint8] | None = None,
) -> F64:
    """(scrambles, n, 3) of what a kernel estimates for each of n rows, some rows at a time on each thread.

    Parameters
    ----------
    kernel : callable
        (tables, ray, some rows, the number of the first of them, samples, seed, flag, out) → whether it was stopped.
    rows : (n, k) float64

    Raises
    ------
    Cancelled
    """
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    n = len(rows)
    out = np.zeros((scrambles, n, 3))

    def trace(first: int) -> int:
        part = slice(first, first + _CHUNK)
        # An array of its own: a kernel is compiled for each way that one may lie in memory.
        into = np.zeros((scrambles, len(rows[part]), 3))
        status = kernel(tracer.tables, new_rayhit(), rows[part], first, samples, np.uint64(seed), flag, into)
        out[:, part] = into
        return status

    with ThreadPoolExecutor(threads) as pool:
        for status in pool.map(trace, range(0, n, _CHUNK)):
            if status == CANCELLED:
                raise Cancelled
            if advance is not None:
                advance(min(_CHUNK, n) / n)
    return out


@entry_kernel
def _irradiance_kernel(t, ray, stands, first, samples, seed, cancelled, out):  # type: ignore[no-untyped-def]
    """Mean over paths and light samples from each point for each scramble; `first` is the number of the first point."""
    ray_bits = ray.view(np.uint32)
    look = no_gloss(t)
    for i in range(out.shape[1]):
        s = stands[i]
        p, n, epsilon = (s[0], s[1], s[2]), (s[3], s[4], s[5], s[6], s[7], s[8]), s[9]
        for scramble in range(out.shape[0]):
            if cancelled[0]:
                return CANCELLED
            key = mix64(mix64(seed) + (uint64(scramble) << uint64(32)) + uint64(first + i))
            red = green = blue = 0.0
            for sample in range(samples):
                index = uint32(sample)
                reversed_index = reverse_bits(index)
                if t.emitters.cdf.shape[0]:
                    choice, _ = sobol_pair(reversed_index, key + uint64(1))
                    u, v = sobol_pair(reversed_index, key + uint64(2))
                    r, g, b = from_emitters(t, ray, ray_bits, p, n, epsilon, False, look, u, v, choice)
                    red += r
                    green += g
                    blue += b
                if has_sky(t):
                    u, v = sobol_pair(reversed_index, key + uint64(4))
                    r, g, b = from_sky(t, ray, ray_bits, p, n, epsilon, False, look, u, v)
                    red += r
                    green += g
                    blue += b
                # Of no width: a look-up in a texture that is as fine as it can be is no estimate of what a wider one would have found.
                u, v = sobol_pair(reversed_index, key)
                r, g, b = trace_by_cosine(t, ray, ray_bits, p, n, epsilon, u, v, reversed_index, index, key, False, 0)
                red += r
                green += g
                blue += b
            # Over the pdf cosθ/π, radiance times cosine is π times radiance.
            scale = math.pi / samples
            out[scramble, i, 0], out[scramble, i, 1], out[scramble, i, 2] = scale * red, scale * green, scale * blue
    return DONE
