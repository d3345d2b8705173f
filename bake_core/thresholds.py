"""What a verification must reach: limits for pictures and for receivers, as a JSON file gives them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from bake_core import strict_json
from bake_core.comparison import Figures
from bake_core.errors import InputError
from bake_core.receiver_comparison import ReceiverFigures

Limit = Annotated[float, Field(ge=0)]


class _Limits(BaseModel):
    """What pictures and receivers have in common."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=True)
    _black: ClassVar[str]

    mean_ratio: tuple[Limit, Limit] | None = None
    relmse: Limit | None = None

    @model_validator(mode="after")
    def _ordered(self) -> _Limits:
        if self.mean_ratio is not None and self.mean_ratio[0] > self.mean_ratio[1]:
            raise ValueError("mean_ratio must be [least, most]")
        return self

    def _failures(self, figures: Figures | ReceiverFigures) -> list[str]:
        out = []
        if self.mean_ratio is not None:
            low, high = self.mean_ratio
            if figures.mean_ratio is None:
                out.append(self._black)
            elif not low <= figures.mean_ratio <= high:
                out.append(f"mean ratio {figures.mean_ratio:.4f} is outside {low:g} to {high:g}")
        if self.relmse is not None and not (figures.relmse is not None and figures.relmse <= self.relmse):
            out.append(f"relMSE {_text(figures.relmse)} is above {self.relmse:g}")
        return out


class Limits(_Limits):
    """Limits for one part of the picture; null: none."""

    _black = "the path-traced picture is black and the rasterised one is not"

    flip: Limit | None = None

    def failures(self, figures: Figures) -> list[str]:
        """In words, each limit that the figures do not keep."""
        out = self._failures(figures)
        if self.flip is not None and figures.flip > self.flip:
            out.append(f"HDR-FLIP {figures.flip:.4f} is above {self.flip:g}")
        return out


class ReceiverLimits(_Limits):
    """Limits for irradiance at surface points; null: none."""

    _black = "the path-traced irradiance is black and the bundle's is not"

    p95: Limit | None = None

    def failures(self, figures: ReceiverFigures) -> list[str]:
        """In words, each limit that the figures do not keep."""
        out = self._failures(figures)
        if self.p95 is not None and not (figures.p95 is not None and figures.p95 <= self.p95):
            out.append(f"95th percentile of the relative error {_text(figures.p95)} is above {self.p95:g}")
        return out


def _text(figure: float | None) -> str:
    return "infinite" if figure is None else f"{figure:.4g}"


class Thresholds(BaseModel):
    """Limits of a scene. The defaults are the Cornell box's, seen from inside; a scene that cannot keep them states its own."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    indirect: Limits = Limits(mean_ratio=(0.95, 1.05), relmse=0.05)
    whole: Limits = Limits()
    receivers: ReceiverLimits = ReceiverLimits()

    def failures(self, figures: Mapping[str, Figures]) -> list[str]:
        """In words, each limit that is not kept by the parts ``indirect`` and ``whole``."""
        parts = {"indirect": self.indirect, "whole": self.whole}
        return [f"{part}: {failure}" for part, limits in parts.items() for failure in limits.failures(figures[part])]


def load_thresholds(path: str | Path) -> Thresholds:
    """Read a file of thresholds: ``{"indirect": {"mean_ratio": [0.95, 1.05], "relmse": 0.05, "flip": null}, "whole": {...}}``.

    A part that is left out keeps its defaults; a limit that is left out of a part is none.

    Raises
    ------
    InputError
        ``thresholds.unreadable``, ``thresholds.bad_json``, ``thresholds.invalid``.
    """
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as e:
        raise InputError("thresholds.unreadable", f"cannot be read: {e.strerror}", str(path)) from None
    return parse_thresholds(strict_json.parse(text, InputError, "thresholds", path.name), path.name)


def parse_thresholds(document: Any, where: str = "thresholds") -> Thresholds:
    """Thresholds of a parsed JSON object; raises as :func:`load_thresholds`."""
    try:
        return Thresholds.model_validate_json(json.dumps(document))
    except ValidationError as e:
        first = e.errors(include_url=False)[0]
        place = ".".join(str(p) for p in first["loc"])
        raise InputError(
            "thresholds.invalid", first["msg"].removeprefix("Value error, "), f"{where}: {place}" if place else where
        ) from None
