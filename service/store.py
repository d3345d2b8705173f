"""The job store: the only truth about blobs, scenes, jobs, their events and what of them is committed.

SQLite embedded, PostgreSQL to scale; the SQL is SQLAlchemy Core's common ground of the two. Every method is one transaction, may be
called from any thread, and has reached the disk when it returns.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import AbstractContextManager
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from service import outbox
from service.jobs import FINISHED, REPEATABLE, TRANSITIONS, Attempt, Event, IllegalTransition, Job, Kind, Pass, Shard, State
from service.tables import attempts, blobs, events, idempotency_keys, jobs, metadata, open_engine, passes, reading, scenes, shards, writing

# Being asked for changes a blob's row no oftener than this; the shortest time that anything is kept is longer.
USED_SECONDS = 60.0
# A key stands for its request this long; a client that still tries has been told something else by then.
KEY_SECONDS = 86400.0


class Store:
    """The tables above, one method per question."""

    def __init__(self, url: str) -> None:
        self.engine = open_engine(url)

    def close(self) -> None:
        """Close every connection; SQLite folds its log back into the file."""
        self.engine.dispose()

    # Blobs and scenes

    def add_blob(self, digest: str, size: int) -> None:
        """Record a blob that is safely in the blob store; again is the same."""
        with self._write() as c:
            now = time.time()
            if not c.execute(sa.update(blobs).where(blobs.c.digest == digest).values(used=now)).rowcount:
                c.execute(sa.insert(blobs).values(digest=digest, size=size, created=now, used=now))

    def blob_size(self, digest: str) -> int | None:
        """Bytes of a blob, or None where there is none."""
        with self._read() as c:
            return c.execute(sa.select(blobs.c.size).where(blobs.c.digest == digest)).scalar_one_or_none()

    def use_blob(self, digest: str) -> int | None:
        """As :meth:`blob_size`, and no clean-up takes a blob that was just asked for."""
        with self._read() as c:
            row = c.execute(sa.select(blobs.c.size, blobs.c.used).where(blobs.c.digest == digest)).first()
        if row is None or time.time() - row.used < USED_SECONDS:
            return None if row is None else int(row.size)
        with self._write() as c:
            # A clean-up may have come between.
            changed = c.execute(sa.update(blobs).where(blobs.c.digest == digest).values(used=time.time()))
        return int(row.size) if changed.rowcount else None

    def add_scene(self, digest: str, root: str, files: Mapping[str, str], contents: Mapping[str, Any]) -> None:
        """Record a scene that the reader accepted; again is the same."""
        with self._write() as c:
            now = time.time()
            if not c.execute(sa.update(scenes).where(scenes.c.digest == digest).values(used=now)).rowcount:
                row = {"digest": digest, "root": root, "files": dict(files), "contents": dict(contents), "created": now, "used": now}
                c.execute(sa.insert(scenes).values(row))

    def scene(self, digest: str) -> dict[str, Any] | None:
        """``root``, ``files`` and ``contents`` of a scene, or None."""
        with self._read() as c:
            row = c.execute(sa.select(scenes).where(scenes.c.digest == digest)).first()
        return None if row is None else {"root": row.root, "files": row.files, "contents": row.contents}

    # Jobs

    def add_job(
        self,
        kind: Kind,
        request: Mapping[str, Any],
        labels: Mapping[str, str],
        priority: int,
        *,
        fingerprint: str = "",
        memory_bytes: int | None = None,
        webhook: str | None = None,
        pinned: bool = False,
        ttl: float | None = None,
        uses: Collection[str] = (),
        key: tuple[str, str] | None = None,
    ) -> Job:
        """Accept a job: once this returns, it survives whatever happens to the process.

        `uses` are the digests of the scene and of all files that the job needs, `key` what :meth:`take_key` was given.
        """
        job = secrets.token_hex(8)
        now = time.time()
        with self._write() as c:
            c.execute(
                sa.insert(jobs).values(
                    id=job,
                    kind=kind,
                    state=State.QUEUED,
                    request=dict(request),
                    labels=dict(labels),
                    priority=priority,
                    attempts=0,
                    created=now,
                    fingerprint=fingerprint,
                    memory_bytes=memory_bytes,
                    webhook=webhook,
                    pinned=pinned,
                    ttl=ttl,
                    stop_asked=False,
                )
            )
            _use(c, uses, now)
            if key is not None:
                owner, name = key
                mine = (idempotency_keys.c.owner == owner) & (idempotency_keys.c.key == name)
                c.execute(sa.update(idempotency_keys).where(mine).values(job=job))
            _add_event(c, job, "state", {"state": State.QUEUED})
            return _job(c, job)

    def take_key(self, owner: str, key: str, request: str) -> tuple[str, str | None]:
        """Whose turn it is with an Idempotency-Key; `request` is a digest of what it came with.

        Answers (the request that has the key, its job). The job is None while that request is being answered; the request is empty where
        the key is the caller's now, who must fulfil it with :meth:`add_job` or give it back.
        """
        mine = (idempotency_keys.c.owner == owner) & (idempotency_keys.c.key == key)
        now = time.time()
        with self._write() as c:
            c.execute(sa.delete(idempotency_keys).where(idempotency_keys.c.created < now - KEY_SECONDS))
            found = c.execute(sa.select(idempotency_keys).where(mine)).first()
            if found is not None:
                return found.request, found.job
            c.execute(sa.insert(idempotency_keys).values(owner=owner, key=key, request=request, created=now))
            return "", None

    def give_key(self, owner: str, key: str, job: str | None = None) -> None:
        """Give back a key whose request came to nothing, or that was answered with a `job` that there was."""
        mine = (idempotency_keys.c.owner == owner) & (idempotency_keys.c.key == key)
        with self._write() as c:
            if job is not None:
                c.execute(sa.update(idempotency_keys).where(mine).values(job=job))
            else:
                c.execute(sa.delete(idempotency_keys).where(mine & idempotency_keys.c.job.is_(None)))

    def finished_like(self, fingerprint: str) -> Job | None:
        """The newest bake of this fingerprint that has succeeded of its own accord."""
        query = sa.select(jobs).where((jobs.c.fingerprint == fingerprint) & (jobs.c.state == State.SUCCEEDED))
        with self._read() as c:
            found = [_to_job(row) for row in c.execute(query.order_by(jobs.c.sequence.desc()))]
        return next((job for job in found if job.result and job.result["stopped"] != "interrupt"), None)

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

    def requeue(self, job: str, uses: Collection[str]) -> Job:
        """Queue a finished job again, from its beginning: the sums of its passes went when it finished.

        Raises
        ------
        IllegalTransition
            Where TRANSITIONS has no such change.
        """
        with self._write() as c:
            now = _job(c, job, lock=True)
            if now.state not in REPEATABLE:
                raise IllegalTransition(job, now.state, State.QUEUED)
            for table in (shards, passes):
                c.execute(sa.delete(table).where(table.c.job == job))
            _use(c, uses, time.time())
            anew = {name: sa.null() for name in ("progress", "result", "error", "started", "finished")}
            return _move(c, job, State.QUEUED, stop_asked=False, **anew)

    def ask_stop(self, job: str) -> Job | None:
        """Ask a running bake to end with the passes it has; None where it has none, or does not run."""
        with self._write() as c:
            now = _job(c, job, lock=True)
            whole = c.execute(sa.select(passes.c.index).where((passes.c.job == job) & passes.c.state.is_not(None)).limit(1)).first()
            if now.state != State.RUNNING or whole is None:
                return None
            if not now.stop_asked:
                c.execute(sa.update(jobs).where(jobs.c.id == job).values(stop_asked=True))
                _add_event(c, job, "stop", {})
            return _job(c, job)

    def pin(self, job: str, pinned: bool) -> Job:
        """Keep a job's files from every clean-up, or no longer."""
        with self._write() as c:
            c.execute(sa.update(jobs).where(jobs.c.id == job).values(pinned=pinned))
            return _job(c, job)

    def expire(self, job: str) -> bool:
        """A finished job's files are to go; False where somebody wants them after all."""
        with self._write() as c:
            now = _job(c, job, lock=True)
            if now.pinned or State.EXPIRED not in TRANSITIONS[now.state]:
                return False
            _move(c, job, State.EXPIRED)
            return True

    def forget(self, job: str) -> bool:
        """Remove every row of a job that has expired; False where somebody has queued it again."""
        with self._write() as c:
            if _job(c, job, lock=True).state != State.EXPIRED:
                return False
            for table in reversed(metadata.sorted_tables):
                if "job" in table.c:
                    c.execute(sa.delete(table).where(table.c.job == job))
            c.execute(sa.delete(jobs).where(jobs.c.id == job))
            return True

    def set_plan(self, job: str, plan: Mapping[str, Any]) -> None:
        """Record what a job will bake."""
        with self._write() as c:
            c.execute(sa.update(jobs).where(jobs.c.id == job).values(plan=dict(plan)))
            _add_event(c, job, "plan", {"probes": plan["probes"]})

    def attempts(self, job: str) -> list[Attempt]:
        """All that was tried, in order."""
        query = sa.select(attempts).where(attempts.c.job == job).order_by(attempts.c.number)
        with self._read() as c:
            return [Attempt(row.number, row.began, row.ended, row.outcome, row.reason) for row in c.execute(query)]

    def add_attempt(self, job: str, why: str) -> None:
        """Count a worker lost under this job; with another one it goes on."""
        with self._write() as c:
            c.execute(sa.update(jobs).where(jobs.c.id == job).values(attempts=jobs.c.attempts + 1))
            now = time.time()
            _end_attempt(c, job, now, "lost", why)
            _begin_attempt(c, job, now)
            _add_event(c, job, "retry", {"reason": why})

    def reconcile(self) -> None:
        """After a start: nobody drives the jobs that were under way, so queue them again, and end those that were being cancelled.

        Whoever held a key for a request that was never answered tries it again.
        """
        with self._write() as c:
            c.execute(sa.delete(idempotency_keys).where(idempotency_keys.c.job.is_(None)))
            under_way = sa.select(jobs.c.id, jobs.c.state).where(jobs.c.state.not_in([State.QUEUED, *FINISHED])).order_by(jobs.c.sequence)
            for row in c.execute(under_way).all():
                _move(c, row.id, _left_behind(row.state))

    def take_up(self, job: str) -> None:
        """As :meth:`reconcile`, for a job whose driver has ended before its time."""
        with self._write() as c:
            state = _job(c, job, lock=True).state
            if state not in (State.QUEUED, *FINISHED):
                _move(c, job, _left_behind(state))

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

    def _write(self) -> AbstractContextManager[Connection]:
        return writing(self.engine)

    def _read(self) -> AbstractContextManager[Connection]:
        return reading(self.engine)


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
    ended = state in FINISHED and before.state not in FINISHED
    if ended:
        columns["finished"] = now
    c.execute(sa.update(jobs).where(jobs.c.id == job).values(state=state, **columns))
    told = {k: columns[k] for k in ("result", "error") if state in FINISHED and columns.get(k) is not None}
    _add_event(c, job, "state", {"state": state, **told})
    if state == State.PREPARING:
        _begin_attempt(c, job, now)
    elif ended:
        _end_attempt(c, job, now, state, (columns.get("error") or {}).get("slug"))
    elif state == State.QUEUED:
        _end_attempt(c, job, now, "restarted", None)
    after = _job(c, job)
    if ended and after.webhook is not None:
        outbox.add(c, after, now)
    return after


def _left_behind(state: str) -> State:
    """What becomes of a job under way that nobody drives."""
    return State.CANCELLED if state == State.CANCELLING else State.QUEUED


def _begin_attempt(c: Connection, job: str, now: float) -> None:
    before = c.execute(sa.select(sa.func.count()).where(attempts.c.job == job)).scalar_one()
    c.execute(sa.insert(attempts).values(job=job, number=before + 1, began=now))


def _end_attempt(c: Connection, job: str, now: float, outcome: str, reason: str | None) -> None:
    going_on = (attempts.c.job == job) & attempts.c.ended.is_(None)
    c.execute(sa.update(attempts).where(going_on).values(ended=now, outcome=outcome, reason=reason))


def _use(c: Connection, digests: Iterable[str], now: float) -> None:
    for table in (blobs, scenes):
        c.execute(sa.update(table).where(table.c.digest.in_(list(digests))).values(used=now))


def _add_event(c: Connection, job: str, kind: str, data: Mapping[str, Any]) -> None:
    c.execute(sa.insert(events).values(job=job, at=time.time(), type=kind, data=dict(data)))


def _to_job(row: Row[Any]) -> Job:
    columns = dict(row._mapping)
    return Job(**{**columns, "kind": Kind(columns["kind"]), "state": State(columns["state"])})
