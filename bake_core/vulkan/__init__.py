"""Vulkan 1.3 as far as pictures need it: buffers, textures, targets, draws and dispatches. Nothing else in octobake touches Vulkan.

Making a :class:`Device` where there is no Vulkan raises MachineError ``vulkan.missing``; importing this package does not.
"""

from bake_core.vulkan.commands import Commands, Draw
from bake_core.vulkan.device import Device
from bake_core.vulkan.pipelines import Bindings, Pipeline, compute_pipeline, graphics_pipeline
from bake_core.vulkan.resources import Buffer, Image, color_target, depth_target, storage, texture

__all__ = [
    "Bindings",
    "Buffer",
    "Commands",
    "Device",
    "Draw",
    "Image",
    "Pipeline",
    "color_target",
    "compute_pipeline",
    "depth_target",
    "graphics_pipeline",
    "storage",
    "texture",
]
