"""Turns a bake's steps into progress reports: fractions that never fall, and a time to go."""

from __future__ import annotations

import threading
import time

from bake_core.progress import Progress, ProgressCallback
from bake_core.spec import Spec, Stop

# Reports a second at most: a terminal cannot show more, and an event store should not keep more.
_REPORTS_PER_SECOND = 10
# No time to go is told before this much of the tracing is done: from the first chunk alone it would be hours.
_ETA_FROM = 0.02
# Share of the bar kept for reading and building, and for writing.
_BEFORE, _AFTER = 0.02, 0.03


def expected_samples(stop: Stop, samples: int, error: float | None) -> int:
    """How many samples a bake will have taken when it stops, judged by the error so far.

    Doubling scrambled Sobol' points on integrands with edges takes the error down by √2 at the least.
    """
    if stop.target_error is None or error is None:
        return stop.max_samples
    total = samples
    while error > stop.target_error and total < stop.max_samples:
        total *= 2
        error /= 2**0.5
    return min(total, stop.max_samples)


class Clock:
    """Keeps time for one bake and reports progress; safe to be advanced from several threads."""

    def __init__(self, spec: Spec, callback: ProgressCallback | None) -> None:
        self._spec, self._callback = spec, callback
        self._started = self._stage_started = time.perf_counter()
        self._stage, self._stages = "", dict[str, float]()
        self._fraction = self._last_report = 0.0
        self._samples = 0
        self._measured: float | None = None
        self._pass, self._shards, self._pass_done = (0, 0), 1, 0.0
        self._tracing_started = 0.0
        self._lock = threading.Lock()

    @property
    def elapsed(self) -> float:
        """Seconds since the bake began."""
        return time.perf_counter() - self._started

    def stage(self, name: str) -> None:
        """Enter a stage."""
        now = time.perf_counter()
        if self._stage:
            self._stages[self._stage] = now - self._stage_started
        self._stage, self._stage_started = name, now
        if name == "tracing":
            self._tracing_started, self._fraction = now, _BEFORE
        if name == "writing":
            self._fraction = 1 - _AFTER
        self._report(force=True)

    def stages(self) -> dict[str, float]:
        """Seconds spent in each stage, the current one so far included."""
        return {**self._stages, self._stage: time.perf_counter() - self._stage_started}

    def begin(self, samples: tuple[int, int], shards: int) -> None:
        """A pass begins."""
        self._pass, self._shards, self._pass_done = samples, shards, 0.0

    def advance(self, fraction: float) -> None:
        """A part of one of the pass's shards is done."""
        with self._lock:
            self._pass_done += fraction / self._shards
            done = self._pass[0] + (self._pass[1] - self._pass[0]) * min(self._pass_done, 1.0)
            total = max(expected_samples(self._spec.stop, max(self._samples, 1), self._measured), self._pass[1])
            traced = done / total
            if self._spec.stop.max_seconds is not None:
                traced = max(traced, min(self.elapsed / self._spec.stop.max_seconds, 1.0))
            self._fraction = max(self._fraction, _BEFORE + (1 - _BEFORE - _AFTER) * traced)
            self._report()

    def measured(self, samples: int, error: float | None) -> None:
        """A pass has ended with this error."""
        self._samples, self._measured = samples, error
        self._report(force=True)

    def _report(self, force: bool = False) -> None:
        now = time.perf_counter()
        if self._callback is None or (not force and now - self._last_report < 1 / _REPORTS_PER_SECOND):
            return
        self._last_report = now
        eta = None
        traced = (self._fraction - _BEFORE) / (1 - _BEFORE - _AFTER)
        if self._stage == "tracing" and traced > _ETA_FROM:
            eta = (now - self._tracing_started) * (1 - traced) / traced
        self._callback(Progress(self._stage, self._fraction, self._samples, self._measured, now - self._started, eta))
