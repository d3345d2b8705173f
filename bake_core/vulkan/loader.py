"""The Vulkan loader and what to say where it, or a driver, is missing."""

from __future__ import annotations

from bake_core.errors import MachineError

INSTALL = "install them (Debian, Ubuntu: apt-get install libvulkan1 mesa-vulkan-drivers)"

try:
    import vulkan as vk
except OSError:  # the package itself is a dependency; it opens libvulkan.so.1 when it is imported
    raise MachineError("vulkan.missing", f"no Vulkan loader (libvulkan.so.1) and no driver; {INSTALL}") from None

__all__ = ["INSTALL", "vk"]
