"""What the service tells, as frozen dataclasses; `document` is always the JSON itself, for whatever is not spelled out here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from octobake_client.errors import JobFailed

FINISHED = frozenset({"succeeded", "failed", "cancelled", "expired"})


@dataclass(frozen=True)
class _FromJson:
    document: Mapping[str, Any]

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """From the service's JSON; keys that this version does not know are left to `document`."""
        known = {f.name for f in fields(cls)} - {"document"}
        return cls(document=document, **{k: v for k, v in document.items() if k in known})


@dataclass(frozen=True)
class Scene(_FromJson):
    """A scene that the service's reader accepted."""

    digest: str
    triangles: int
    ignored: list[str]


@dataclass(frozen=True)
class Progress(_FromJson):
    """How far a job has come; `fraction` in [0, 1], `seconds` since its start, `eta` seconds to go or None."""

    stage: str
    fraction: float
    samples: int
    error: float | None
    seconds: float
    eta: float | None


@dataclass(frozen=True)
class Point(_FromJson):
    """A point on a bake's curve: what there was at the end of a pass, `seconds` since its beginning; `error` may be unknown."""

    samples: int
    rays: int
    seconds: float
    error: float | None


@dataclass(frozen=True)
class Event(_FromJson):
    """One server-sent event: `type` is ``state``, ``pass``, ``retry`` or ``progress``; `document` its data. Progress has no id."""

    type: str
    id: int | None


@dataclass(frozen=True)
class Job(_FromJson):
    """What bakes and verifications share."""

    id: str
    state: str
    labels: dict[str, str]
    priority: int
    attempts: int
    created: str
    started: str | None
    finished: str | None
    links: dict[str, str]
    error: dict[str, Any] | None
    result: dict[str, Any] | None

    @property
    def done(self) -> bool:
        """Whether it has finished, one way or another."""
        return self.state in FINISHED

    @property
    def progress(self) -> Progress | None:
        """How far it had come when this was told."""
        told = self.document["progress"]
        return None if told is None else Progress.of(told)

    def check(self) -> Self:
        """Raise unless it has succeeded.

        Raises
        ------
        JobFailed
        """
        if self.state == "failed" and self.error:
            raise JobFailed(self.error["slug"], self.error["message"], self.error["where"], self.error["exit_code"])
        if self.state == "cancelled":
            raise JobFailed("bake.cancelled", "was cancelled", f"job {self.id}", 3)
        if self.state != "succeeded":
            raise JobFailed("job.not_finished", f"is {self.state}", f"job {self.id}", 3)
        return self


@dataclass(frozen=True)
class Bake(Job):
    """A bake."""

    scene: str
    spec: dict[str, Any]

    @property
    def curve(self) -> list[Point]:
        """Error against seconds, a point for each pass."""
        return [Point.of(p) for p in self.document["curve"]]


@dataclass(frozen=True)
class Verification(Job):
    """A verification of the bake whose id is `bake`."""

    bake: str
