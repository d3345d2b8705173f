"""Path-traced radiance along single rays: the truth that a bundle's glossy light is held against.

What arrives is measured as probes measure it: everything but what comes straight from a punctual or directional light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.bundle import VolumeData
from bake_core.kernels import CANCELLED, DONE, entry_kernel
from bake_core.light_field import Traces, arriving, light_field, trace
from bake_core.receiver_irradiance import estimate
from bake_core.sampling import mix64, reverse_bits
from bake_core.scene import Scene
from bake_core.trace_check import Rays, draw_rays
from bake_core.tracer import Tracer
from bake_core.transport import trace_path

F64 = NDArray[np.float64]

# As many as there are receivers.
COUNT = 2048
_SCRAMBLES = 4
_SEED = 0x0C70BA51


@entry_kernel
def _radiance_kernel(t, ray, lines, first, samples, seed, cancelled, out):  # type: ignore[no-untyped-def]
    """Mean over paths along each ray (n, 6) for each scramble; `first` is the number of the first ray."""
    ray_bits = ray.view(np.uint32)
    for i in range(out.shape[1]):
        line = lines[i]
        for scramble in range(out.shape[0]):
            if cancelled[0]:
                return CANCELLED
            key = mix64(mix64(seed) + (uint64(scramble) << uint64(32)) + uint64(first + i))
            red = green = blue = 0.0
            for sample in range(samples):
                index = uint32(sample)
                emitted, direct, indirect, _, _ = trace_path(
                    t, ray, ray_bits, line[0], line[1], line[2], line[3], line[4], line[5], reverse_bits(index), index, key, False, 0.0, 0
                )
                red += emitted[0] + direct[0] + indirect[0]
                green += emitted[1] + direct[1] + indirect[1]
                blue += emitted[2] + direct[2] + indirect[2]
            out[scramble, i, 0], out[scramble, i, 1], out[scramble, i, 2] = red / samples, green / samples, blue / samples
    return DONE


def path_traced_radiance(
    tracer: Tracer,
    rays: Rays,
    *,
    samples: int,
    threads: int = 1,
    advance: Callable[[float], None] = lambda fraction: None,
    cancelled: NDArray[np.uint8] | None = None,
) -> F64:
    """Radiance that arrives along rays; the same bits for any number of threads.

    Parameters
    ----------
    samples : int
        Paths along each ray for each of four independent estimates.
    advance : callable
        Told the fraction of the work that has been done since it was last called.

    Returns
    -------
    (4, n, 3) float64

    Raises
    ------
    Cancelled
    """
    lines = np.concatenate([rays.origins - tracer.origin, rays.directions], 1)
    return estimate(
        _radiance_kernel,
        tracer,
        lines,
        samples=samples,
        scrambles=_SCRAMBLES,
        seed=_SEED,
        threads=threads,
        advance=advance,
        cancelled=cancelled,
    )


def measure_radiance(
    scene: Scene,
    tracer: Tracer,
    volumes: Sequence[VolumeData],
    *,
    samples: int,
    threads: int = 1,
    advance: Callable[[float], None] = lambda fraction: None,
    cancelled: NDArray[np.uint8] | None = None,
) -> tuple[Rays, Traces, F64, F64]:
    """Draw rays as ``trace-check`` does, ask a bundle what arrives along them, and path-trace.

    Parameters
    ----------
    samples : int
        Paths along each ray, all estimates together; a multiple of four.

    Returns
    -------
    rays : Rays
        :data:`COUNT`, or fewer where the volumes hold hardly any surface.
    traces : Traces
    answers : (n, 3) float64
        A mirror's: of no lobe.
    estimates : (4, n, 3) float64

    Raises
    ------
    Cancelled
    """
    rays = draw_rays(scene, tracer, volumes, COUNT, _SEED, cancelled=cancelled)
    traces = trace(light_field(volumes), rays.origins, rays.directions)
    answers = arriving(volumes, traces, rays.origins, rays.directions, 0.0)
    estimates = path_traced_radiance(tracer, rays, samples=samples // _SCRAMBLES, threads=threads, advance=advance, cancelled=cancelled)
    return rays, traces, answers, estimates
