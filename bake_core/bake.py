"""The whole bake on one screen: scene and spec in, passes of samples over shards of probes, a bundle out.

1. :func:`bake_core.prepared.prepare`: place the probes, build what rays need.
2. :func:`bake_core.shards.trace_shard`: one shard's part of one pass; any process may do it, in any order.
3. :class:`bake_core.tally.State`: add a pass, measure the error; :func:`bake_core.convergence.decide` whether another follows
   (:func:`gather` does both, pass after pass).
4. :func:`finish`: filter, pack, encode, write.

:func:`bake` does it all here and now; the service does the same steps through its workers.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core import bundle, report
from bake_core.allocation import HALVES, SCRAMBLES, Allocation
from bake_core.assemble import assemble
from bake_core.audit import DEFAULT_SHARE, Audit, Baked, audit, compile_audit
from bake_core.clock import Clock
from bake_core.convergence import Point, decide, fit_pass, next_pass
from bake_core.endless import check_light_ends
from bake_core.environment import Find, no_images
from bake_core.errors import Cancelled, MachineError
from bake_core.parameters import choose_parameters, compile_choice
from bake_core.prepared import Prepared, prepare
from bake_core.progress import ProgressCallback
from bake_core.report import Run
from bake_core.scene_files import load_scene
from bake_core.shards import shard_ranges, trace_shard
from bake_core.spec import Spec
from bake_core.tally import State


def empty_state(prepared: Prepared) -> State:
    """The state before the first pass.

    Raises
    ------
    MachineError
        ``machine.no_memory``.
    """
    n, s = prepared.probe_count, prepared.selection
    start = Allocation.start(n)
    try:
        return State(
            samples=0,
            taken=start.taken,
            eighths=start.eighths,
            needed=prepared.needed.copy(),
            irradiance=np.zeros((n, SCRAMBLES, s.irradiance**2, 3), np.float32),
            radiance=np.zeros((n, HALVES, s.capture**2, 3) if s.keeps("radiance") else (0, 0, 0, 0), np.float32),
            visibility=np.zeros((n, s.visibility, s.visibility, 3) if s.keeps("visibility") else (0, 0, 0, 0), np.float32),
            backface=np.zeros(n, np.float32),
            distance=np.zeros((n, s.distance**2) if s.keeps("distance") else (0, 0), np.float32),
            normal=np.zeros((n, s.normal**2, 3) if s.keeps("normal") else (0, 0, 0), np.float32),
            rays=0,
        )
    except MemoryError:
        raise MachineError(
            "machine.no_memory", f"the sums of {n} probes do not fit; bake fewer probes or texels at a time", "volumes"
        ) from None


def compile_kernels(prepared: Prepared, *, audited: bool) -> None:
    """Compile, or fetch from the cache on disk, every kernel that a bake runs, and its audit: by tracing no probe at all."""
    trace_shard(prepared, (0, 0), (0, 0), Allocation.start(0), threads=1)
    if prepared.light is not None:
        prepared.light.compile()
    compile_choice(prepared.scene, prepared.whole)
    if audited:
        compile_audit(prepared.whole)


def check_finite(prepared: Prepared, *, threads: int, cancelled: NDArray[np.uint8] | None = None) -> None:
    """Refuse what has no finite answer, before any pass; runs the kernels.

    Raises
    ------
    SceneError
        ``scene.light_never_ends``.
    Cancelled
    """
    if prepared.spec.max_bounces is None:
        flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
        check_light_ends(prepared.scene, prepared.tracer, prepared.positions, threads=threads, cancelled=flag)


def gather(
    prepared: Prepared,
    run: Run,
    clock: Clock,
    *,
    adaptive: bool = True,
    point: Callable[[Point], None] = lambda point: None,
    cancelled: NDArray[np.uint8] | None = None,
) -> State:
    """Pass after pass, until the spec says that it is enough.

    Parameters
    ----------
    run : Run
        Its threads and shards are taken; its curve and why it stopped are filled in.
    adaptive, point, cancelled
        As :func:`bake` has them.

    Raises
    ------
    Cancelled
        Before the first pass was whole.
    """
    stop, state = prepared.spec.stop, empty_state(prepared)
    ranges = shard_ranges(prepared.probe_count, run.shards)
    error: float | None = None
    while run.stopped == "continue":
        samples = fit_pass(stop, next_pass(stop, state.samples, error), run.curve, clock.elapsed)
        if samples[0] == samples[1]:
            run.stopped = "time"
            break
        clock.begin(samples, len(ranges))
        given = state.allocation
        try:
            tallies = [
                trace_shard(prepared, r, samples, given, threads=run.threads, cancelled=cancelled, advance=clock.advance) for r in ranges
            ]
        except Cancelled:
            if not run.curve:
                raise
            run.stopped = "interrupt"
            break
        state.add(tallies)
        if adaptive:
            state.allocate(stop)
        error, seconds = state.error(), clock.elapsed
        run.curve.append(Point(state.samples, state.rays, seconds, error))
        point(run.curve[-1])
        clock.measured(state.samples, error)
        run.stopped = decide(stop, state.samples, error, seconds)
    return state


def finish(
    prepared: Prepared,
    state: State,
    run: Run,
    out: Path,
    *,
    audit_seconds: float | None = None,
    cancelled: NDArray[np.uint8] | None = None,
) -> dict[str, Any]:
    """Write the bundle: atlases, shaders, manifest, an audit of them, report; all or nothing.

    Parameters
    ----------
    run : Run
        Its audit is filled in.
    audit_seconds : float, optional
        What the audit may take; 3 % of the bake where left out. 0: no audit.
    cancelled : (1,) uint8, optional
        Set it to 1 from any thread: the audit ends, and the report has none.

    Returns
    -------
    dict
        The manifest.

    Raises
    ------
    MachineError
        ``machine.cannot_write``; what stood there before still does.
    BakeError
    """
    try:
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent, ignore_cleanup_errors=True) as folder:
            work = Path(folder) / "bundle"
            work.mkdir()
            manifest = assemble(
                prepared.scene,
                prepared.spec,
                prepared.volumes,
                prepared.offsets,
                prepared.trials,
                prepared.selection,
                prepared.left_out,
                state,
                run.stopped,
                None if prepared.light is None else prepared.light.cached,
                work,
                lambda volumes: choose_parameters(prepared.scene, prepared.whole, volumes, threads=run.threads),
            )
            written = bundle.dump_json(manifest)
            (work / bundle.MANIFEST).write_bytes(written)
            allowed = DEFAULT_SHARE * run.seconds if audit_seconds is None else audit_seconds
            if audit_seconds != 0:
                run.audit = _audit(prepared, state, work, allowed, run.threads, cancelled)
            report.write(work, manifest, bundle.content_digest(written), run)
            bundle.publish(work, out)
    except OSError as e:
        raise MachineError("machine.cannot_write", f"{e.strerror or e}; is there room on the disk?", str(out)) from e
    return manifest


def _audit(prepared: Prepared, state: State, work: Path, seconds: float, threads: int, cancelled: NDArray[np.uint8] | None) -> Audit | None:
    """Of what has just been written; None where somebody has no more time for it."""
    volumes = bundle.read_bundle(work).volumes
    baked = Baked(prepared.scene, prepared.spec, prepared.whole, state, volumes, prepared.positions, prepared.limits)
    try:
        return audit(baked, seconds, threads=threads, cancelled=cancelled)
    except Cancelled:
        return None


@dataclass(frozen=True)
class BakeResult:
    """`met` tells whether the target error was reached, or none was asked for."""

    manifest: dict[str, Any]
    run: Run
    met: bool


def bake(
    scene_path: str | Path,
    spec: Spec,
    out: str | Path,
    *,
    threads: int = 1,
    shards: int = 1,
    find: Find = no_images,
    adaptive: bool = True,
    audit_seconds: float | None = None,
    progress: ProgressCallback | None = None,
    point: Callable[[Point], None] = lambda point: None,
    cancelled: NDArray[np.uint8] | None = None,
) -> BakeResult:
    """Bake here and now.

    Parameters
    ----------
    scene_path : path
        .glb or .gltf.
    out : path
        A folder, or a zip where it ends in .zip; an existing one is replaced only if it is a bundle.
    threads, shards : int
        How the work is split; the bundle does not depend on it.
    find : callable, optional
        Where an image that the spec names lies.
    adaptive : bool
        Whether easy probes may get fewer samples, where there is an error to reach (:mod:`bake_core.allocation`).
    audit_seconds : float, optional
        As :func:`finish` has it.
    point : callable, optional
        Told each point of the curve of error against time as it is measured.
    cancelled : (1,) uint8, optional
        Set it to 1 from any thread: tracing stops within a texel, and what whole passes have gathered is written.

    Raises
    ------
    InputError
        Nothing was written.
    Cancelled
        Before the first pass was whole: nothing was written.
    """
    out = Path(out).absolute()
    bundle.check_replaceable(out)
    clock = Clock(spec, progress)
    clock.stage("reading")
    scene = load_scene(scene_path)
    clock.stage("building")
    prepared = prepare(scene, spec, find, threads=threads)
    clock.stage("compiling")
    compile_kernels(prepared, audited=audit_seconds != 0)
    clock.stage("tracing")
    check_finite(prepared, threads=threads, cancelled=cancelled)
    run = Run(threads, shards, began=clock.elapsed)
    state = gather(prepared, run, clock, adaptive=adaptive, point=point, cancelled=cancelled)
    clock.stage("writing")
    run.seconds, run.stages = clock.elapsed, clock.stages()
    manifest = finish(prepared, state, run, out, audit_seconds=audit_seconds, cancelled=cancelled)
    return BakeResult(manifest, run, met(spec, run))


def met(spec: Spec, run: Run) -> bool:
    """Whether a bake got what it was asked for: its target error where there was one, and nobody stopped it."""
    target, error = spec.stop.target_error, run.curve[-1].error
    return run.stopped != "interrupt" and (target is None or (error is not None and error <= target))
