"""A bundle's volumes on a Vulkan device: their textures, and the reference GLSL module bound to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from bake_core.bundle import VolumeData
from bake_core.shader_compiler import module_source
from bake_core.shader_constants import bundle_constants, probe_texels
from bake_core.vulkan import Device, Image, texture

# Textures of one volume, in the order of their bindings: the macro that reads it, its GLSL type, its swizzle.
_TEXTURES = (("OB_IRRADIANCE", "vec3", ".rgb"), ("OB_VISIBILITY", "vec2", ".rg"), ("OB_PROBE", "vec4", ""))


def probe_textures(device: Device, volumes: Sequence[VolumeData]) -> list[Image]:
    """Three textures a volume: irradiance, visibility (one texel where the bundle has none) and the probe table."""
    out = []
    for volume in volumes:
        rgb = volume.atlases["irradiance"].texels
        # No device need offer textures of three channels.
        rgba = np.concatenate([rgb, np.zeros((*rgb.shape[:3], 1), np.float32)], -1)
        visibility = volume.atlases.get("visibility")
        moments = np.zeros((1, 1, 1, 2), np.float32) if visibility is None else visibility.texels
        out += [texture(device, rgba, linear=True), texture(device, moments, linear=True)]
        out.append(texture(device, probe_texels(volume), linear=False))
    return out


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
    for v in range(len(volumes)):
        for t, (macro, _, _) in enumerate(_TEXTURES):
            lines.append(f"layout(set = 0, binding = {first_binding + 3 * v + t}) uniform sampler2DArray {macro.lower()}_{v};")
    for macro, kind, swizzle in _TEXTURES:
        look_up, where = ("texelFetch({}, p, 0)", "ivec3") if macro == "OB_PROBE" else ("textureLod({}, p, 0.0)" + swizzle, "vec3")
        # A sampler may not be chosen by an index that differs between neighbours, so the choice is a chain of branches.
        chain = "".join(f"v == {v} ? {look_up.format(f'{macro.lower()}_{v}')} : " for v in range(len(volumes) - 1))
        last = look_up.format(f"{macro.lower()}_{len(volumes) - 1}")
        lines.append(f"{kind} {macro.lower()}(int v, {where} p) {{ return {chain}{last}; }}")
        lines.append(f"#define {macro}(v, p) {macro.lower()}(v, p)")
    return "\n".join(lines) + "\n" + module_source(bundle_constants(volumes, frame))
