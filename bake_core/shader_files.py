"""Where the GLSL sources are: in the checkout, or packed into the installed distribution."""

from __future__ import annotations

from pathlib import Path

from bake_core.errors import MachineError

_HERE = Path(__file__).resolve().parent


def shader_dir() -> Path:
    """The folder that holds ``irradiance.glsl`` and what it includes.

    Raises
    ------
    MachineError
        ``machine.no_shaders`` where the installation is incomplete.
    """
    packed, checkout = _HERE / "_shaders", _HERE.parent / "shaders"
    for folder in (packed, checkout):
        if folder.is_dir():
            return folder
    raise MachineError("machine.no_shaders", "the GLSL sources are not installed; install octobake again", str(packed))
