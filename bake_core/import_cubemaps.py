"""``octobake import-cubemaps``: what somebody's own renderer saw from each probe, made into a bundle.

1. Read ``cubemaps.json`` and the faces of each probe that has a folder.
2. Resample radiance, distance and normals onto the octahedral square (:mod:`bake_core.cubemaps`).
3. Filter irradiance and visibility from them, as a bake does.
4. Write the bundle by the code that writes a bake's.
"""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bake_core import bundle, report, strict_json
from bake_core.allocation import FULL, HALVES, SCRAMBLES, SCRAMBLES_PER_HALF
from bake_core.assemble import assemble
from bake_core.cubemaps import FACES, cube_directions, octahedral_radiance, octahedral_surfaces
from bake_core.errors import InputError, MachineError
from bake_core.images import read_exr
from bake_core.octahedral import convolved
from bake_core.placement import Volume
from bake_core.report import Run
from bake_core.selection import Selection, visibility_sides
from bake_core.spec import OUTPUTS, Spec, parse_spec
from bake_core.tally import State
from bake_core.walls import moments_and_walls

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

DESCRIPTION = "cubemaps.json"
# What a bake captures where materials are glossy; a cube map's faces say nothing about what they are for.
_RADIANCE = 64
_ANY = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=True)


class _Description(BaseModel):
    """``cubemaps.json``; volumes and resolution are as in a spec."""

    model_config = _ANY

    format: Literal["octobake-cubemaps"]
    version: Literal[1]
    distances: Literal["ray", "depth"]
    volumes: Annotated[list[dict[str, Any]], Field(min_length=1)]
    resolution: dict[str, Any] = {}


@dataclass(frozen=True)
class _Source:
    """Stands for the scene in the manifest: nobody here has seen one."""

    digest: str
    triangle_count: int
    ignored: tuple[str, ...]


def import_cubemaps(folder: Path, out: Path) -> dict[str, Any]:
    """Make a bundle of a folder of cube maps.

    Returns
    -------
    dict
        The manifest. ``samples`` is 0, for there is nothing to count; no error is known.

    Raises
    ------
    InputError
        ``cubemaps.unreadable``, ``cubemaps.invalid``, ``cubemaps.bad_face``, ``cubemaps.no_probes``; ``spec.*`` of volumes and resolution.
    BundleError
        As :func:`bake_core.bundle.check_replaceable`.
    MachineError
        ``machine.cannot_write``
    """
    bundle.check_replaceable(out)
    description, digest = _read_description(folder)
    spec = _spec(description)
    volumes = tuple(_volume(v.name or f"v{i}", v) for i, v in enumerate(spec.volumes))
    r = spec.resolution
    # Nothing to measure a lower resolution by: the highest, where it is left open.
    radiance, visibility = r.radiance or _RADIANCE, visibility_sides(r)[0]
    state = _empty_state(sum(v.probe_count for v in volumes), spec, radiance, visibility)
    longest = 0.0
    first = 0
    for volume in volumes:
        for probe in range(volume.probe_count):
            faces = folder / volume.name / str(probe)
            if not faces.is_dir():
                # As a probe inside geometry: wholly.
                state.backface[first + probe] = 1
                continue
            light, distances = _read_probe(faces, digest)
            if description.distances == "depth":
                distances = distances * np.linalg.norm(cube_directions(distances.shape[1]), axis=-1)
            longest = max(longest, float(distances[np.isfinite(distances)].max(initial=0.0)))
            _fill(state, first + probe, volume, spec, radiance, light, distances)
        first += volume.probe_count
    if (state.backface == 1).all():
        raise InputError("cubemaps.no_probes", "no probe has a folder; see docs/cubemaps.md for their names", str(folder))
    # As a bake chooses it: a power of two above any distance.
    miss = 2.0 ** math.ceil(math.log2(4 * max(longest, 1e-6)))
    state.distance[~np.isfinite(state.distance)] = miss
    offsets, untried = np.zeros((len(state.backface), 3), np.float32), [None] * len(volumes)
    selection = Selection(
        OUTPUTS,
        (False,) * len(volumes),
        (),
        capture=radiance,
        irradiance=r.irradiance,
        visibility=visibility,
        distance=r.distance,
        normal=r.normal,
        miss_distance=miss,
    )
    source = _Source(f"sha256:{digest.hexdigest()}", 0, ())
    try:
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent, ignore_cleanup_errors=True) as work:
            target = Path(work) / "bundle"
            target.mkdir()
            manifest = assemble(source, spec, volumes, offsets, untried, selection, (), state, "samples", None, target) | {"samples": 0}
            written = bundle.dump_json(manifest)
            (target / bundle.MANIFEST).write_bytes(written)
            report.write(target, manifest, bundle.content_digest(written), Run(1, 1, stopped="samples"))
            bundle.publish(target, out)
    except OSError as e:
        raise MachineError("machine.cannot_write", f"{e.strerror or e}; is there room on the disk?", str(out)) from e
    return manifest


def _read_description(folder: Path) -> tuple[_Description, Any]:
    path = folder / DESCRIPTION
    try:
        text = path.read_bytes()
    except OSError as e:
        raise InputError("cubemaps.unreadable", f"cannot be read: {e.strerror}", str(path)) from None
    document = strict_json.parse(text, InputError, "cubemaps", DESCRIPTION)
    try:
        description = _Description.model_validate_json(json.dumps(document))
    except ValidationError as e:
        first = e.errors(include_url=False)[0]
        place = ".".join(str(p) for p in first["loc"])
        raise InputError("cubemaps.invalid", first["msg"], f"{DESCRIPTION}: {place}" if place else DESCRIPTION) from None
    return description, hashlib.sha256(text)


def _spec(description: _Description) -> Spec:
    document = {"version": 1, "volumes": description.volumes, "resolution": description.resolution, "outputs": list(OUTPUTS)}
    spec = parse_spec(document, DESCRIPTION)
    for i, volume in enumerate(spec.volumes):
        if volume.fit is not None:
            raise InputError("cubemaps.invalid", 'there is no scene to fit to; give "origin", "spacing" and "counts"', f"volumes.{i}.fit")
    return spec


def _volume(name: str, volume: Any) -> Volume:
    return Volume(name, np.asarray(volume.origin, np.float64), np.asarray(volume.spacing, np.float64), volume.counts)


def _empty_state(n: int, spec: Spec, radiance: int, visibility: int) -> State:
    r = spec.resolution
    return State(
        samples=HALVES,
        taken=np.ones((n, HALVES), np.int64),
        eighths=np.full((n, HALVES), FULL, np.int64),
        needed=np.ones(n, np.bool_),
        irradiance=np.zeros((n, SCRAMBLES, r.irradiance**2, 3), np.float32),
        radiance=np.zeros((n, HALVES, radiance**2, 3), np.float32),
        visibility=np.zeros((n, visibility, visibility, 3), np.float32),
        backface=np.zeros(n, np.float32),
        distance=np.zeros((n, r.distance**2), np.float32),
        normal=np.zeros((n, r.normal**2, 3), np.float32),
        rays=0,
    )


def _read_probe(folder: Path, digest: Any) -> tuple[F32, F64]:
    """Radiance (6, c, c, 3) and distances (6, e, e), inf where nothing is hit."""
    light = np.stack([_read_face(folder / f"radiance.{face}.exr", 3, digest) for face in FACES])
    distances = np.stack([_read_face(folder / f"distance.{face}.exr", 1, digest)[..., 0] for face in FACES]).astype(np.float64)
    if not np.isfinite(light).all() or (light < 0).any():
        raise InputError("cubemaps.bad_face", "has radiance that is negative or not finite", f"{folder.parent.name}/{folder.name}")
    if np.isnan(distances).any() or (distances <= 0).any():
        raise InputError("cubemaps.bad_face", "has a distance that is not above 0; inf is a miss", f"{folder.parent.name}/{folder.name}")
    return light, distances


def _read_face(path: Path, channels: int, digest: Any) -> F32:
    where = "/".join(path.parts[-3:])
    pixels, _ = read_exr(path, InputError, "cubemaps.bad_face")
    height, width, count = pixels.shape
    if height != width or count < channels:
        raise InputError("cubemaps.bad_face", f"is {width} × {height} with {count} channels, not square with {channels}", where)
    digest.update(path.read_bytes())
    return np.ascontiguousarray(pixels[..., :channels])


def _fill(state: State, at: int, volume: Volume, spec: Spec, radiance: int, light: F32, distances: F64) -> None:
    """One probe's maps, as a bake's passes leave them: sums of one sample of either half."""
    r = spec.resolution
    texels = octahedral_radiance(light[None], radiance)[0]
    irradiance = convolved(texels, r.irradiance)
    for half in range(HALVES):
        state.radiance[at, half] = texels.reshape(-1, 3)
        state.irradiance[at, half * SCRAMBLES_PER_HALF] = irradiance.reshape(-1, 3)
    distance, normal = octahedral_surfaces(distances[None], r.distance)
    state.distance[at] = distance[0]
    state.normal[at] = normal[0] if r.normal == r.distance else octahedral_surfaces(distances[None], r.normal)[1][0]
    limit, unit = np.array([volume.distance_limit]), np.array([volume.spacing.min()])
    state.visibility[at] = moments_and_walls(distance, limit, unit, state.visibility.shape[1])[0]
