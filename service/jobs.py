"""What a job is: its states, the one table of legal transitions, and the record that the store returns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from bake_core.convergence import Point
from bake_core.errors import OctobakeError


class Kind(StrEnum):
    """What a job does. Both kinds wait in one queue for the same workers."""

    BAKE = "bake"
    VERIFICATION = "verification"


class State(StrEnum):
    """Where a job stands."""

    QUEUED = "queued"
    PREPARING = "preparing"
    RUNNING = "running"
    FINALIZING = "finalizing"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLING = "cancelling"
    CANCELLED = "cancelled"


# Every change of state that may ever happen. The way back to the queue is a restart's: the service that drove the job is gone.
TRANSITIONS: dict[State, frozenset[State]] = {
    State.QUEUED: frozenset({State.PREPARING, State.CANCELLED}),
    State.PREPARING: frozenset({State.RUNNING, State.FAILED, State.CANCELLING, State.QUEUED}),
    State.RUNNING: frozenset({State.FINALIZING, State.FAILED, State.CANCELLING, State.QUEUED}),
    State.FINALIZING: frozenset({State.SUCCEEDED, State.FAILED, State.CANCELLING, State.QUEUED}),
    State.CANCELLING: frozenset({State.CANCELLED}),
    State.SUCCEEDED: frozenset(),
    State.FAILED: frozenset(),
    State.CANCELLED: frozenset(),
}
FINISHED = frozenset(s for s, following in TRANSITIONS.items() if not following)
ACTIVE = frozenset({State.PREPARING, State.RUNNING, State.FINALIZING})


class IllegalTransition(OctobakeError):
    """A change of state that TRANSITIONS does not have: somebody else moved the job first."""

    http_status = 409

    def __init__(self, job: str, before: State, after: State) -> None:
        super().__init__("job.illegal_transition", f"a job that is {before} cannot become {after}", f"job {job}")
        self.before = before


@dataclass(frozen=True)
class Job:
    """A job's row.

    Attributes
    ----------
    sequence : int
        Order of arrival; what list cursors count in.
    request : dict
        What was asked for, complete: a bake's scene and canonical spec, a verification's bake and cameras.
    attempts : int
        Times that a worker was lost under this job.
    progress : dict or None
        The last committed :class:`bake_core.progress.Progress`, as a dict.
    result, error : dict or None
        What came of it; `error` has slug, where, message and exit_code.
    created, started, finished : float
        Seconds since 1970; None before they happen.
    """

    sequence: int
    id: str
    kind: Kind
    state: State
    request: dict[str, Any]
    labels: dict[str, str]
    priority: int
    attempts: int
    progress: dict[str, Any] | None
    result: dict[str, Any] | None
    error: dict[str, Any] | None
    created: float
    started: float | None
    finished: float | None


@dataclass(frozen=True)
class Event:
    """One row of a job's history; `id` grows over all jobs and is what SSE calls the event's id."""

    id: int
    job: str
    at: float
    type: str
    data: dict[str, Any]


@dataclass(frozen=True)
class Pass:
    """One doubling of a bake's samples: [first, last) of every probe, in `shards` pieces.

    `state` names the merged sums in the job's work folder once every shard is in, `allocation` what they say of the next pass; until then
    they and the figures are None.
    """

    index: int
    first: int
    last: int
    shards: int
    state: str | None = None
    allocation: str | None = None
    error: float | None = None
    seconds: float | None = None
    rays: int | None = None

    @property
    def point(self) -> Point:
        """What a merged pass adds to the curve."""
        assert self.rays is not None and self.seconds is not None
        return Point(self.last, self.rays, self.seconds, self.error)


@dataclass(frozen=True)
class Shard:
    """A committed piece of a pass: `tally` names its sums in the job's work folder."""

    index: int
    tally: str
    seconds: float
