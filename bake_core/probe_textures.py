"""A bundle's volumes on a Vulkan device: three textures for all of them, and the reference GLSL module bound to these.

Devices bind few samplers at a time, so the volumes lie in one array texture an output, layers after layers; each is put into the
lower corner of a layer as large as the largest needs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.shader_compiler import module_source
from bake_core.shader_constants import bundle_constants, probe_texels
from bake_core.vulkan import Device, Image, texture

F32 = NDArray[np.float32]


def probe_textures(device: Device, volumes: Sequence[VolumeData]) -> list[Image]:
    """Irradiance, walls and the probe tables of all volumes."""
    irradiance, walls, probes = _texels(volumes)
    # No device need offer textures of three channels.
    rgba = [np.concatenate([t, np.zeros((*t.shape[:3], 1), np.float32)], -1) for t in irradiance]
    stacks = (_stacked(rgba), _stacked(walls), _stacked(probes))
    return [texture(device, stack, linear=linear) for stack, linear in zip(stacks, (True, True, False), strict=True)]


def probe_module(volumes: Sequence[VolumeData], first_binding: int, frame: ArrayLike = (0.0, 0.0, 0.0)) -> str:
    """GLSL that declares the textures of :func:`probe_textures` from `first_binding` on, followed by the reference module.

    Parameters
    ----------
    volumes : sequence of VolumeData
    first_binding : int
    frame : (3,) float
        World position of the zero of the shader's frame, metres.
    """
    lines = []
    for i, (name, texels) in enumerate(zip(("Irradiance", "Walls", "Probes"), _texels(volumes), strict=True)):
        height, width = (max(t.shape[axis] for t in texels) for axis in (1, 2))
        first = np.cumsum([0] + [len(t) for t in texels]).tolist()
        lines.append(f"layout(set = 0, binding = {first_binding + i}) uniform sampler2DArray host{name};")
        # How far a volume's layers reach across the texture's, and which is its first.
        places = [f"vec3({t.shape[2] / width!r}, {t.shape[1] / height!r}, {layer}.0)" for t, layer in zip(texels, first, strict=False)]
        choices = "".join(f" if (v == {v}) place = {place};" for v, place in enumerate(places) if v)
        lines.append(f"vec3 place{name}(int v) {{ vec3 place = {places[0]};{choices} return place; }}")
    for name, kind, swizzle in (("Irradiance", "vec3", "rgb"), ("Walls", "float", "r")):
        look_up = f"textureLod(host{name}, vec3(p.xy * place.xy, p.z + place.z), 0.0).{swizzle}"
        lines.append(f"{kind} read{name}(int v, vec3 p) {{ vec3 place = place{name}(v); return {look_up}; }}")
    lines += [
        "#define OB_IRRADIANCE(v, uvw) readIrradiance(v, uvw)",
        "#define OB_WALLS(v, uvw) readWalls(v, uvw)",
        "#define OB_PROBE(v, texel) texelFetch(hostProbes, texel + ivec3(0, 0, int(placeProbes(v).z)), 0)",
    ]
    return "\n".join(lines) + "\n" + module_source(bundle_constants(volumes, frame))


def _texels(volumes: Sequence[VolumeData]) -> tuple[list[F32], list[F32], list[F32]]:
    """Irradiance, walls and probe tables, one array a volume."""
    irradiance = [v.atlases["irradiance"].texels for v in volumes]
    probes = [probe_texels(v) for v in volumes]
    walls = [v.atlases["walls"].texels if "walls" in v.atlases else np.zeros((1, 1, 1, 1), np.float32) for v in volumes]
    return irradiance, walls, probes


def _stacked(parts: Sequence[F32]) -> F32:
    height, width = max(p.shape[1] for p in parts), max(p.shape[2] for p in parts)
    return np.concatenate([np.pad(p, ((0, 0), (0, height - p.shape[1]), (0, width - p.shape[2]), (0, 0))) for p in parts])
