"""How a person sees a running bake: one redrawn line on a terminal, a plain line every few seconds elsewhere."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TextIO

from bake_core.progress import Progress

if TYPE_CHECKING:
    # It loads numpy, which commands that bake nothing do without.
    from bake_core.convergence import Point

# A terminal line redrawn faster than this only flickers; a log needs a line no oftener than this to show that work goes on.
TERMINAL_INTERVAL = 0.1
LOG_INTERVAL = 5.0
BAR_WIDTH = 24


class ProgressLine:
    """Renders :class:`Progress` on a stream; pass it wherever a progress callback is taken, then call :meth:`close`.

    Parameters
    ----------
    stream : TextIO, optional
        Default stderr, so that stdout stays free for a command's answer.
    label : str
        Stands before each line; a job's id, for example.
    """

    def __init__(self, stream: TextIO | None = None, label: str = "") -> None:
        self.stream = sys.stderr if stream is None else stream
        self.label = f"{label} " if label else ""
        self.terminal = self.stream.isatty()
        self.last: Progress | None = None
        self._drawn_at = float("-inf")
        self._drawn: Progress | None = None

    def __call__(self, progress: Progress) -> None:
        """Take one report; draws it if enough time has passed or something other than the fraction has changed."""
        before, self.last = self._drawn, progress
        # A new stage is news at once; a growing fraction is news only now and then.
        news = before is None or before.stage != progress.stage
        interval = TERMINAL_INTERVAL if self.terminal else LOG_INTERVAL
        if news or time.monotonic() - self._drawn_at >= interval:
            self._draw(progress)

    def point(self, point: Point) -> None:
        """Print a new point of the curve of error against time; it stays, above the line that is redrawn."""
        clear = "\r\x1b[K" if self.terminal else ""
        self.stream.write(f"{clear}{self.label}{describe_point(point)}\n")
        self.stream.flush()
        if self.terminal and self._drawn is not None:
            self._draw(self._drawn)

    def close(self) -> None:
        """Draw the last report if it was held back, and end the line."""
        if self.last is not None and self.last != self._drawn:
            self._draw(self.last)
        if self.terminal and self._drawn is not None:
            self.stream.write("\n")
            self.stream.flush()

    def _draw(self, progress: Progress) -> None:
        self._drawn, self._drawn_at = progress, time.monotonic()
        text = self.label + describe(progress)
        if self.terminal:
            filled = round(progress.fraction * BAR_WIDTH)
            bar = "█" * filled + "░" * (BAR_WIDTH - filled)
            width = shutil.get_terminal_size().columns
            # Cut to the terminal's width: a line that wraps cannot be redrawn in place.
            self.stream.write("\r" + f"{bar} {text}"[: width - 1] + "\x1b[K")
        else:
            self.stream.write(text + "\n")
        self.stream.flush()


def describe(progress: Progress) -> str:
    """One report in words: ``tracing 42 %, 64 samples, error 3.1 %, 12 s, 8 s to go``."""
    parts = [f"{progress.stage} {progress.fraction * 100:3.0f} %"]
    if progress.samples:
        parts.append(f"{progress.samples} samples")
    if progress.error is not None:
        parts.append(f"error {percent(progress.error)}")
    parts.append(duration(progress.seconds))
    if progress.eta is not None:
        parts.append(f"{duration(progress.eta)} to go")
    return ", ".join(parts)


def describe_point(point: Point) -> str:
    """A point of the curve in words: ``pass done: 64 samples, 3.1 M rays, 12 s, error 3.1 %``."""
    error = "error unknown" if point.error is None else f"error {percent(point.error)}"
    return f"pass done: {point.samples} samples, {count(point.rays)} rays, {duration(point.seconds)}, {error}"


def describe_result(result: Mapping[str, Any]) -> str:
    """What came of a bake: ``64 samples, error 1.3 %, 6.2 s, stopped at its target``."""
    reasons = {
        "target": "stopped at its target",
        "samples": "stopped at its samples",
        "time": "stopped at its time",
        "interrupt": "stopped when told to",
    }
    error = "error unknown" if result["error"] is None else f"error {percent(result['error'])}"
    return f"{result['samples']} samples, {error}, {duration(result['seconds'])}, {reasons[result['stopped']]}"


def describe_job(job: Mapping[str, Any]) -> str:
    """One line about a bake from the service's JSON."""
    told = job["progress"]
    if job["error"]:
        place = f"{job['error']['where']}: " if job["error"]["where"] else ""
        text = f"[{job['error']['slug']}] {place}{job['error']['message']}"
    elif job["result"]:
        text = describe_result(job["result"])
    elif told:
        text = describe(Progress(told["stage"], told["fraction"], told["samples"], told["error"], told["seconds"], told["eta"]))
    else:
        text = f"priority {job['priority']}"
    labels = "".join(f" {key}={value}" for key, value in job["labels"].items())
    return f"{job['id']}  {job['state']:<10}  {job['created'][:19]}  {text}{labels}"


def percent(error: float) -> str:
    """An error as a percentage with two significant digits, since its own uncertainty is of that order."""
    return f"{error * 100:.2g} %" if error < 1 else f"{error * 100:.0f} %"


def count(n: int) -> str:
    """A large number with two or three digits: ``940``, ``12 k``, ``3.1 M``, ``5.0 G``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if n >= size:
            return f"{n / size:.{1 if n < 10 * size else 0}f} {letter}"
    return str(n)


def in_bytes(n: int) -> str:
    """``940 bytes``, ``12 kB``, ``3.1 MB``: thousands, as disks are sold."""
    return f"{n} bytes" if n < 1000 else f"{count(n)}B"


def duration(seconds: float) -> str:
    """Seconds as people say them: ``3.2 s``, ``41 s``, ``5 min 07 s``, ``2 h 03 min``."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
