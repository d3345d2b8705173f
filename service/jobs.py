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
    EXPIRED = "expired"


# Every change of state that may ever happen. An active job goes back to the queue at a restart, for the service that drove it is gone; a
# finished one when somebody asks for another try. What has expired has lost its files to a clean-up (service.retention).
TRANSITIONS: dict[State, frozenset[State]] = {
    State.QUEUED: frozenset({State.PREPARING, State.CANCELLED}),
    State.PREPARING: frozenset({State.RUNNING, State.FAILED, State.CANCELLING, State.QUEUED}),
    State.RUNNING: frozenset({State.FINALIZING, State.FAILED, State.CANCELLING, State.QUEUED}),
    State.FINALIZING: frozenset({State.SUCCEEDED, State.FAILED, State.CANCELLING, State.QUEUED}),
    State.CANCELLING: frozenset({State.CANCELLED}),
    State.SUCCEEDED: frozenset({State.EXPIRED}),
    State.FAILED: frozenset({State.EXPIRED, State.QUEUED}),
    State.CANCELLED: frozenset({State.EXPIRED, State.QUEUED}),
    State.EXPIRED: frozenset({State.QUEUED}),
}
FINISHED = frozenset({State.SUCCEEDED, State.FAILED, State.CANCELLED, State.EXPIRED})
ACTIVE = frozenset({State.PREPARING, State.RUNNING, State.FINALIZING})
# From here another try may be asked for.
REPEATABLE = frozenset(s for s in FINISHED if State.QUEUED in TRANSITIONS[s])


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
    fingerprint : str
        Of scene, spec and version: what decides a bundle's bytes.
    memory_bytes : int or None
        Resident memory that the job's worker may come to.
    webhook : str or None
        URL that is told of the job's end.
    pinned : bool
        Whether no clean-up may take its files.
    ttl : float or None
        Seconds that its files are kept after its end; None: as long as the service's setting says.
    stop_asked : bool
        Whether it shall end with the passes that it has.
    plan : dict or None
        What it will bake, known since its scene was prepared.
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
    fingerprint: str
    memory_bytes: int | None
    webhook: str | None
    pinned: bool
    ttl: float | None
    stop_asked: bool
    plan: dict[str, Any] | None


@dataclass(frozen=True)
class Attempt:
    """One time that somebody worked on a job: from its claim, or from the loss of the worker before, until `outcome`.

    `outcome` is a state (succeeded, failed, cancelled), ``lost`` for a worker that went away, ``restarted`` where the service did; None
    while it goes on. `reason` says more where there is more to say.
    """

    number: int
    began: float
    ended: float | None
    outcome: str | None
    reason: str | None


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
