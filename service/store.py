"""The job store: the only truth about blobs, scenes, jobs, their events and what of them is committed.

SQLite embedded, PostgreSQL to scale; the SQL is SQLAlchemy Core's common ground of the two. Every method is one transaction, may be
called from any thread, and has reached the disk when it returns.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from bake_core.errors import MachineError
from service.jobs import FINISHED, TRANSITIONS, Event, IllegalTransition, Job, Kind, Pass, Shard, State

# SQLite's writers wait for each other this long; the longest transaction here takes milliseconds.
BUSY_SECONDS = 10.0

metadata = sa.MetaData()
blobs = sa.Table(
    "blobs",
    metadata,
    sa.Column("digest", sa.String(71), primary_key=True),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
)
scenes = sa.Table(
    "scenes",
    metadata,
    sa.Column("digest", sa.String(71), primary_key=True),
    # {"root": NAME, "files": {NAME: "sha256:HEX"}}; a single GLB has one file, itself.
    sa.Column("root", sa.Text, nullable=False),
    sa.Column("files", sa.JSON, nullable=False),
    sa.Column("contents", sa.JSON, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
)
jobs = sa.Table(
    "jobs",
    metadata,
    # BIGINT would not autoincrement on SQLite.
    sa.Column("sequence", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("id", sa.String(32), nullable=False, unique=True),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("request", sa.JSON, nullable=False),
    sa.Column("labels", sa.JSON, nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False, default=0),
    sa.Column("progress", sa.JSON(none_as_null=True)),
    sa.Column("result", sa.JSON(none_as_null=True)),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("started", sa.Double),
    sa.Column("finished", sa.Double),
    sa.Index("jobs_queue", "state", "priority", "sequence"),
    sqlite_autoincrement=True,  # a sequence is never used twice, so a cursor never goes back
)
events = sa.Table(
    "events",
    metadata,
    sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), nullable=False),
    sa.Column("at", sa.Double, nullable=False),
    sa.Column("type", sa.String(16), nullable=False),
    sa.Column("data", sa.JSON, nullable=False),
    sa.Index("events_of_job", "job", "id"),
    sqlite_autoincrement=True,
)
passes = sa.Table(
    "passes",
    metadata,
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("index", sa.Integer, primary_key=True),
    sa.Column("first", sa.Integer, nullable=False),
    sa.Column("last", sa.Integer, nullable=False),
    sa.Column("shards", sa.Integer, nullable=False),
    sa.Column("state", sa.Text),
    sa.Column("allocation", sa.Text),
    sa.Column("error", sa.Double),
    sa.Column("seconds", sa.Double),
    # Of all passes up to this one.
    sa.Column("rays", sa.BigInteger),
)
shards = sa.Table(
    "shards",
    metadata,
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("pass_index", sa.Integer, primary_key=True),
    sa.Column("index", sa.Integer, primary_key=True),
    sa.Column("tally", sa.Text, nullable=False),
    sa.Column("seconds", sa.Double, nullable=False),
)


class Store:
    """The tables above, one method per question."""

    def __init__(self, url: str) -> None:
        self.engine = sa.create_engine(url)
        if self.engine.dialect.name == "sqlite":
            sa.event.listen(self.engine, "connect", _open_sqlite)
            sa.event.listen(self.engine, "begin", _begin_sqlite)
        metadata.create_all(self.engine)
        self._check_columns()

    def _check_columns(self) -> None:
        """Refuse the tables of another version, rather than fail at the first job."""
        there = sa.inspect(self.engine)
        for table in metadata.sorted_tables:
            missing = {c.name for c in table.columns} - {c["name"] for c in there.get_columns(table.name)}
            if missing:
                raise MachineError(
                    "service.other_version",
                    f"the table {table.name!r} lacks {', '.join(sorted(missing))}: another version of octobake made it; "
                    "give --data (or --database) a new place",
                    self.engine.url.render_as_string(hide_password=True),
                )

    def close(self) -> None:
        """Close every connection; SQLite folds its log back into the file."""
        self.engine.dispose()

    # Blobs and scenes

    def add_blob(self, digest: str, size: int) -> None:
        """Record a blob that is safely in the blob store; again is the same."""
        with self._write() as c:
            if c.execute(sa.select(blobs.c.size).where(blobs.c.digest == digest)).first() is None:
                c.execute(sa.insert(blobs).values(digest=digest, size=size, created=time.time()))

    def blob_size(self, digest: str) -> int | None:
        """Bytes of a blob, or None where there is none."""
        with self._read() as c:
            return c.execute(sa.select(blobs.c.size).where(blobs.c.digest == digest)).scalar_one_or_none()

    def add_scene(self, digest: str, root: str, files: Mapping[str, str], contents: Mapping[str, Any]) -> None:
        """Record a scene that the reader accepted; again is the same."""
        with self._write() as c:
            if c.execute(sa.select(scenes.c.root).where(scenes.c.digest == digest)).first() is None:
                row = {"digest": digest, "root": root, "files": dict(files), "contents": dict(contents), "created": time.time()}
                c.execute(sa.insert(scenes).values(row))

    def scene(self, digest: str) -> dict[str, Any] | None:
        """``root``, ``files`` and ``contents`` of a scene, or None."""
        with self._read() as c:
            row = c.execute(sa.select(scenes).where(scenes.c.digest == digest)).first()
        return None if row is None else {"root": row.root, "files": row.files, "contents": row.contents}

    # Jobs

    def add_job(self, kind: Kind, request: Mapping[str, Any], labels: Mapping[str, str], priority: int) -> Job:
        """Accept a job: once this returns, it survives whatever happens to the process."""
        job = secrets.token_hex(8)
        with self._write() as c:
            row = {"id": job, "kind": kind, "state": State.QUEUED, "request": dict(request), "labels": dict(labels), "priority": priority}
            c.execute(sa.insert(jobs).values(attempts=0, created=time.time(), **row))
            _add_event(c, job, "state", {"state": State.QUEUED})
            return _job(c, job)

    def job(self, job: str, kind: Kind | None = None) -> Job | None:
        """One job, or None; with `kind`, only if it is of that kind."""
        with self._read() as c:
            row = c.execute(sa.select(jobs).where(jobs.c.id == job)).first()
        return None if row is None or kind not in (None, row.kind) else _to_job(row)

    def list_jobs(
        self,
        kind: Kind | None,
        *,
        state: State | None = None,
        labels: Mapping[str, str] | None = None,
        before: int | None = None,
        limit: int,
    ) -> list[Job]:
        """Jobs, the newest first; `before` is the sequence of the last one already seen."""
        query = sa.select(jobs).order_by(jobs.c.sequence.desc()).limit(limit)
        if kind is not None:
            query = query.where(jobs.c.kind == kind)
        if state is not None:
            query = query.where(jobs.c.state == state)
        for key, value in (labels or {}).items():
            query = query.where(jobs.c.labels[key].as_string() == value)
        if before is not None:
            query = query.where(jobs.c.sequence < before)
        with self._read() as c:
            return [_to_job(row) for row in c.execute(query)]

    def count_jobs(self) -> dict[State, int]:
        """How many jobs there are in each state."""
        with self._read() as c:
            rows = c.execute(sa.select(jobs.c.state, sa.func.count()).group_by(jobs.c.state)).all()
        counted = {str(state): int(count) for state, count in rows}
        return {state: counted.get(state, 0) for state in State}

    def claim(self) -> Job | None:
        """Take the next queued job, highest priority first, then oldest; it is `preparing` from here on."""
        first = jobs.c.priority.desc(), jobs.c.sequence
        query = sa.select(jobs.c.id).where(jobs.c.state == State.QUEUED).order_by(*first).limit(1).with_for_update(skip_locked=True)
        with self._write() as c:
            job = c.execute(query).scalar_one_or_none()
            return None if job is None else _move(c, job, State.PREPARING)

    def move(self, job: str, state: State, **columns: Any) -> Job:
        """Change a job's state, with other columns and the event in the same transaction.

        Raises
        ------
        IllegalTransition
            Where TRANSITIONS has no such change.
        """
        with self._write() as c:
            return _move(c, job, state, **columns)

    def cancel(self, job: str) -> Job:
        """Ask for a job's end: a queued one is cancelled at once, an active one is `cancelling`, a finished one stays as it is."""
        with self._write() as c:
            now = _job(c, job, lock=True)
            if now.state in FINISHED or now.state == State.CANCELLING:
                return now
            return _move(c, job, State.CANCELLED if now.state == State.QUEUED else State.CANCELLING)

    def add_attempt(self, job: str, why: str) -> None:
        """Count a worker lost under this job."""
        with self._write() as c:
            c.execute(sa.update(jobs).where(jobs.c.id == job).values(attempts=jobs.c.attempts + 1))
            _add_event(c, job, "retry", {"reason": why})

    def reconcile(self) -> None:
        """After a start: nobody drives the jobs that were under way, so queue them again, and end those that were being cancelled."""
        with self._write() as c:
            under_way = sa.select(jobs.c.id, jobs.c.state).where(jobs.c.state.not_in([State.QUEUED, *FINISHED])).order_by(jobs.c.sequence)
            for row in c.execute(under_way).all():
                _move(c, row.id, State.CANCELLED if row.state == State.CANCELLING else State.QUEUED)

    # Passes and shards

    def begin_pass(self, job: str, index: int, first: int, last: int, pieces: int) -> Pass:
        """Open a pass; its division into shards is fixed from here on, so that a restart can resume it."""
        with self._write() as c:
            c.execute(sa.insert(passes).values({"job": job, "index": index, "first": first, "last": last, "shards": pieces}))
        return Pass(index, first, last, pieces)

    def commit_shard(self, job: str, pass_index: int, index: int, tally: str, seconds: float) -> None:
        """Record a shard's sums, once: whoever comes second is dropped, for its bytes are the same."""
        key = (shards.c.job == job) & (shards.c.pass_index == pass_index) & (shards.c.index == index)
        with self._write() as c:
            if c.execute(sa.select(shards.c.tally).where(key)).first() is None:
                row = {"job": job, "pass_index": pass_index, "index": index, "tally": tally, "seconds": seconds}
                c.execute(sa.insert(shards).values(row))

    def commit_pass(self, job: str, done: Pass, progress: Mapping[str, Any]) -> None:
        """Record a pass that is merged, its point on the error curve and the job's progress."""
        with self._write() as c:
            key = (passes.c.job == job) & (passes.c.index == done.index)
            known = {name: getattr(done, name) for name in ("state", "allocation", "error", "seconds", "rays")}
            c.execute(sa.update(passes).where(key).values(known))
            c.execute(sa.update(jobs).where(jobs.c.id == job).values(progress=dict(progress)))
            _add_event(c, job, "pass", {"samples": done.last, "rays": done.rays, "seconds": done.seconds, "error": done.error})

    def passes(self, job: str) -> list[Pass]:
        """A bake's passes in order."""
        with self._read() as c:
            rows = c.execute(sa.select(passes).where(passes.c.job == job).order_by(passes.c.index)).mappings().all()
        return [Pass(**{k: v for k, v in row.items() if k != "job"}) for row in rows]

    def shards(self, job: str, pass_index: int) -> dict[int, Shard]:
        """The committed shards of a pass, by index."""
        with self._read() as c:
            query = sa.select(shards).where((shards.c.job == job) & (shards.c.pass_index == pass_index))
            rows = c.execute(query).mappings().all()
        return {row["index"]: Shard(row["index"], row["tally"], row["seconds"]) for row in rows}

    # Events

    def events(self, job: str, after: int = 0, limit: int = 1000) -> list[Event]:
        """A job's events with an id above `after`, in order."""
        query = sa.select(events).where((events.c.job == job) & (events.c.id > after)).order_by(events.c.id).limit(limit)
        with self._read() as c:
            return [Event(row.id, row.job, row.at, row.type, row.data) for row in c.execute(query)]

    @contextmanager
    def _write(self) -> Iterator[Connection]:
        with self.engine.begin() as connection:
            yield connection

    @contextmanager
    def _read(self) -> Iterator[Connection]:
        with self.engine.connect().execution_options(octobake_read=True) as connection:
            yield connection


def _job(c: Connection, job: str, lock: bool = False) -> Job:
    query = sa.select(jobs).where(jobs.c.id == job)
    return _to_job(c.execute(query.with_for_update() if lock else query).one())


def _move(c: Connection, job: str, state: State, **columns: Any) -> Job:
    before = _job(c, job, lock=True)
    if state not in TRANSITIONS[before.state]:
        raise IllegalTransition(job, before.state, state)
    now = time.time()
    if state == State.PREPARING and before.started is None:
        columns["started"] = now
    if state in FINISHED:
        columns["finished"] = now
    c.execute(sa.update(jobs).where(jobs.c.id == job).values(state=state, **columns))
    told = {k: columns[k] for k in ("result", "error") if columns.get(k) is not None}
    _add_event(c, job, "state", {"state": state, **told})
    return _job(c, job)


def _add_event(c: Connection, job: str, kind: str, data: Mapping[str, Any]) -> None:
    c.execute(sa.insert(events).values(job=job, at=time.time(), type=kind, data=dict(data)))


def _to_job(row: Row[Any]) -> Job:
    columns = dict(row._mapping)
    return Job(**{**columns, "kind": Kind(columns["kind"]), "state": State(columns["state"])})


def _open_sqlite(connection: Any, _: object) -> None:
    # The driver must not begin transactions of its own: _begin_sqlite says which kind each is.
    connection.isolation_level = None
    pragmas: Sequence[str] = (
        "journal_mode = WAL",  # readers never wait for the writer
        "synchronous = FULL",  # a commit is on the disk when it returns: what 202 promises
        "foreign_keys = ON",
        f"busy_timeout = {int(BUSY_SECONDS * 1000)}",
    )
    for pragma in pragmas:
        connection.execute(f"PRAGMA {pragma}").close()


def _begin_sqlite(connection: Connection) -> None:
    # A writer takes its lock at the start: two that read first and then write would fail each other without waiting.
    reads = connection.get_execution_options().get("octobake_read", False)
    connection.exec_driver_sql("BEGIN" if reads else "BEGIN IMMEDIATE")
