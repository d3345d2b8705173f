"""What is kept, and for how long: files of finished jobs, scenes and uploads go when their time is up and nobody needs them.

A clean-up and its preview are one computation. Jobs' rows, their events and their figures stay for a longer time of their own.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.blobs import Blobs
from service.jobs import FINISHED, Kind, State
from service.settings import Settings
from service.store import Store
from service.tables import blobs, jobs, reading, scenes, writing

log = logging.getLogger("octobake.retention")

CLEAN_SECONDS = 3600.0
# By more than a clock that is kept right is ever moved at once.
JUMP_SECONDS = 60.0
DAY = 86400.0


@dataclass(frozen=True)
class Cleanup:
    """What a clean-up takes: ids of jobs that expire, and of those that are forgotten; digests of scenes; digest to size of blobs."""

    jobs: tuple[str, ...]
    forgotten: tuple[str, ...]
    scenes: tuple[str, ...]
    blobs: dict[str, int]


class Retention:
    """Cleans up every hour, and when it is told to.

    An hour in which the wall clock was moved is left out: what it takes cannot be had back, and a clock that was moved by mistake is
    likely to have been put right by the next.
    """

    def __init__(self, settings: Settings, store: Store, files: Blobs) -> None:
        self._seconds, self._history_seconds = settings.retention_days * DAY, settings.history_days * DAY
        self._store, self._files = store, files
        # One clean-up at a time.
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._clocks = _clocks()
        self._thread = threading.Thread(target=self._loop, name="octobake-retention", daemon=True)

    def start(self) -> None:
        """Begin to clean up by the hour."""
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        self._stopping.set()

    def preview(self) -> Cleanup:
        """What a clean-up would take now."""
        with reading(self._store.engine) as c:
            return self._find(c)[0]

    def clean(self) -> Cleanup:
        """Take it; answers what was taken. What somebody began to use meanwhile stays."""
        with self._lock:
            with reading(self._store.engine) as c:
                found, used = self._find(c)
            forgotten = tuple(job for job in found.forgotten if self._store.forget(job))
            expired = tuple(job for job in found.jobs if self._store.expire(job))
            gone = tuple(digest for digest in found.scenes if self._remove_scene(digest, used[digest]))
            kept = set(found.scenes) - set(gone)
            if kept or len(expired) < len(found.jobs):
                # Somebody needs files that were to go: what may go is another set now.
                with reading(self._store.engine) as c:
                    found, used = self._find(c)
            sizes = {digest: size for digest, size in found.blobs.items() if self._remove_blob(digest, used[digest])}
        return Cleanup(expired, forgotten, gone, sizes)

    def _loop(self) -> None:
        while not self._stopping.is_set():
            try:
                self._clean_by_the_hour()
            except Exception:
                log.exception("a clean-up failed; the next one goes on")
            self._stopping.wait(CLEAN_SECONDS)

    def _clean_by_the_hour(self) -> None:
        if jump := self._jump():
            log.warning("the clock was moved by %+.0f s: nothing is cleaned up before the next hour", jump)
            return
        taken = self.clean()
        counted = [len(x) for x in (taken.jobs, taken.forgotten, taken.blobs, taken.scenes)]
        if any(counted):
            log.info("%d jobs expired, %d forgotten; %d files and %d scenes removed", *counted)

    def _jump(self) -> float:
        """Seconds by which the wall clock was moved since this was asked last; 0 where by few."""
        (wall, passed), self._clocks = self._clocks, _clocks()
        moved = (self._clocks[0] - wall) - (self._clocks[1] - passed)
        return moved if abs(moved) > JUMP_SECONDS else 0.0

    def _find(self, c: Connection) -> tuple[Cleanup, dict[str, float]]:
        """What is to go, and when each scene and blob of it was last used."""
        now = time.time()
        cutoff = now - self._seconds if self._seconds else float("-inf")
        rows = {row.id: row for row in c.execute(sa.select(jobs))}
        over = [job for job, row in rows.items() if self._is_over(row, now)]
        past = {*over, *(job for job, row in rows.items() if row.state == State.EXPIRED)}
        # A verification that is still to come needs its bake's files.
        waiting = {row.request["bake"] for row in rows.values() if row.kind == Kind.VERIFICATION and row.state not in FINISHED}
        over = [job for job in over if job not in waiting]
        past -= waiting
        long_past = now - self._history_seconds if self._history_seconds else float("-inf")
        forgotten = [job for job in past if rows[job].state == State.EXPIRED and rows[job].finished <= long_past]
        needed = {digest for job, row in rows.items() if job not in past for digest in _needs(row)}
        needed |= {digest for job in waiting for digest in _needs(rows[job])}
        made = {digest for job in past for digest in _results(rows[job])}
        last_used: dict[str, float] = {}
        old_scenes = []
        for row in c.execute(sa.select(scenes.c.digest, scenes.c.files, scenes.c.used)):
            if row.digest not in needed and row.used < cutoff:
                old_scenes.append(row.digest)
                last_used[row.digest] = row.used
            else:
                needed |= set(row.files.values())
        sizes = {}
        for row in c.execute(sa.select(blobs.c.digest, blobs.c.size, blobs.c.used)):
            if row.digest not in needed and (row.used < cutoff or row.digest in made):
                sizes[row.digest] = row.size
                last_used[row.digest] = row.used
        return Cleanup(tuple(over), tuple(sorted(forgotten)), tuple(old_scenes), sizes), last_used

    def _is_over(self, row: Any, now: float) -> bool:
        ttl = self._seconds or None if row.ttl is None else row.ttl
        return row.state in FINISHED and row.state != State.EXPIRED and not row.pinned and ttl is not None and row.finished + ttl <= now

    def _remove_scene(self, digest: str, used: float) -> bool:
        with writing(self._store.engine) as c:
            return bool(c.execute(sa.delete(scenes).where((scenes.c.digest == digest) & (scenes.c.used == used))).rowcount)

    def _remove_blob(self, digest: str, used: float) -> bool:
        with writing(self._store.engine) as c:
            # Workers write files that have no row yet, and might be this one; they do so in these states only.
            finalizing = jobs.c.state == State.FINALIZING
            verifying = (jobs.c.kind == Kind.VERIFICATION) & (jobs.c.state == State.RUNNING)
            if c.execute(sa.select(jobs.c.id).where(finalizing | verifying).limit(1)).first() is not None:
                return False
            if not c.execute(sa.delete(blobs).where((blobs.c.digest == digest) & (blobs.c.used == used))).rowcount:
                return False
            # Within the transaction, so that nobody can add the row again before the file is gone.
            self._files.remove_blob(digest)
            return True


def _clocks() -> tuple[float, float]:
    """The wall clock, and one that only goes on, while the machine sleeps, too."""
    return time.time(), time.clock_gettime(time.CLOCK_BOOTTIME)


def _results(row: Any) -> Iterator[str]:
    """Files that a job has made."""
    result = row.result or {}
    yield from (result[name] for name in ("bundle", "report", "preview") if name in result)
    yield from (stored["digest"] for stored in result.get("files", {}).values())


def _needs(row: Any) -> Iterator[str]:
    """The scene, the sky and the files that a job that has not expired keeps."""
    yield from _results(row)
    if "scene" in row.request:
        yield row.request["scene"]
        environment = row.request["spec"].get("environment", {})
        if "image" in environment:
            yield environment["image"]
