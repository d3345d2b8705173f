"""What an error costs: each scene baked to each target, with what its audit found."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bake_core.bake import bake
from bake_core.bench.outcome import Series, error_against_seconds
from bake_core.drawing import Drawing
from bake_core.environment import beside
from bake_core.rate import Rate, rate_by_seconds
from bake_core.report import percent
from bake_core.spec import Spec, Stop


@dataclass(frozen=True)
class Subject:
    """A scene with its spec, and where the spec's images are looked for."""

    name: str
    scene: Path
    spec: Spec
    images: Path


@dataclass(frozen=True)
class Baked:
    """One bake to one target.

    Attributes
    ----------
    tracing, seconds : float
        Of tracing alone, and of the whole bake.
    stated : float or None
        The error that the bundle states.
    audit : dict or None
        ``report.json``'s ``audit``, as it stands there; None where the bake made none.
    curve, rays_curve : list of (seconds of tracing, error) and of (rays, error)
    rate : Rate
        Of the error against seconds of tracing.
    """

    scene: str
    target: float
    tracing: float
    seconds: float
    samples: int
    rays: int
    stated: float | None
    stopped: str
    bytes: int
    audit: dict[str, Any] | None
    curve: list[tuple[float, float]]
    rays_curve: list[tuple[float, float]]
    rate: Rate


def bake_to(subject: Subject, stop: Stop, threads: int, folder: Path, changes: Mapping[str, Any] | None = None, **options: Any) -> Baked:
    """Bake with a stop of its own, and with changes to the spec; options are those of :func:`bake_core.bake.bake`."""
    out = folder / "bundle"
    update: dict[str, Any] = {**(changes or {}), "stop": stop}
    result = bake(subject.scene, subject.spec.model_copy(update=update), out, threads=threads, find=beside(subject.images), **options)
    report = json.loads((out / "report.json").read_bytes())
    run, began = result.run, result.run.began or 0.0
    last = run.curve[-1]
    return Baked(
        subject.name,
        stop.target_error or 0.0,
        last.seconds - began,
        run.seconds,
        last.samples,
        last.rays,
        result.manifest["error"]["value"],
        run.stopped,
        sum(f.stat().st_size for f in out.rglob("*") if f.is_file() and not f.name.startswith("report.")),
        report.get("audit"),
        [(p.seconds - began, p.error) for p in run.curve if p.error is not None],
        [(float(p.rays), p.error) for p in run.curve if p.error is not None],
        rate_by_seconds(run.curve, began),
    )


def warm_up(subject: Subject, threads: int, folder: Path, changes: Mapping[str, Any] | None = None, **options: Any) -> None:
    """Bake one sample, so that no measured bake loads or compiles kernels."""
    bake_to(subject, Stop(target_error=None, max_samples=1), threads, folder, changes, **options)


@dataclass(frozen=True)
class Targets:
    """What :func:`measure` found."""

    baked: tuple[Baked, ...]
    max_seconds: float

    def document(self) -> dict[str, Any]:
        return asdict(self)

    def rows(self) -> list[dict[str, Any]]:
        plain = ("scene", "target", "tracing", "seconds", "samples", "rays", "stated", "stopped", "bytes")
        return [
            {
                **{k: getattr(b, k) for k in plain},
                **{f"audited_{k}": audited(b.audit, k) for k in ("error", "low", "high", "sampling", "filtering", "encoding", "bias")},
                "verdict": (b.audit or {}).get("verdict"),
                "rate": b.rate.slope,
                "rate_error": b.rate.standard_error,
            }
            for b in self.baked
        ]

    def table(self) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = [
            ("scene", "target", "seconds", "tracing", "samples", "stated error", "audited error", "verdict", "rate", "stopped by")
        ]
        for b in self.baked:
            slope = "–" if b.rate.slope is None else f"{b.rate.slope:.2f}"
            spread = "" if b.rate.standard_error is None else f" ± {b.rate.standard_error:.2f}"
            rows.append(
                (
                    b.scene,
                    f"{100 * b.target:g} %",
                    f"{b.seconds:.1f}",
                    f"{b.tracing:.1f}",
                    str(b.samples),
                    percent(b.stated),
                    audited_in_words(b.audit),
                    str((b.audit or {}).get("verdict", "–")),
                    slope + spread,
                    b.stopped,
                )
            )
        return rows

    def notes(self) -> list[str]:
        return [
            f"Seconds of the whole bake and of its tracing, at most {self.max_seconds:g} s each. The stated error is a 95 % upper bound of "
            "sampling error; the audited one is of irradiance texels as stored, with its 95 % interval; the rate is the slope of log error "
            "against log seconds of tracing."
        ]

    def plot(self) -> Drawing:
        """Of each scene the bake with the most to do."""
        longest: dict[str, Baked] = {}
        for b in self.baked:
            if b.scene not in longest or b.tracing > longest[b.scene].tracing:
                longest[b.scene] = b
        return error_against_seconds([Series(b.scene, b.curve, b.rate) for b in longest.values()])


def audited(audit: dict[str, Any] | None, what: str) -> float | None:
    """A figure of an audit of irradiance texels; None where there is none."""
    found = ((audit or {}).get("texels") or {}).get("irradiance") or {}
    return found.get(what)


def audited_in_words(audit: dict[str, Any] | None) -> str:
    """The error that an audit found, and its 95 % interval."""
    error, low, high = (audited(audit, k) for k in ("error", "low", "high"))
    interval = "" if low is None or high is None else f" ({100 * low:.2f} to {100 * high:.2f})"
    return percent(error) + interval


def measure(
    subjects: Sequence[Subject],
    targets: Sequence[float],
    *,
    threads: int,
    max_seconds: float,
    max_samples: int,
    audit_seconds: float | None,
    say: Callable[[str], None],
) -> Targets:
    """Bake every scene to every target, the easiest first.

    Parameters
    ----------
    max_seconds, max_samples
        Each bake ends there at the latest.
    audit_seconds
        What each audit may take; None: 3 % of its bake, which resolves little where the bake took a second.
    say : callable
        Told a line after each bake.
    """
    baked = []
    with tempfile.TemporaryDirectory(prefix="octobake-bench-") as folder:
        for subject in subjects:
            warm_up(subject, threads, Path(folder))
            for target in sorted(targets, reverse=True):
                stop = Stop(target_error=target, max_seconds=max_seconds, max_samples=max_samples)
                b = bake_to(subject, stop, threads, Path(folder), audit_seconds=audit_seconds)
                baked.append(b)
                say(f"{b.scene}, target {target:g}: {b.samples} samples, error {percent(b.stated)}, {b.seconds:.1f} s, by {b.stopped}")
    return Targets(tuple(baked), max_seconds)
