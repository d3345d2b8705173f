"""The reference GLSL module as text, and GLSL to SPIR-V by `glslc`."""

from __future__ import annotations

import subprocess
from typing import Literal

from bake_core.bundle import SHADERS
from bake_core.errors import BakeError, MachineError
from bake_core.shader_files import shader_dir


def module_source(constants: str, *, traced: bool) -> str:
    """The whole module as one text, in include order, for hosts without ``#include``.

    Parameters
    ----------
    constants : str
        A bundle's constants.glsl.
    traced : bool
        With the part that traces rays, and the macros that it needs.
    """
    octahedral, grid, irradiance, trace = (shader_text(name) for name in SHADERS)
    return "\n".join((octahedral, grid, constants, irradiance, *([trace] if traced else [])))


def shader_text(name: str) -> str:
    """One file of ``shaders/``."""
    return (shader_dir() / name).read_text(encoding="utf-8")


def compile_glsl(source: str, stage: Literal["vert", "frag", "comp"], name: str) -> bytes:
    """Compile Vulkan GLSL to SPIR-V for Vulkan 1.3.

    Parameters
    ----------
    source : str
        A whole shader, ``#version`` first.
    name : str
        What errors call it.

    Raises
    ------
    MachineError
        ``shaders.no_compiler`` where `glslc` is missing.
    BakeError
        ``shaders.invalid``, with the compiler's first complaint.
    """
    command = ["glslc", f"-fshader-stage={stage}", "--target-env=vulkan1.3", "-O", "-Werror", "-o", "-", "-"]
    try:
        done = subprocess.run(command, input=source.encode(), capture_output=True, check=False)
    except FileNotFoundError:
        raise MachineError("shaders.no_compiler", "glslc is missing; install it (Debian, Ubuntu: apt-get install glslc)", name) from None
    if done.returncode:
        first = next((line for line in done.stderr.decode(errors="replace").splitlines() if "error" in line), "glslc failed")
        raise BakeError("shaders.invalid", first.removeprefix("<stdin>:"), name)
    return done.stdout
