"""The spec: the one description of a bake, in requests, in the queue and in the bundle."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from bake_core import strict_json
from bake_core.errors import SpecError

MAX_PROBES = 1 << 24
# Beyond these a tile alone would be larger than any atlas a GPU takes (16,384 texels).
MAX_RESOLUTION = 1024
MAX_BOUNCES = 1 << 20
SMALLEST_RESOLUTION = 2
MAX_SAMPLES = 1 << 24


def _finite(v: float) -> float:
    if not math.isfinite(v):
        raise ValueError("must be finite")
    if abs(v) > 1e30:
        raise ValueError("must be within ±1e30 (float32 would overflow)")
    return v


def _nonnegative(v: float) -> float:
    if v < 0:
        raise ValueError("must not be negative")
    return v


def _positive(v: float) -> float:
    if v <= 0:
        raise ValueError("must be greater than 0")
    return v


Real = Annotated[float, AfterValidator(_finite)]
Positive = Annotated[Real, AfterValidator(_positive)]
Nonnegative = Annotated[Real, AfterValidator(_nonnegative)]
Whole = int
Vec3 = tuple[Real, Real, Real]
Rgb = tuple[Nonnegative, Nonnegative, Nonnegative]
Counts = tuple[Annotated[Whole, Field(ge=1)], Annotated[Whole, Field(ge=1)], Annotated[Whole, Field(ge=1)]]
Name = Annotated[str, Field(min_length=1, max_length=128, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]
OutputName = Literal["irradiance", "visibility", "radiance", "distance", "normal"]
OUTPUTS: tuple[OutputName, ...] = ("irradiance", "visibility", "radiance", "distance", "normal")


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _direction(v: Vec3) -> Vec3:
    if math.hypot(*v) < 1e-20:
        raise ValueError("must not be the zero vector")
    return v


class Volume(_Model):
    """A grid of probes: given outright (`origin`, `spacing`, `counts`), or fitted to the scene or to a node's cube."""

    name: Name | None = None
    fit: Literal["scene", "node"] | None = None
    node: str | None = None
    origin: Vec3 | None = None
    spacing: tuple[Positive, Positive, Positive] | None = None
    counts: Counts | None = None

    @model_validator(mode="after")
    def _complete(self) -> Volume:
        given = {k for k in ("origin", "spacing", "counts", "node") if getattr(self, k) is not None}
        if self.fit is None and given != {"origin", "spacing", "counts"}:
            raise ValueError('give origin, spacing and counts, or "fit": "scene" or "node"')
        if self.fit == "scene" and given not in ({"spacing"}, {"counts"}):
            raise ValueError('"fit": "scene" takes either spacing or counts, and nothing else')
        if self.fit == "node" and given != {"node", "counts"}:
            raise ValueError('"fit": "node" takes node and counts, and nothing else')
        if self.counts is not None and math.prod(self.counts) > MAX_PROBES:
            raise ValueError(f"{math.prod(self.counts)} probes are more than {MAX_PROBES} (2^24)")
        return self


class ConstantEnvironment(_Model):
    """The same radiance from every direction."""

    kind: Literal["constant"] = "constant"
    radiance: Rgb = (0.0, 0.0, 0.0)


class EquirectEnvironment(_Model):
    """A latitude-longitude image, EXR or Radiance HDR: the top row is +Y, the middle column faces -Z, the right half +X.

    `rotation_y` turns it about +Y, in radians, counter-clockwise as seen from above. Texels are not interpolated.
    """

    kind: Literal["equirect"]
    image: Annotated[str, Field(min_length=1)]
    rotation_y: Real = 0.0
    scale: Nonnegative = 1.0


class DirectionalLight(_Model):
    """`direction` is the way the light travels; `irradiance` is on a plane perpendicular to it."""

    kind: Literal["directional"]
    direction: Annotated[Vec3, AfterValidator(_direction)]
    irradiance: Rgb


class PointLight(_Model):
    kind: Literal["point"]
    position: Vec3
    intensity: Rgb


class SpotLight(_Model):
    """Angles in radians from the axis: full intensity within `inner_angle`, none beyond `outer_angle`."""

    kind: Literal["spot"]
    position: Vec3
    direction: Annotated[Vec3, AfterValidator(_direction)]
    intensity: Rgb
    inner_angle: Nonnegative = 0.0
    outer_angle: Positive = math.pi / 4

    @model_validator(mode="after")
    def _ordered(self) -> SpotLight:
        if not self.inner_angle < self.outer_angle <= math.pi / 2:
            raise ValueError("needs inner_angle < outer_angle <= π/2")
        return self


Environment = Annotated[ConstantEnvironment | EquirectEnvironment, Field(discriminator="kind")]
Light = Annotated[DirectionalLight | PointLight | SpotLight, Field(discriminator="kind")]
Resolution_ = Annotated[Whole, Field(ge=SMALLEST_RESOLUTION, le=MAX_RESOLUTION, multiple_of=2)]


class Resolution(_Model):
    """Interior texels along a tile's side, per output. Even, so that the octahedron's folds lie on texel corners."""

    irradiance: Resolution_ = 8
    visibility: Resolution_ | None = 16
    radiance: Resolution_ | None = None
    distance: Resolution_ = 64
    normal: Resolution_ = 64


class Stop(_Model):
    """When to stop, whichever comes first. `target_error` null: exactly `max_samples`."""

    target_error: Positive | None = 0.02
    max_seconds: Positive | None = None
    max_samples: Annotated[Whole, Field(ge=1, le=MAX_SAMPLES)] = 256


class Spec(_Model):
    """One bake. Everything but `volumes` has a default; unknown keys are errors."""

    version: Literal[1] = 1
    volumes: Annotated[tuple[Volume, ...], Field(min_length=1, max_length=64)]
    environment: Environment = ConstantEnvironment()
    lights: Annotated[tuple[Light, ...], Field(max_length=65536)] = ()
    outputs: Literal["auto"] | Annotated[tuple[OutputName, ...], Field(min_length=1)] = "auto"
    receivers: Literal["everywhere", "surfaces"] = "everywhere"
    probes: Literal["auto", "lattice", "relocated"] = "auto"
    resolution: Resolution = Resolution()
    integrator: Literal["auto", "path", "cache"] = "auto"
    max_bounces: Annotated[Whole, Field(ge=0, le=MAX_BOUNCES)] | None = None
    stop: Stop = Stop()
    seed: Annotated[Whole, Field(ge=0, lt=1 << 64)] = 0

    def relocates(self, probes: int) -> bool:
        """Whether a volume of so many probes may have them leave their lattice.

        By itself where surfaces are to be lit from several; not where single maps are asked for, nor one probe at a place of
        somebody's choice.
        """
        lights_surfaces = self.outputs == "auto" or {"irradiance", "visibility"} <= set(self.outputs)
        return self.probes == "relocated" or (self.probes == "auto" and lights_surfaces and probes > 1)

    @model_validator(mode="after")
    def _named(self) -> Spec:
        names = [v.name or f"v{i}" for i, v in enumerate(self.volumes)]
        twice = {n for n in names if names.count(n) > 1}
        if twice:
            raise ValueError(f"two volumes are named {sorted(twice)[0]!r}")
        if self.outputs != "auto" and len(set(self.outputs)) != len(self.outputs):
            raise ValueError("an output stands twice in outputs")
        return self

    def canonical(self) -> dict[str, Any]:
        """The spec with every default filled in: what the manifest records and what identity is judged by."""
        spec: dict[str, Any] = self.model_dump(mode="json")
        spec["volumes"] = [{"name": v.name or f"v{i}", **v.model_dump(mode="json", exclude_none=True)} for i, v in enumerate(self.volumes)]
        return spec


def parse_spec(document: Any, where: str = "spec") -> Spec:
    """Validate a parsed JSON document.

    Raises
    ------
    SpecError
        ``spec.unknown_key``, ``spec.missing_key``, ``spec.too_many_probes``, ``spec.not_finite`` or ``spec.invalid``; `where` is the
        path of the field, as in
        ``volumes[0].spacing[1]``.
    """
    try:
        # Strict JSON mode: a list is a tuple and 1 is 1.0, but "1" is no number and true is no integer.
        return Spec.model_validate_json(json.dumps(document), strict=True)
    except ValidationError as e:
        raise _spec_error(e, where) from None
    except RecursionError:
        raise SpecError("spec.json_too_deep", "nested too deep", where) from None


def load_spec(path: str | Path) -> Spec:
    """Read a spec file; errors as :func:`parse_spec`, and ``spec.unreadable`` or ``spec.bad_json``."""
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as e:
        raise SpecError("spec.unreadable", f"cannot be read: {e.strerror}", str(path)) from None
    return parse_spec(strict_json.parse(text, SpecError, "spec", path.name), path.name)


def _spec_error(error: ValidationError, where: str) -> SpecError:
    """Pydantic's first complaint as one line with a place; how many more there are is said."""
    details = error.errors(include_url=False)
    # Of a union's complaints the deepest is about what was meant; an unknown key explains the errors that follow from it, so it goes first.
    first = min(details, key=lambda d: (d["type"] != "extra_forbidden", "literal['auto']" in d["loc"] or d["loc"][-1:] == ("outputs",)))
    place = where
    path = ""
    for i, part in enumerate(first["loc"]):
        if isinstance(part, int):
            path += f"[{part}]"
        elif i != _UNION_TAG.get(str(first["loc"][0])):
            path += ("." if path else "") + str(part)
    place = f"{where}: {path}" if path else where
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    kind, text = first["type"], first["msg"].removeprefix("Value error, ")
    if kind == "extra_forbidden":
        return SpecError("spec.unknown_key", f"is not a key of a spec{more}", place)
    if kind == "missing":
        return SpecError("spec.missing_key", f"is required{more}", place)
    if "probes are more than" in text:
        return SpecError("spec.too_many_probes", text + more, place)
    if kind == "finite_number" or "must be finite" in text:
        return SpecError("spec.not_finite", f"must be a finite number{more}", place)
    return SpecError("spec.invalid", f"{text}; got {json.dumps(first['input'], default=str)[:80]}{more}", place)


# Where in a place pydantic says which member of a union it tried.
_UNION_TAG = {"environment": 1, "lights": 2, "outputs": 1}
