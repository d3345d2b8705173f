"""What runs inside a Dask worker: each function takes and returns names of stored bytes, never the bytes.

A task is told everything it needs in a :class:`Work`, fetches the scene by digest, keeps the last few prepared scenes, and polls a flag
that Dask's cancel raises.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from dask.typing import Key
from distributed import Worker, WorkerPlugin, get_worker
from numpy.typing import NDArray

from bake_core import bake, plan, verification
from bake_core.allocation import Allocation
from bake_core.bundle import read_bundle
from bake_core.cameras import parse_cameras
from bake_core.errors import BakeError
from bake_core.images import write_png
from bake_core.prepared import Prepared
from bake_core.prepared import prepare as prepare_bake
from bake_core.preview import preview
from bake_core.progress import Progress
from bake_core.relocation_trial import Trial
from bake_core.report import Run
from bake_core.shards import lit, trace_shard
from bake_core.spec import parse_spec
from bake_core.tally import State, Tally
from bake_core.thresholds import parse_thresholds
from service.blobs import Blobs, store_errors
from service.scenes import find_stored, load_stored

TOPIC = "octobake"
# Oftener than this nobody can read; the terminal redraws at 10 Hz, a web page at less.
REPORT_INTERVAL = 0.2
# Between two looks at the memory of a job that has a limit. Kernels poll their flag for every texel, so this is how late a job is stopped.
WATCH_SECONDS = 0.05
# In a job's work folder: the picture of its last whole pass.
PREVIEW = "preview"
Flag = NDArray[np.uint8]


@dataclass(frozen=True)
class Work:
    """What every task of a bake is told.

    Attributes
    ----------
    job : str
    store : str
        URL of the blob store.
    scene : dict
        ``root`` and ``files`` (name to digest).
    spec : dict
        Canonical.
    threads : int
    cached_scenes : int
    memory_bytes : int or None
        Resident memory that the process may come to while it works on this.
    trials : tuple of Trial or None, or None
        What :func:`prepare` measured of the bake's volumes: a worker that takes over does not measure again.
    """

    job: str
    store: str
    scene: Mapping[str, Any]
    spec: Mapping[str, Any]
    threads: int
    cached_scenes: int
    memory_bytes: int | None = None
    trials: tuple[Trial | None, ...] | None = None

    @property
    def own_threads(self) -> int:
        """`threads`, or where it is 0 every CPU that the process which asks may use."""
        return self.threads or len(os.sched_getaffinity(0))


def prepare(work: Work) -> tuple[int, int, dict[str, Any], tuple[Trial | None, ...]]:
    """Read, check and build the scene.

    Returns
    -------
    int, int, dict, tuple
        How many probes there are, how many threads this worker bakes with, the plan, and what was measured of the volumes.

    Raises
    ------
    BakeError
        ``job.over_memory``, where the bake would come to more than it may.
    """
    with _task(work):
        prepared = _prepared(work)
        # Its time is told while it runs, by what has been traced.
        held = plan.contents(prepared)
        told = asdict(held) | {"left_out": [x.entry() for x in held.left_out]}
        if work.memory_bytes is not None and told["memory_bytes"] > work.memory_bytes:
            raise _over_memory(work, f"{told['memory_bytes']} bytes are predicted")
        return prepared.probe_count, work.own_threads, told, prepared.trials


def compile_kernels(work: Work) -> None:
    """Compile what the scene needs, or fetch it from the cache: its time is no sample's. Then see that the scene has a finite answer."""
    with _task(work) as task:
        prepared = _prepared(work)
        bake.compile_kernels(prepared, audited=True)
        bake.check_finite(prepared, threads=work.own_threads, cancelled=task.flag)


def trace(work: Work, name: str, probes: tuple[int, int], samples: tuple[int, int], allocation: str | None) -> tuple[str, float]:
    """One shard of one pass; answers where its sums are stored and the seconds that tracing took."""
    with _task(work) as task:
        prepared = _prepared(work)
        blobs = _blobs(work.store)
        given = Allocation.from_bytes(blobs.get_work(work.job, allocation)) if allocation else Allocation.start(prepared.probe_count)
        # What a pass learns first is learnt once, and tells nothing of how long the next shard will take.
        lit(prepared, samples, threads=work.own_threads, cancelled=task.flag)
        began = time.monotonic()
        tally = trace_shard(prepared, probes, samples, given, threads=work.own_threads, cancelled=task.flag, advance=task.advance)
        seconds = time.monotonic() - began
        return blobs.put_work(work.job, name, tally.to_bytes()), seconds


def merge(work: Work, name: str, state: str | None, tallies: Sequence[str]) -> dict[str, Any]:
    """Add a whole pass to the sums before it.

    Returns
    -------
    dict
        Where the new sums are stored, and what the next pass is to know of them; their error, and how many rays there were in all.
    """
    with _task(work), tempfile.TemporaryDirectory(prefix="octobake-") as folder:
        blobs = _blobs(work.store)
        sums = _state(work, state)
        sums.add([Tally.from_bytes(blobs.get_work(work.job, tally)) for tally in tallies])
        sums.allocate(parse_spec(work.spec).stop)
        blobs.put_work(work.job, PREVIEW, _preview(sums, folder).read_bytes())
        return {
            "state": blobs.put_work(work.job, f"state-{name}", sums.to_bytes()),
            "allocation": blobs.put_work(work.job, f"allocation-{name}", sums.allocation.to_bytes()),
            "error": sums.error(),
            "rays": sums.rays,
        }


def finish(work: Work, state: str, run: Run) -> dict[str, Any]:
    """Filter, encode and pack; answers the digests and sizes of the bundle, of its report and of a preview."""
    with _task(work) as task, tempfile.TemporaryDirectory(prefix="octobake-") as folder:
        blobs = _blobs(work.store)
        out = Path(folder) / "bundle.zip"
        sums, prepared = _state(work, state), _prepared(work)
        bake.finish(prepared, sums, run, out, cancelled=task.flag)
        if prepared.light is not None:
            # The scene is kept for who bakes it again; what was learnt of its light is this bake's alone.
            prepared.light.forget()
        with zipfile.ZipFile(out) as bundle:
            report = Path(bundle.extract("report.json", folder))
        return {"bundle": blobs.put_blob(out), "report": blobs.put_blob(report), "preview": blobs.put_blob(_preview(sums, folder))}


def verify(work: Work, bundle: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """Render with a bundle and path-traced, and compare; answers the report, and the digests and sizes of all files."""
    with _task(work) as task, tempfile.TemporaryDirectory(prefix="octobake-") as folder:
        blobs = _blobs(work.store)
        out = Path(folder) / "verification"
        report = verification.verify(
            read_bundle(blobs.local_path(bundle)),
            load_stored(blobs, work.scene),
            parse_cameras(request["cameras"]) if "cameras" in request else None,
            out,
            width=request["width"],
            height=request["height"],
            samples=request["samples"],
            threads=work.own_threads,
            thresholds=parse_thresholds(request["thresholds"]) if "thresholds" in request else None,
            find=find_stored(blobs),
            progress=task.report,
            cancelled=task.flag,
        )
        paths = sorted(p for p in out.rglob("*") if p.is_file())
        return {"report": report, "files": {p.relative_to(out).as_posix(): blobs.put_blob(p) for p in paths}}


class CancelFlags(WorkerPlugin):
    """One flag per running task, raised as soon as Dask wants the task stopped.

    ``Client.cancel`` does not stop a thread; it does change the task's state, and that this hook sees within milliseconds.
    """

    name = "octobake-cancel-flags"

    def __init__(self) -> None:
        self.flags: dict[Key, Flag] = {}

    def transition(self, key: Key, start: str, finish: str, **_: Any) -> None:
        """Make a flag for a task that begins, raise it when the task is no longer wanted, or is over."""
        if finish == "executing":
            self.flags.setdefault(key, np.zeros(1, np.uint8))
        elif start == "executing":
            self.flags.pop(key)[0] = 1


class _Task:
    """This process's end of a running task: its cancel flag, and its voice."""

    def __init__(self) -> None:
        self._worker: Worker = get_worker()
        self._key = self._worker.get_current_task()
        self._done = 0.0
        self._told_at = float("-inf")
        self._lock = threading.Lock()
        flags = self._worker.plugins[CancelFlags.name]
        assert isinstance(flags, CancelFlags)
        # No flag: the task was cancelled between its start and this line.
        self.flag = flags.flags.get(self._key, np.ones(1, np.uint8))

    def advance(self, fraction: float) -> None:
        """Another part of this task is done; told now and then. Called from the kernels' threads."""
        with self._lock:
            self._done += fraction
            now = time.monotonic()
            if now - self._told_at < REPORT_INTERVAL:
                return
            self._told_at, done = now, self._done
        self.tell(done=done)

    def report(self, progress: Progress) -> None:
        """Progress of a task that is the whole of its job; told now and then."""
        with self._lock:
            now = time.monotonic()
            if now - self._told_at < REPORT_INTERVAL:
                return
            self._told_at = now
        self.tell(progress=asdict(progress))

    def tell(self, **message: Any) -> None:
        """Send a message to the service."""
        self._worker.log_event(TOPIC, {"key": self._key, "address": self._worker.address, **message})


@contextmanager
def _task(work: Work) -> Iterator[_Task]:
    task = _Task()
    task.tell(began=True)
    watch = _Watch(task, work)
    try:
        with watch, store_errors(f"job {work.job}"):
            yield task
    finally:
        task.tell(ended=True)


class _Watch:
    """Stops a task whose process comes to more memory than its job may take; does nothing where it may take any."""

    def __init__(self, task: _Task, work: Work) -> None:
        self._task, self._work = task, work
        self._over = 0
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        if self._work.memory_bytes is not None:
            self._thread = threading.Thread(target=self._look, daemon=True)
            self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join()
        if self._over:
            # The next job must not be blamed for what this one keeps.
            with _lock:
                _cache.clear()
            # Whatever the flag made of the task: this is why it was raised.
            raise _over_memory(self._work, f"the worker came to {self._over}") from None

    def _look(self) -> None:
        assert self._work.memory_bytes is not None
        while not self._done.wait(WATCH_SECONDS):
            resident = _resident_bytes()
            if resident > self._work.memory_bytes:
                self._over = resident
                # Kernels poll it; what polls nothing (a build) ends first.
                self._task.flag[0] = 1
                return


def _over_memory(work: Work, what: str) -> BakeError:
    text = f"{what}, more than its limit of {work.memory_bytes}; raise limits.memory_bytes, or bake fewer probes at a time"
    return BakeError("job.over_memory", text, f"job {work.job}")


def _resident_bytes() -> int:
    # Second figure of statm: resident pages.
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _preview(sums: State, folder: str) -> Path:
    path = Path(folder) / "preview.png"
    write_png(path, preview(sums))
    return path


# A worker has one task slot, so one thread at a time works on these; the lock is for whoever runs a worker with more.
_cache: OrderedDict[str, Prepared] = OrderedDict()
_stores: dict[str, Blobs] = {}
_lock = threading.Lock()


def _blobs(url: str) -> Blobs:
    with _lock:
        if url not in _stores:
            _stores[url] = Blobs(url, Path(tempfile.gettempdir()) / "octobake-blobs")
        return _stores[url]


def _prepared(work: Work) -> Prepared:
    key = repr((work.scene, work.spec))
    stored = _blobs(work.store)
    with _lock:
        if key not in _cache:
            scene = load_stored(stored, work.scene)
            # Room first: the old scene's memory is free before the new one's is taken.
            # A job with a limit is not charged for the scenes of others.
            while len(_cache) >= (work.cached_scenes if work.memory_bytes is None else 1):
                _cache.popitem(last=False)
            _cache[key] = prepare_bake(scene, parse_spec(work.spec), find_stored(stored), threads=work.own_threads, trials=work.trials)
        _cache.move_to_end(key)
        return _cache[key]


def _state(work: Work, reference: str | None) -> State:
    if reference is None:
        return bake.empty_state(_prepared(work))
    return State.from_bytes(_blobs(work.store).get_work(work.job, reference))
