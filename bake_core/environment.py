"""The environment as the kernels see it: one radiance from everywhere, and an equirectangular image.

An image is taken as it is stored: each texel is one radiance over its patch of the sphere, with no interpolation, so that the density by
which directions are drawn (radiance, summed over channels, times solid angle) is the radiance's own shape, and its sums are exact.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.errors import SpecError
from bake_core.images import read_radiance
from bake_core.kernels import either, entry_kernel, kernel
from bake_core.lights import choose
from bake_core.spec import ConstantEnvironment, EquirectEnvironment

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
# Where an image that a spec names lies on this machine; raises SpecError.
Find = Callable[[str], Path]


class Sky(NamedTuple):
    """An image around the scene.

    Attributes
    ----------
    texels : (h, w, 3) float32
        Radiance; row 0 is up, the middle column is towards -Z before `turn`, the right half is +X.
    rows : (h,) float64
        Running sum of the chance to draw each row.
    columns : (h, w) float32
        The same for columns within each row. A density is that of these numbers, rounded as they are.
    cosines : (h + 1,) float64
        Of the angle to +Y at the rows' edges.
    turn : float64
        Radians about +Y, counter-clockwise seen from above.
    """

    texels: F32
    rows: F64
    columns: F32
    cosines: F64
    turn: float


class Environment(NamedTuple):
    """What surrounds the scene: the same radiance, (3,) float64, from everywhere; or, then black, an image."""

    constant: F64
    sky: Sky | None


def beside(folder: Path) -> Find:
    """Images by their path from a folder: the spec file's."""

    def find(image: str) -> Path:
        if image.startswith("sha256:"):
            raise SpecError(
                "spec.image_not_found", "only a service knows images by digest; give a path from the spec file", "environment.image"
            )
        # A name too long for any file is an OSError, or False, as Python's version has it.
        with suppress(OSError):
            if (folder / image).is_file():
                return folder / image
        raise SpecError("spec.image_not_found", f"there is no file {image[:200]!r} beside the spec", "environment.image")

    return find


def exactly(path: Path) -> Find:
    """One image, whatever its name, for a spec that names it by digest: a bundle's."""

    def find(image: str) -> Path:
        try:
            digest = f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
        except OSError as e:
            raise SpecError("spec.image_not_found", f"cannot be read: {e.strerror}", str(path)) from None
        if digest != image:
            raise SpecError("spec.other_image", f"is {digest}, the spec's is {image}; give that image", str(path))
        return path

    return find


def no_images(image: str) -> Path:
    """Where there is no place to look for images."""
    what = f"{image!r} cannot be looked up here; say where the image is (octobake verify: --sky FILE)"
    raise SpecError("spec.image_not_found", what, "environment.image")


def read_environment(
    environment: ConstantEnvironment | EquirectEnvironment, find: Find
) -> tuple[Environment, ConstantEnvironment | EquirectEnvironment]:
    """Read what a spec says of the environment.

    Returns
    -------
    Environment
    ConstantEnvironment or EquirectEnvironment
        The same with its image named by digest: what identifies a bake, wherever the image lay.

    Raises
    ------
    SpecError
        ``spec.image_*``: not there, not read, or a texel that is no radiance.
    """
    if isinstance(environment, ConstantEnvironment):
        return Environment(np.asarray(environment.radiance, np.float64), None), environment
    path = find(environment.image)
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as e:
        raise SpecError("spec.image_not_found", f"{environment.image!r} cannot be read: {e.strerror}", "environment.image") from None
    texels = read_radiance(path, SpecError, "spec.image_unreadable", f"environment.image {environment.image!r}")
    _check(texels, environment.image)
    with np.errstate(over="ignore"):
        texels = texels * np.float32(environment.scale)
    if not np.isfinite(texels).all():
        raise SpecError("spec.image_not_finite", f"its brightest texel times {environment.scale:g} is beyond float32", "environment.scale")
    named = environment.model_copy(update={"image": f"sha256:{digest}"})
    return Environment(np.zeros(3), make_sky(texels, environment.rotation_y)), named


def _check(texels: F32, image: str) -> None:
    for wrong, slug, what in ((~np.isfinite(texels), "not_finite", "is not finite"), (texels < 0, "negative", "is negative")):
        if wrong.any():
            row, column, channel = np.argwhere(wrong)[0].tolist()
            place = f"environment.image {image!r}: row {row}, column {column}, {'RGB'[channel]}"
            raise SpecError(f"spec.image_{slug}", f"{what}: {texels[row, column, channel]}; a radiance is finite and not negative", place)


def make_sky(texels: F32, turn: float) -> Sky | None:
    """A sky of (h, w, 3) float32, finite and not negative; None where it is black."""
    height = len(texels)
    cosines = np.cos(np.arange(height + 1) * (math.pi / height))
    strength = texels.sum(2, dtype=np.float64)
    by_row = strength.sum(1) * (cosines[:-1] - cosines[1:])
    if not by_row.sum() > 0:
        return None
    columns = np.cumsum(strength, 1)
    columns /= np.maximum(columns[:, -1:], 1e-300)
    # A row's last texels may be black: what the sum reaches, and no more, must be drawn.
    columns[columns >= columns[:, -1:]] = 1
    rows = np.cumsum(by_row) / by_row.sum()
    rows[rows >= rows[-1]] = 1
    return Sky(np.ascontiguousarray(texels), rows, columns.astype(np.float32), cosines, float(turn))


@kernel
def sky_radiance(sky, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Radiance that arrives from a direction, 3 float64, and the pdf of :func:`sample_sky`."""
    height, width = sky.texels.shape[0], sky.texels.shape[1]
    across = 0.5 + (math.atan2(dx, -dz) + sky.turn) / (2 * math.pi)
    column = min(int((across - math.floor(across)) * width), width - 1)
    row = min(int(math.acos(min(max(dy, -1.0), 1.0)) / math.pi * height), height - 1)
    texel = sky.texels[row, column]
    return (np.float64(texel[0]), np.float64(texel[1]), np.float64(texel[2])), _pdf(sky, row, column)


@kernel
def _pdf(sky, row, column):  # type: ignore[no-untyped-def]
    row_chance = sky.rows[row] - (sky.rows[row - 1] if row else 0.0)
    chance = row_chance * (np.float64(sky.columns[row, column]) - (np.float64(sky.columns[row, column - 1]) if column else 0.0))
    return chance * sky.texels.shape[1] / (2 * math.pi * (sky.cosines[row] - sky.cosines[row + 1]))


@kernel
def sample_sky(sky, u, v):  # type: ignore[no-untyped-def]
    """A direction by radiance times solid angle, even within a texel.

    Returns
    -------
    3 float64, 3 float64, float64
        Radiance, direction, pdf.
    """
    row, row_chance = choose(sky.rows, v)
    columns = sky.columns[row]
    column, _ = choose(columns, u)
    # What is left of each number after the choice is a number again.
    b = (v - (sky.rows[row - 1] if row else 0.0)) / row_chance
    before = np.float64(columns[column - 1]) if column else 0.0
    a = (u - before) / (np.float64(columns[column]) - before)
    y = sky.cosines[row] + b * (sky.cosines[row + 1] - sky.cosines[row])
    phi = ((column + a) / sky.texels.shape[1] - 0.5) * (2 * math.pi) - sky.turn
    r = math.sqrt(max(0.0, 1 - y * y))
    texel = sky.texels[row, column]
    return (
        (np.float64(texel[0]), np.float64(texel[1]), np.float64(texel[2])),
        (r * math.sin(phi), y, -r * math.cos(phi)),
        _pdf(sky, row, column),
    )


@entry_kernel
def _look_up(sky, directions, out):  # type: ignore[no-untyped-def]
    for i in range(directions.shape[0]):
        (out[i, 0], out[i, 1], out[i, 2]), _ = sky_radiance(sky, directions[i, 0], directions[i, 1], directions[i, 2])


def look_up_sky(sky: Sky, directions: F64) -> F64:
    """Radiance that arrives from unit directions, (n, 3) float64."""
    out = np.empty((len(directions), 3))
    _look_up(sky, np.ascontiguousarray(directions), out)
    return out


# The kernels below take :class:`bake_core.tracer.Tables`.

# Whether there is an image (t).
has_sky = either("sky")(lambda t: True)(lambda t: False)


@kernel
def _constant(t, dx, dy, dz):  # type: ignore[no-untyped-def]
    return (t.environment[0], t.environment[1], t.environment[2]), 0.0


# Radiance that arrives from a direction (t, dx, dy, dz), 3 float64, and the density with which it is drawn as a light: 0 where there is no
# image, for cosine sampling is a constant environment's importance sampling already.
environment_radiance = either("sky")(lambda t, dx, dy, dz: sky_radiance(t.sky, dx, dy, dz))(_constant)
