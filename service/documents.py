"""The JSON that goes over HTTP, both ways: what the OpenAPI document and every client's types are made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

from bake_core.spec import MAX_SAMPLES
from bake_core.verification import HEIGHT, LARGEST_SIDE, MOST_SAMPLES, SAMPLES, WIDTH
from service.jobs import Attempt as JobAttempt
from service.jobs import Job, State

Digest = Annotated[
    str,
    Field(pattern=r"^sha256:[0-9a-f]{64}$", examples=["sha256:2c26b46b68ffc68ff99b453c1d30413413422d706483bfa0f98a5e886266e7ae"]),
]
LABEL_KEY = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$"
# Control characters, NUL above all, are text that not every database and no terminal takes.
PLAIN = r"^[^\x00-\x1f\x7f]*$"
FileName = Annotated[str, Field(pattern=PLAIN, min_length=1, max_length=1024)]
Labels = Annotated[
    dict[Annotated[str, Field(pattern=LABEL_KEY)], Annotated[str, Field(max_length=256, pattern=PLAIN)]],
    Field(max_length=32, description="For your own use; lists can be filtered by them.", examples=[{"level": "rooms"}]),
]
Priority = Annotated[int, Field(ge=-1000, le=1000, description="Higher goes first; equals go in order of arrival.")]
# These have parsers of their own in the core, whose errors name their fields; the framework only needs to know that they are objects.
# In the OpenAPI document their own schemas take the place of the mark: see service.app.
MARK = "x-octobake-model"
SpecDocument = Annotated[dict[str, Any], WithJsonSchema({"type": "object", MARK: "Spec"})]
CameraDocument = Annotated[dict[str, Any], WithJsonSchema({"type": "object", MARK: "GivenCamera"})]
ThresholdsDocument = Annotated[dict[str, Any], WithJsonSchema({"type": "object", MARK: "Thresholds"})]
Time = Annotated[datetime, Field(description="UTC.")]


# Of a picture, in pixels: what `octobake verify` takes, too.
SMALLEST_SIDE = 16


Webhook = Annotated[
    str,
    Field(
        max_length=2048,
        description="URL that is POSTed to when the job has finished, signed as the Standard Webhooks specification says.",
        examples=["https://ci.example.com/octobake"],
    ),
]
Keep = Annotated[
    float, Field(gt=0, le=1e9, description="Keep the files so long after the end; default the service's retention_days.", examples=[604800])
]


class _Request(BaseModel):
    # Strict: "1" is no number. A key that nobody reads is a mistake of the sender's.
    model_config = ConfigDict(extra="forbid", strict=True)


class Problem(BaseModel):
    """RFC 9457. Branch on `slug`; show `detail`."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "type": "urn:octobake:problem:spec.unknown_key",
                    "title": "Unprocessable Entity",
                    "status": 422,
                    "detail": "is not a key of a spec",
                    "slug": "spec.unknown_key",
                    "where": "spec: volumes[0].spacin",
                }
            ]
        }
    )

    type: str
    title: str
    status: int
    detail: str
    slug: str = Field(description="Stable name of the error, `area.reason`.")
    where: str = Field(description="The file, node, field or probe at fault; may be empty.")


class SceneRequest(_Request):
    """A scene of several files, each uploaded as a blob before."""

    root: FileName = Field(description="Name of the .gltf or .glb among `files`.", examples=["room.gltf"])
    files: dict[FileName, Digest] = Field(description="Name, as URIs in the scene say it, to digest.", min_length=1, max_length=10_000)


class Scene(BaseModel):
    """A scene that the reader accepted, and what is in it."""

    digest: Digest
    triangles: int = Field(description="As rays see them: every instance's counted.")
    instances: int
    materials: list[str]
    lights: int
    cameras: list[str]
    nodes: int
    bounds: list[list[float]] = Field(description="World-space box of all triangles, [min, max].")
    ignored: list[str] = Field(description="What was read over, one line each.")


class MemoryLimit(_Request):
    """What a job may take at most."""

    memory_bytes: int | None = Field(
        None, ge=1, le=2**62, description="Resident memory of the process that bakes; beyond it, the job fails with job.over_memory."
    )


class Limits(MemoryLimit):
    """What a bake may take at most. Time and samples narrow the spec's `stop`, as the bake's own spec then says."""

    seconds: float | None = Field(None, gt=0, le=1e9)
    samples: int | None = Field(None, ge=1, le=MAX_SAMPLES)


class BakeRequest(_Request):
    """A bake to be queued."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "scene": "sha256:2c26b46b68ffc68ff99b453c1d30413413422d706483bfa0f98a5e886266e7ae",
                    "spec": {"version": 1, "volumes": [{"fit": "scene", "counts": [4, 3, 4]}], "stop": {"target_error": 0.02}},
                    "labels": {"level": "rooms"},
                    "priority": 0,
                }
            ]
        }
    )

    scene: Digest
    spec: SpecDocument
    labels: Labels = {}
    priority: Priority = 0
    limits: Limits = Limits()
    webhook: Webhook | None = None
    keep_seconds: Keep | None = None
    pinned: bool = Field(False, description="No clean-up takes its files.")


class Volume(BaseModel):
    """A grid of probes, as it was placed in the scene."""

    name: str
    origin: tuple[float, float, float]
    spacing: tuple[float, float, float]
    counts: tuple[int, int, int]


class Validation(BaseModel):
    """What a bake that was only validated would be."""

    valid: Literal[True]
    scene: Digest
    spec: SpecDocument = Field(description="With every default filled in, and narrowed by the limits.")
    volumes: list[Volume]
    probes: int


class LeftOut(BaseModel):
    """One thing that a bake does without, as the bundle's manifest has it."""

    what: str
    why: str
    bytes: int | None = Field(None, description="What that saves before compression; null where it saves time alone.")


class Plan(BaseModel):
    """What a bake will do, known once its scene was prepared."""

    volumes: list[Volume]
    probes: int
    outputs: list[str]
    left_out: list[LeftOut]
    unneeded_probes: int = Field(description="That no query on a surface asks; left out where the spec's receivers are surfaces.")
    unneeded_bytes: int = Field(description="Of their texels, before compression.")
    memory_bytes: int = Field(description="Resident memory at the end, predicted.")
    atlas_bytes: int = Field(description="Texels before compression.")


class Progress(BaseModel):
    """How far a job has come."""

    stage: str = Field(description="reading, compiling, building, tracing, writing; a verification has its own.")
    fraction: float = Field(ge=0, le=1, description="Of the whole job; never falls.")
    samples: int = Field(description="Per capture texel, so far.")
    error: float | None = Field(description="So far: relative RMS, 95 % upper bound.")
    seconds: float
    eta: float | None = Field(description="Seconds to go; null while unknown.")
    eta_range: tuple[float, float] | None = Field(
        None,
        description="Seconds to go at the least and at the most: the error falls between 1/N and 1/√N with N samples, each taking "
        "as long as in the fastest and in the slowest pass so far. Null in lists and events.",
    )


class Point(BaseModel):
    """A point on a bake's curve of error against time."""

    samples: int = Field(description="Per capture texel, so far.")
    rays: int = Field(description="Traced so far, of whatever kind.")
    seconds: float = Field(description="Since the bake began.")
    error: float | None = Field(description="Relative RMS, 95 % upper bound.")


class JobError(BaseModel):
    """Why a job failed."""

    slug: str
    where: str
    message: str
    exit_code: int = Field(description="What `octobake bake` would have exited with.")


class Attempt(BaseModel):
    """One time that somebody worked on a job."""

    number: int
    began: Time
    ended: Time | None
    outcome: Literal["succeeded", "failed", "cancelled", "lost", "restarted"] | None = Field(
        description="lost: the worker went away; restarted: the service did. Null while it goes on."
    )
    reason: str | None


class Delivery(BaseModel):
    """A webhook's message."""

    id: str = Field(description="The same however often it is sent: its header webhook-id.")
    attempts: int
    next: Time | None = Field(description="When it is sent again; null where it was delivered or given up.")
    delivered: Time | None
    reason: str | None = Field(description="Why the last attempt failed.")


class BakeResult(BaseModel):
    """What came of a bake."""

    bundle: Digest
    report: Digest
    preview: Digest | None = None
    samples: int
    error: float | None
    seconds: float
    stopped: Literal["target", "samples", "time", "interrupt"] = Field(description="interrupt: it was told to stop.")
    exit_code: int = Field(description="0; or 4: out of budget before the target error.")


class _Job(BaseModel):
    id: str
    state: State
    labels: dict[str, str]
    priority: int
    attempts: int = Field(description="Times that a worker was lost under this job.")
    created: Time
    started: Time | None
    finished: Time | None
    progress: Progress | None
    error: JobError | None
    limits: MemoryLimit
    pinned: bool
    keep_seconds: float | None
    webhook: str | None
    history: list[Attempt] = Field(description="Every attempt; empty in lists.")
    deliveries: list[Delivery] = Field(description="What became of the webhook; empty in lists.")
    links: dict[str, str] = Field(description="Paths of what belongs to this job and is there now.")


class Bake(_Job):
    """A bake."""

    scene: Digest
    spec: SpecDocument = Field(description="With every default filled in.")
    plan: Plan | None
    curve: list[Point]
    result: BakeResult | None


class VerificationRequest(_Request):
    """A verification of a finished bake: rendered with its bundle, compared with a path-traced twin."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"bake": "9f86d081884c7d65", "width": 320, "height": 180, "samples": 64}]})

    bake: str = Field(description="Id of a bake that has succeeded.")
    cameras: Annotated[list[CameraDocument], Field(max_length=64)] | None = Field(
        None, description="Default: the scene's own, else automatic ones inside it."
    )
    thresholds: ThresholdsDocument | None = Field(None, description="Default: those of a Cornell box seen from inside.")
    width: int = Field(WIDTH, ge=SMALLEST_SIDE, le=LARGEST_SIDE)
    height: int = Field(HEIGHT, ge=SMALLEST_SIDE, le=LARGEST_SIDE)
    samples: int = Field(
        SAMPLES, ge=2, le=MOST_SAMPLES, multiple_of=2, description="Paths a pixel of the twin; 16 times as many from each surface point."
    )
    labels: Labels = {}
    priority: Priority = 0
    limits: MemoryLimit = MemoryLimit()
    webhook: Webhook | None = None
    keep_seconds: Keep | None = None
    pinned: bool = Field(False, description="No clean-up takes its files.")


class StoredFile(BaseModel):
    """A file that a job made."""

    digest: Digest
    bytes: int


class VerificationResult(BaseModel):
    """What came of a verification."""

    passed: bool
    report: dict[str, Any] = Field(description="The figures; the same as verification.json among the files.")
    files: dict[str, StoredFile]
    exit_code: int = Field(description="0; or 5: a threshold failed.")


class Verification(_Job):
    """A verification."""

    bake: str
    result: VerificationResult | None


class Cleanup(BaseModel):
    """What a clean-up takes, or would take now."""

    jobs: list[str] = Field(description="Ids of jobs that expire: their files go.")
    forgotten: list[str] = Field(description="Ids of jobs that expired long ago: their figures and events go, too.")
    scenes: list[Digest]
    blobs: int
    bytes: int


Item = TypeVar("Item")


class Page(BaseModel, Generic[Item]):
    """A page of a list, the newest first."""

    @classmethod
    def model_parametrized_name(cls, params: tuple[Any, ...]) -> str:
        """BakePage rather than Page[Bake], so that clients' generated types have decent names."""
        return f"{params[0].__name__}Page"

    items: list[Item]
    next: str | None = Field(description="`cursor` of the next page; null on the last.")


def common(
    job: Job,
    progress: dict[str, Any] | None,
    path: str,
    history: Sequence[JobAttempt],
    deliveries: Sequence[Mapping[str, Any]],
    *more: str,
) -> dict[str, Any]:
    """What a bake's and a verification's documents share; `more` names resources below the job's own path."""
    path = f"{path}/{job.id}"
    return {
        "id": job.id,
        "state": job.state,
        "labels": job.labels,
        "priority": job.priority,
        "attempts": job.attempts,
        "created": _time(job.created),
        "started": _time(job.started),
        "finished": _time(job.finished),
        "progress": progress or job.progress,
        "error": job.error,
        "limits": {"memory_bytes": job.memory_bytes},
        "pinned": job.pinned,
        "keep_seconds": job.ttl,
        "webhook": job.webhook,
        "history": [{**asdict(a), "began": _time(a.began), "ended": _time(a.ended)} for a in history],
        "deliveries": [{**d, "next": _time(d["next"]), "delivered": _time(d["delivered"])} for d in deliveries],
        "links": {"self": path, "events": f"{path}/events", "log": f"{path}/log", **{name: f"{path}/{name}" for name in more}},
    }


def _time(seconds: float | None) -> datetime | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
