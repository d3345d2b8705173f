"""Cameras that people give: a JSON list, from a file or in a request."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from bake_core import strict_json
from bake_core.errors import InputError
from bake_core.scene import Camera

F64 = NDArray[np.float64]
DEFAULT_YFOV = math.radians(60)

Coordinate = Annotated[float, Field(ge=-1e30, le=1e30)]  # beyond, float32 overflows
Vec3 = tuple[Coordinate, Coordinate, Coordinate]


class GivenCamera(BaseModel):
    """One camera: where it stands, what it looks at, which way is up, and its vertical field of view in radians."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=True)

    name: str = Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")
    position: Vec3
    target: Vec3
    up: Vec3 = (0.0, 1.0, 0.0)
    yfov: float = Field(default=DEFAULT_YFOV, gt=0, lt=math.pi)


_LIST = TypeAdapter(Annotated[list[GivenCamera], Field(min_length=1, max_length=64)])


def load_cameras(path: str | Path) -> tuple[Camera, ...]:
    """Read a file of cameras; errors as :func:`parse_cameras`, and ``camera.unreadable`` or ``camera.bad_json``."""
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as e:
        raise InputError("camera.unreadable", f"cannot be read: {e.strerror}", str(path)) from None
    return parse_cameras(strict_json.parse(text, InputError, "camera", path.name), path.name)


def parse_cameras(document: Any, where: str = "cameras") -> tuple[Camera, ...]:
    """Cameras of a parsed JSON list: ``[{"name", "position", "target", "up"?, "yfov"?}]``.

    Raises
    ------
    InputError
        ``camera.invalid``; `where` is the field's path.
    """
    try:
        given = _LIST.validate_json(json.dumps(document))
    except ValidationError as e:
        first = e.errors(include_url=False)[0]
        place = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in first["loc"])
        raise InputError("camera.invalid", first["msg"], f"{where}{place}") from None
    names = [g.name for g in given]
    for i, g in enumerate(given):
        if g.name in names[:i]:
            raise InputError("camera.invalid", f"two cameras are called {g.name!r}", f"{where}[{i}].name")
        if g.position == g.target:
            raise InputError("camera.invalid", "is where the camera stands; look somewhere else", f"{where}[{i}].target")
    return tuple(Camera(g.name, looking(g.position, g.target, g.up), g.yfov) for g in given)


def looking(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 1.0, 0.0)) -> F64:
    """Camera to world, (4, 4): at `position`, its -Z towards `target`, its +Y as near to `up` as can be."""
    eye = np.asarray(position, np.float64)
    back = eye - np.asarray(target, np.float64)
    back = back / np.linalg.norm(back)
    right = np.cross(np.asarray(up, np.float64), back)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(np.asarray(up, np.float64)):
        # Straight along `up`: any axis that is not will do.
        right = np.cross(np.eye(3)[np.abs(back).argmin()], back)
    right = right / np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return matrix
