"""A bundle's volumes on a Vulkan device: a few textures for all of them, and the reference GLSL module bound to these.

Devices bind few samplers at a time, so the volumes lie in one array texture an output, layers after layers; each is put into the
lower corner of a layer as large as the largest needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.shader_compiler import module_source
from bake_core.shader_constants import bundle_constants, probe_texels
from bake_core.volume_chains import CHAINS, chain_shape, traceable, volume_chain
from bake_core.vulkan import Device, Image, texture

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class _Map:
    """What one texture holds, and what GLSL takes from it.

    `source` is an output, ``probes`` or a chain; `components` are those of a texel that its macro gives, `linear` says how it is read.
    """

    source: str
    kind: str
    components: str
    linear: bool

    @property
    def name(self) -> str:
        return self.source.capitalize()

    @property
    def macro(self) -> str:
        return "PROBE" if self.source == "probes" else self.source.upper()

    def texels(self, volume: VolumeData) -> F32:
        if self.source == "probes":
            return probe_texels(volume)
        if self.source in CHAINS:
            return volume_chain(volume, self.source)
        # A map that the bundle left out is never looked at.
        return volume.atlases[self.source].texels if self.source in volume.atlases else np.zeros((1, 1, 1, 1), np.float32)

    def shape(self, volume: VolumeData) -> tuple[int, ...]:
        return chain_shape(volume, self.source) if self.source in CHAINS else self.texels(volume).shape


_DIFFUSE = (_Map("irradiance", "vec3", "rgb", True), _Map("walls", "float", "r", True), _Map("probes", "vec4", "rgba", False))
_GLOSSY = (
    _Map("distance", "float", "r", False),
    _Map("normal", "vec3", "rgb", False),
    _Map("nearest", "float", "r", False),
    _Map("radiance", "vec3", "rgb", True),
    _Map("gloss", "vec3", "rgb", True),
)


def _maps(volumes: Sequence[VolumeData]) -> tuple[_Map, ...]:
    return _DIFFUSE + _GLOSSY if traceable(volumes) else _DIFFUSE


def probe_textures(device: Device, volumes: Sequence[VolumeData]) -> list[Image]:
    """Irradiance, walls and the probe tables of all volumes; and what rays are traced through, where they have it."""
    return [texture(device, texels, linear=linear) for texels, linear in probe_layers(volumes)]


def probe_layers(volumes: Sequence[VolumeData]) -> list[tuple[F32, bool]]:
    """What :func:`probe_textures` uploads: texels (layers, height, width, 1 or 4) float32, and whether they are filtered."""
    return [(_stacked([_four(m.texels(v)) for v in volumes]), m.linear) for m in _maps(volumes)]


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
    for i, m in enumerate(_maps(volumes)):
        shapes = [m.shape(v) for v in volumes]
        height, width = (max(shape[axis] for shape in shapes) for axis in (1, 2))
        first = np.cumsum([0] + [shape[0] for shape in shapes]).tolist()
        lines.append(f"layout(set = 0, binding = {first_binding + i}) uniform sampler2DArray host{m.name};")
        # How far a volume's layers reach across the texture's, and which is its first.
        places = [f"vec3({shape[2] / width!r}, {shape[1] / height!r}, {layer}.0)" for shape, layer in zip(shapes, first, strict=False)]
        choices = "".join(f" if (v == {v}) place = {place};" for v, place in enumerate(places) if v)
        lines.append(f"vec3 place{m.name}(int v) {{ vec3 place = {places[0]};{choices} return place; }}")
        if m.linear:
            look_up = f"textureLod(host{m.name}, vec3(p.xy * place.xy, p.z + place.z), 0.0).{m.components}"
            lines.append(f"{m.kind} read{m.name}(int v, vec3 p) {{ vec3 place = place{m.name}(v); return {look_up}; }}")
        else:
            look_up = f"texelFetch(host{m.name}, p + ivec3(0, 0, int(place{m.name}(v).z)), 0).{m.components}"
            lines.append(f"{m.kind} read{m.name}(int v, ivec3 p) {{ return {look_up}; }}")
        lines.append(f"#define OB_{m.macro}(v, at) read{m.name}(v, at)")
    return "\n".join(lines) + "\n" + module_source(bundle_constants(volumes, frame), traced=traceable(volumes))


def _four(texels: F32) -> F32:
    """No device need offer textures of three channels."""
    return np.concatenate([texels, np.zeros((*texels.shape[:3], 1), np.float32)], -1) if texels.shape[3] == 3 else texels


def _stacked(parts: Sequence[F32]) -> F32:
    height, width = max(p.shape[1] for p in parts), max(p.shape[2] for p in parts)
    return np.concatenate([np.pad(p, ((0, 0), (0, height - p.shape[1]), (0, width - p.shape[2]), (0, 0))) for p in parts])
