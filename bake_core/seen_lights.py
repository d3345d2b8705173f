"""What a probe sees of emitters and sky, drawn as lights: a lamp's edge is what rays through texels find hardest.

Both ways are combined by the balance heuristic (Veach 1997, "Robust Monte Carlo Methods for Light Transport Simulation").
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint32

from bake_core.environment import sample_sky
from bake_core.kernels import either, kernel
from bake_core.light_tree import pick_emitter
from bake_core.next_event import sample_emitter
from bake_core.sampling import reverse_bits, sobol_pair
from bake_core.surfaces import INFINITE, blocked

# Emitters and sky seen directly are also sampled as lights, once for this many capture texels: a capture ray either hits a lamp or misses
# it, and the edge of a 1 m² lamp 1 m away costs 0.2 % of irradiance at 256 samples; with one shadow ray to four paths it costs 0.05 %.
TEXELS_PER_LIGHT_SAMPLE = 4
# Of radiance only lights that are so much denser sampled this way are: a texel that a lamp fills has no error but that of their number.
_RADIANCE_CUTOFF = 4.0


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
def capture_density(d, texels):  # type: ignore[no-untyped-def]
    """Of capture rays in a unit direction, a round; its 1-norm takes it onto the octahedron."""
    reach = 1 / (abs(d[0]) + abs(d[1]) + abs(d[2]))
    return texels / 4 * (reach * reach * reach)


@kernel
def capture_texel(d, texels):  # type: ignore[no-untyped-def]
    """Which one a unit direction leads through: that of :func:`bake_core.octahedral.dir_to_oct`."""
    resolution = round(math.sqrt(texels))
    reach = 1 / (abs(d[0]) + abs(d[1]) + abs(d[2]))
    x, y = d[0] * reach, d[1] * reach
    if d[2] < 0:
        x, y = math.copysign(1 - abs(y), x), math.copysign(1 - abs(x), y)
    row, column = int((y + 1) / 2 * resolution), int((x + 1) / 2 * resolution)
    return min(row, resolution - 1) * resolution + min(column, resolution - 1)


@kernel
def falls_into_texels(rate, density):  # type: ignore[no-untyped-def]
    """Whether radiance takes its share of light that is drawn so densely in a direction; else capture rays find all of it."""
    return rate > _RADIANCE_CUTOFF * density


@kernel
def _add_sample(radiance, d, pdf, texels, rate, normals, lanes, seen):  # type: ignore[no-untyped-def]
    """Light that was drawn in a direction, into irradiance and into the capture texel there; the balance heuristic's share of it."""
    density = capture_density(d, texels)
    gain = 1 / (density + rate * pdf)
    _add_light(gain, radiance, d, normals, lanes)
    if seen.shape[0] and falls_into_texels(rate * pdf, density):
        texel = capture_texel(d, texels)
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
def sample_lights(t, ray, ray_bits, position, texel, texels, rounds, rate, key, normals, lanes, irradiance, seen):  # type: ignore[no-untyped-def]
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
        reversed_index = reverse_bits(uint32((point * texels + texel) // TEXELS_PER_LIGHT_SAMPLE))
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
