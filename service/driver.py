"""Drives one job: its pieces of work one after the other through Dask, each result committed before the next is asked for.

A driver may start on a job of which a part is committed already; it goes on from there. It keeps no truth of its own.
"""

from __future__ import annotations

import logging
import math
import queue
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

from distributed import Future, KilledWorker
from distributed.client import FutureCancelledError
from sqlalchemy.exc import OperationalError

from bake_core import bake
from bake_core.clock import Clock
from bake_core.convergence import decide, fit_pass, next_pass
from bake_core.errors import BakeError, OctobakeError
from bake_core.progress import Progress
from bake_core.report import Run
from bake_core.shards import shard_ranges
from bake_core.spec import Spec, parse_spec
from service import worker
from service.blobs import Blobs, StoreError
from service.compute import Compute, Message
from service.hub import Hub
from service.jobs import IllegalTransition, Job, Kind, Pass, State
from service.settings import Settings
from service.store import Store

log = logging.getLogger("octobake.driver")

# A task that has not ended this long after its cancel is in native code that polls no flag (building, compiling, Vulkan): its worker is
# killed, so that the CPU is free within the second that is promised, on a busy machine too.
STOP_SECONDS = 0.3
# Between tries of a piece that the blob store has failed: nine minutes in all, after which the job fails.
STORE_PAUSES = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0)
# Before the first shard has been timed: paths a second on one thread, on the slow side, so that first shards are rather short.
FIRST_GUESS_RATE = 200_000.0


class _Cancel(Exception):
    """The job's state has become `cancelling`."""


class _Enough(Exception):
    """The bake shall end with the passes it has."""


class _Stop(Exception):
    """The service is going down; the job stays as it is, for the next start to find."""


@dataclass
class _Piece:
    """One call of a worker function.

    `told` is how far its caller has heard that it is, `lost` how many workers it has cost, `refused` how often the blob store failed it.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    done: Callable[[Any], None]
    told: float = 0.0
    lost: int = 0
    refused: int = 0


class Driver:
    """Runs one claimed job to its end, in the thread that calls :meth:`run`."""

    def __init__(self, job: Job, settings: Settings, store: Store, blobs: Blobs, compute: Compute, hub: Hub) -> None:
        self.job = job
        self._settings, self._store, self._blobs, self._compute, self._hub = settings, store, blobs, compute, hub
        # Keys of futures that are done, messages of workers, and the three exceptions above: everything that a driver waits for.
        self._inbox: queue.SimpleQueue[str | Message | type[Exception]] = queue.SimpleQueue()
        self._began = time.monotonic()
        self._seconds_before = 0.0
        # A restart may have come between the request and its effect.
        self._enough = job.stop_asked
        self._tracing = False
        # Futures that are done with. They are released behind the next piece's submission: what follows a message within ten milliseconds
        # Dask's client sends only after those, and the worker would wait for its next piece.
        self._spent: list[Future[Any]] = []
        self._shown: dict[str, Any] | None = None

    # Called from other threads

    def hear(self, message: Message) -> None:
        """Take a worker's message; those of other jobs' tasks are ignored."""
        self._inbox.put(message)

    def cancel(self) -> None:
        """The job is `cancelling`."""
        self._inbox.put(_Cancel)

    def finish(self) -> None:
        """A bake shall end with the passes it has: the store has `stop_asked`. Too late while it is finalizing, and of no effect then."""
        self._inbox.put(_Enough)

    def stop(self) -> None:
        """The service is going down."""
        self._inbox.put(_Stop)

    # The job

    def run(self) -> None:
        """Drive the job; returns when it has finished, or when the service stops.

        Raises
        ------
        OperationalError
            The job store cannot be written, so there is no saying what became of the job; its committed work is safe.
        """
        job = self.job.id
        try:
            if self.job.kind == Kind.BAKE:
                self._bake()
            else:
                self._verify()
        except _Stop:
            return
        except (_Cancel, IllegalTransition):
            # Nobody but a cancel moves a job away from under its driver.
            self._store.move(job, State.CANCELLED)
        except OctobakeError as e:
            self._fail(e)
        except OperationalError:
            raise
        except Exception as e:
            log.exception("job %s", job)
            self._fail(BakeError("bake.internal", f"{type(e).__name__}: {e}", f"job {job}"))
        finally:
            self._release()
            self._hub.forget(job)
            self._hub.tell(job)
        self._blobs.remove_work(job)

    def _fail(self, error: OctobakeError) -> None:
        record = {"slug": error.slug, "where": error.where, "message": error.message, "exit_code": error.exit_code}
        try:
            self._store.move(self.job.id, State.FAILED, error=record)
        except IllegalTransition:
            self._store.move(self.job.id, State.CANCELLED)

    def _move(self, state: State, **columns: Any) -> None:
        self._store.move(self.job.id, state, **columns)
        self._hub.tell(self.job.id)

    def _bake(self) -> None:
        spec = parse_spec(self.job.request["spec"])
        work = self._work(self.job)
        passes = self._store.passes(self.job.id)
        merged = [p for p in passes if p.state is not None]
        opened = passes[len(merged) :]
        self._seconds_before = _seconds(merged[-1]) if merged else 0.0
        clock = Clock(spec, self._show)

        clock.stage("building")
        probes, threads, plan, trials = self._one(worker.prepare, work)
        work = replace(work, trials=trials)
        self._store.set_plan(self.job.id, plan)
        self._move(State.RUNNING)
        clock.stage("compiling")
        self._one(worker.compile_kernels, work)
        clock.stage("tracing")
        run = Run(threads, 1, None if passes else self._seconds(), [p.point for p in merged])
        if merged:
            clock.measured(merged[-1].last, merged[-1].error)
            run.stopped = decide(spec.stop, merged[-1].last, merged[-1].error, self._seconds_before)
        if merged and run.stopped == "continue" and self._enough:
            run.stopped = "interrupt"
        while run.stopped == "continue":
            following = opened.pop(0) if opened else self._open_pass(spec, merged, run, probes)
            if following is None:
                run.stopped = "time"
                break
            self._tracing = True
            try:
                done = self._trace(work, following, probes, merged[-1] if merged else None, clock)
            except _Enough:
                run.stopped = "interrupt"
                break
            finally:
                self._tracing = False
            merged.append(done)
            run.shards = done.shards
            run.curve.append(done.point)
            run.stopped = decide(spec.stop, done.last, done.error, _seconds(done))

        self._move(State.FINALIZING)
        clock.stage("writing")
        run.seconds, run.stages = self._seconds(), clock.stages()
        files = self._one(worker.finish, work, merged[-1].state, run)
        for digest, size in files.values():
            self._store.add_blob(digest, size)
        result = {
            **{name: digest for name, (digest, _) in files.items()},
            "samples": merged[-1].last,
            "error": merged[-1].error,
            "seconds": self._seconds(),
            "stopped": run.stopped,
            "exit_code": 0 if bake.met(spec, run) else 4,
        }
        last = Progress("writing", 1.0, merged[-1].last, merged[-1].error, self._seconds(), 0.0)
        self._move(State.SUCCEEDED, result=result, progress=asdict(last))

    def _open_pass(self, spec: Spec, merged: list[Pass], run: Run, probes: int) -> Pass | None:
        """The next pass, or None where the time that is left has no room for one."""
        samples, error = (merged[-1].last, merged[-1].error) if merged else (0, None)
        first, last = fit_pass(spec.stop, next_pass(spec.stop, samples, error), run.curve, self._seconds())
        if first == last:
            return None
        paths = probes * (spec.resolution.radiance or 16) ** 2
        rate = FIRST_GUESS_RATE * run.threads
        if merged:
            shards = self._store.shards(self.job.id, merged[-1].index).values()
            rate = paths * (merged[-1].last - merged[-1].first) / max(sum(s.seconds for s in shards), 1e-3)
        pieces = math.ceil(paths * (last - first) / rate / self._settings.shard_seconds)
        return self._store.begin_pass(self.job.id, len(merged), first, last, min(max(pieces, self._compute.slots), probes))

    def _trace(self, work: worker.Work, opened: Pass, probes: int, before: Pass | None, clock: Clock) -> Pass:
        """Trace what is missing of a pass, and merge it."""
        state, allocation = (before.state, before.allocation) if before else (None, None)
        tallies = {i: s.tally for i, s in self._store.shards(self.job.id, opened.index).items()}
        ranges = shard_ranges(probes, opened.shards)

        def piece(shard: int) -> _Piece:
            def commit(result: tuple[str, float]) -> None:
                tallies[shard], seconds = result
                self._store.commit_shard(self.job.id, opened.index, shard, tallies[shard], seconds)

            name = f"pass-{opened.index}-shard-{shard}"
            return _Piece(worker.trace, (work, name, ranges[shard], (opened.first, opened.last), allocation), commit)

        clock.begin((opened.first, opened.last), opened.shards)
        for _ in tallies:
            clock.advance(1.0)
        self._run([piece(i) for i in range(opened.shards) if i not in tallies], clock.advance)
        references = [tallies[i] for i in range(opened.shards)]
        done = replace(opened, **self._one(worker.merge, work, str(opened.index), state, references), seconds=self._seconds())
        clock.measured(done.last, done.error)
        self._store.commit_pass(self.job.id, done, self._shown or {})
        self._hub.tell(self.job.id)
        return done

    def _verify(self) -> None:
        request = self.job.request
        baked = self._store.job(request["bake"])
        assert baked is not None and baked.result is not None, "a verification is accepted only of a bake that has succeeded"
        work = replace(self._work(baked), memory_bytes=self.job.memory_bytes)
        self._move(State.RUNNING)
        made = self._one(worker.verify, work, baked.result["bundle"], request)
        self._move(State.FINALIZING)
        for digest, size in made["files"].values():
            self._store.add_blob(digest, size)
        report = made["report"]
        files = {name: {"digest": digest, "bytes": size} for name, (digest, size) in made["files"].items()}
        result = {"passed": report["passed"], "report": report, "files": files, "exit_code": 0 if report["passed"] else 5}
        last = Progress("writing", 1.0, request["samples"], None, self._seconds(), 0.0)
        self._move(State.SUCCEEDED, result=result, progress=asdict(last))

    def _work(self, baked: Job) -> worker.Work:
        """What a worker is told of a bake's scene and spec."""
        scene = self._store.scene(baked.request["scene"])
        assert scene is not None, "a job's scene stays as long as the job's files do"
        files = {key: scene[key] for key in ("root", "files")}
        s = self._settings
        return worker.Work(self.job.id, self._blobs.url, files, baked.request["spec"], s.threads, s.cached_scenes, baked.memory_bytes)

    # Pieces of work

    def _one(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """One call on a worker, and its result."""
        results: list[Any] = []
        self._run([_Piece(function, arguments, results.append)])
        return results[0]

    def _run(self, pieces: Iterable[_Piece], advance: Callable[[float], None] = lambda fraction: None) -> None:
        """Run pieces, as many at once as there are slots; each is handed to its `done` as it comes in."""
        waiting = deque(pieces)
        running: dict[str, tuple[_Piece, Future[Any]]] = {}
        begun: dict[str, str] = {}
        held_until = 0.0
        while waiting or running:
            held = max(0.0, held_until - time.monotonic())
            while waiting and not held and len(running) < self._compute.slots:
                piece = waiting.popleft()
                future = self._compute.submit(piece.function, *piece.arguments)
                running[str(future.key)] = piece, future
                future.add_done_callback(lambda done: self._inbox.put(str(done.key)))
            self._release()
            try:
                news = self._inbox.get(timeout=held or None)
            except queue.Empty:
                continue
            if news is _Enough and not self._tracing:
                self._enough = True
                continue
            if isinstance(news, type):
                self._halt(running, begun, wait=news is not _Stop)
                raise news
            if isinstance(news, str):
                if news not in running:
                    continue
                piece, future = running.pop(news)
                try:
                    piece.done(future.result())
                except (KilledWorker, FutureCancelledError) as e:
                    self._lost(piece, type(e).__name__)
                    waiting.appendleft(piece)
                except StoreError as e:
                    held_until = time.monotonic() + self._refused(piece, e)
                    waiting.appendleft(piece)
                else:
                    advance(max(0.0, 1.0 - piece.told))
                finally:
                    self._spent.append(future)
            elif news["key"] in running:
                begun[news["key"]] = news["address"]
                if "progress" in news:
                    self._show(Progress(**news["progress"]))
                if "done" in news:
                    piece = running[news["key"]][0]
                    # A piece that is run again has told a part of this already.
                    advance(max(0.0, news["done"] - piece.told))
                    piece.told = max(piece.told, news["done"])

    def _release(self) -> None:
        while self._spent:
            self._compute.release(self._spent.pop())

    def _halt(self, running: dict[str, tuple[_Piece, Future[Any]]], begun: dict[str, str], wait: bool) -> None:
        """Stop what runs, and see to it that it has stopped."""
        # Where each piece runs; None where it has begun nowhere yet. What holds the interpreter from its first line on (a cold compiler, a
        # parser) has not come to say so itself, hence the scheduler's word.
        known = self._compute.places(list(running)) | begun if wait else {}
        unheard = {key: known.get(key) for key in running}
        self._compute.cancel([future for _, future in running.values()])
        deadline = time.monotonic() + STOP_SECONDS
        while wait and unheard and (left := deadline - time.monotonic()) > 0:
            try:
                news = self._inbox.get(timeout=left)
            except queue.Empty:
                break
            if not isinstance(news, dict) or news["key"] not in unheard:
                continue
            if "ended" in news:
                del unheard[news["key"]]
            else:
                unheard[news["key"]] = news["address"]
        if wait:
            for address in {a for a in unheard.values() if a is not None}:
                self._compute.restart(address)

    def _lost(self, piece: _Piece, why: str) -> None:
        """A worker went away under a piece: count it, and give up on a piece that keeps killing them."""
        piece.lost += 1
        self._store.add_attempt(self.job.id, f"{piece.function.__name__}: {why}")
        self._hub.tell(self.job.id)
        if piece.lost >= self._settings.max_attempts:
            text = f"its worker died {piece.lost} times at {piece.function.__name__}; look for what this scene does to memory"
            raise BakeError("bake.crashed", text, f"job {self.job.id}")

    def _refused(self, piece: _Piece, error: StoreError) -> float:
        """The blob store failed a piece: how many seconds to leave it in peace."""
        if piece.refused == len(STORE_PAUSES):
            raise error
        pause = STORE_PAUSES[piece.refused]
        piece.refused += 1
        log.warning("job %s: %s; trying again in %g s", self.job.id, error, pause)
        return pause

    def _seconds(self) -> float:
        """Since the bake began, without the time that it lay in the queue after a restart."""
        return self._seconds_before + time.monotonic() - self._began

    def _show(self, progress: Progress) -> None:
        self._shown = asdict(replace(progress, seconds=self._seconds()))
        self._hub.report(self.job.id, self._shown)


def _seconds(done: Pass) -> float:
    """When a merged pass was merged."""
    assert done.seconds is not None
    return done.seconds
