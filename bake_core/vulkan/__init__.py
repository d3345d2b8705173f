"""Vulkan 1.3 as far as pictures need it: buffers, textures, targets, draws and dispatches. Nothing else in octobake touches Vulkan.

Importing this package where there is no Vulkan loader raises MachineError ``vulkan.missing``, so import it where it is used.
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
