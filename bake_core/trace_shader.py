"""``obTrace`` on a Vulkan device, for many rays: what the numpy twin is held against, and what is told of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.light_field import HIT, MISS, Traces
from bake_core.probe_textures import probe_module, probe_textures
from bake_core.shader_compiler import compile_glsl
from bake_core.vulkan import Bindings, Device, compute_pipeline, storage

F64 = NDArray[np.float64]

_GROUP = 64
_SHADER = """#version 450
layout(local_size_x = 64) in;
layout(set = 0, binding = 0) readonly buffer Rays { vec4 rays[]; };
layout(set = 0, binding = 1) writeonly buffer Found { vec4 found[]; };
layout(push_constant) uniform Push { int count; };
"""
_MAIN = """
void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i < count) {
        ObTrace seen = obTrace(rays[2 * i].xyz, rays[2 * i + 1].xyz);
        found[3 * i] = vec4(seen.normal, seen.distance);
        found[3 * i + 1] = vec4(vec3(seen.probe), float(seen.volume));
        found[3 * i + 2] = vec4(float(seen.verdict));
    }
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
    n = len(o)
    packed = np.zeros((n, 2, 4), np.float32)
    packed[:, 0, :3], packed[:, 1, :3] = o - frame, d
    source, result = storage(device, packed), storage(device, n * 48)
    bindings = Bindings(device, [source, result, *probe_textures(device, volumes)])
    program = compile_glsl(_SHADER + probe_module(volumes, 2, frame) + _MAIN, "comp", "trace-check")
    pipeline = compute_pipeline(device, program, bindings)
    device.run(lambda commands: commands.dispatch(pipeline, (n + _GROUP - 1) // _GROUP, np.int32(n).tobytes()))
    found = result.read(np.float32, (n, 3, 4)).astype(np.float64)
    verdict, volume = found[:, 2, 0].astype(np.int64), found[:, 1, 3].astype(np.int64)
    counts = np.array([v.counts for v in volumes])[np.maximum(volume, 0)]
    place = found[:, 1, :3].astype(np.int64)
    probe = place[:, 0] + counts[:, 0] * (place[:, 1] + counts[:, 1] * place[:, 2])
    distance = np.where(verdict == MISS, np.inf, found[:, 0, 3])
    normal = np.where((verdict == HIT)[:, None], found[:, 0, :3], 0)
    return Traces(verdict, distance, normal, volume, np.where(volume < 0, -1, probe), np.zeros(n, np.int64))
