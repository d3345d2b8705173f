"""``obTrace`` on a Vulkan device, for many rays: what the numpy twin is held against, and what is told of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.item_shader import answer_items
from bake_core.light_field import HIT, MISS, Traces
from bake_core.vulkan import Device

F64 = NDArray[np.float64]

_ANSWER = """
void answer(vec4 given[2], out vec4 found[3]) {
    ObTrace seen = obTrace(given[0].xyz, given[1].xyz);
    found[0] = vec4(seen.normal, seen.distance);
    found[1] = vec4(vec3(seen.probe), float(seen.volume));
    found[2] = vec4(float(seen.verdict));
}
"""


def trace_on_device(device: Device, volumes: Sequence[VolumeData], origins: ArrayLike, directions: ArrayLike, frame: F64) -> Traces:
    """As :func:`bake_core.light_field.trace`, by the GLSL module; how many probes were asked is not told (0).

    Parameters
    ----------
    frame : (3,) float64
        World position near the rays: zero of the float32 positions that the shader gets.
    """
    o, d = (np.asarray(x, np.float64).reshape(-1, 3) for x in (origins, directions))
    found = answer_items(device, _ANSWER, [o - frame, d], 3, volumes, frame).astype(np.float64)
    verdict, volume = found[:, 2, 0].astype(np.int64), found[:, 1, 3].astype(np.int64)
    counts = np.array([v.counts for v in volumes])[np.maximum(volume, 0)]
    place = found[:, 1, :3].astype(np.int64)
    probe = place[:, 0] + counts[:, 0] * (place[:, 1] + counts[:, 1] * place[:, 2])
    distance = np.where(verdict == MISS, np.inf, found[:, 0, 3])
    normal = np.where((verdict == HIT)[:, None], found[:, 0, :3], 0)
    return Traces(verdict, distance, normal, volume, np.where(volume < 0, -1, probe), np.zeros(len(o), np.int64))
