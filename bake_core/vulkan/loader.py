"""The Vulkan loader, opened when it is first used: what needs no pictures works without it."""

from __future__ import annotations

from functools import cache
from typing import Any

from bake_core.errors import MachineError

INSTALL = "install them (Debian, Ubuntu: apt-get install libvulkan1 mesa-vulkan-drivers)"


@cache
def _package() -> Any:
    try:
        import vulkan
    except OSError:  # the package itself is a dependency; it opens libvulkan.so.1 when it is imported
        raise MachineError("vulkan.missing", f"no Vulkan loader (libvulkan.so.1) and no driver; {INSTALL}") from None
    return vulkan


class _Vulkan:
    """Stands for the package `vulkan`: the same names, looked up when they are used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_package(), name)


vk: Any = _Vulkan()
