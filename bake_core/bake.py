"""The whole bake on one screen: scene and spec in, passes of samples over shards of probes, a bundle out.

1. :func:`prepare`: place the probes, build what rays need.
2. :func:`trace_shard`: one shard's part of one pass; any process may do it, in any order.
3. :class:`bake_core.tally.State`: add a pass, measure the error; :func:`bake_core.convergence.decide` whether another follows
   (:func:`gather` does both, pass after pass).
4. :func:`finish`: filter, pack, encode, write.

:func:`bake` does it all here and now; the service does the same steps through its workers.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core import bundle, report
from bake_core.allocation import HALVES, SCRAMBLES, Allocation
from bake_core.assemble import assemble
from bake_core.audit import DEFAULT_SHARE, Audit, Baked, audit, compile_audit
from bake_core.capture import Capture, capture_distance, capture_radiance
from bake_core.clock import Clock
from bake_core.convergence import Point, decide, fit_pass, next_pass
from bake_core.endless import check_light_ends
from bake_core.environment import Find, no_images, read_environment
from bake_core.errors import Cancelled, MachineError
from bake_core.octahedral import texel_solid_angles
from bake_core.parameters import LARGEST, choose_parameters, compile_choice
from bake_core.placement import Volume, place
from bake_core.progress import ProgressCallback
from bake_core.reach import probes_about_surfaces
from bake_core.relocation import relocate
from bake_core.report import Run
from bake_core.scene import Scene
from bake_core.scene_files import load_scene
from bake_core.sealed import is_sealed
from bake_core.selection import LeftOut, Selection, select
from bake_core.shader_constants import biases
from bake_core.spec import Spec
from bake_core.tally import State, Tally, outside
from bake_core.tracer import Tracer
from bake_core.unneeded import unneeded
from bake_core.walls import moments_and_walls

# Probes whose distances are held at once: 64² rays of 33 bytes each, 9 MB a thread.
_DISTANCE_CHUNK = 64


@dataclass(frozen=True)
class Prepared:
    """A function of scene and spec only.

    Attributes
    ----------
    positions : (n, 3) float64
        Of all probes of all volumes in turn, local frame.
    offsets : (n, 3) float32
        By how much they were moved from their lattice points.
    limits, units : (n,) float64
        Each probe's distance limit, and the smallest spacing of its volume, metres.
    needed : (n,) bool
        Which of them are baked at all, unless they turn out to stand inside a solid.
    tracer : Tracer
        What probes are traced with.
    whole : Tracer
        The scene as it is: what audits look at. It has an environment that `tracer` may do without.
    """

    scene: Scene
    spec: Spec
    volumes: tuple[Volume, ...]
    selection: Selection
    tracer: Tracer
    whole: Tracer
    positions: NDArray[np.float64]
    offsets: NDArray[np.float32]
    limits: NDArray[np.float64]
    units: NDArray[np.float64]
    needed: NDArray[np.bool_]

    @property
    def probe_count(self) -> int:
        return len(self.positions)

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Outputs first, then what kernels do without."""
        return self.selection.left_out + unneeded(self.tracer.tables, sealed=self.tracer is not self.whole)


def prepare(scene: Scene, spec: Spec, find: Find = no_images) -> Prepared:
    """Place the probes, choose the outputs, build the acceleration structure.

    Parameters
    ----------
    find : callable, optional
        Where an image that the spec names lies; in what is prepared it is named by its digest.

    Raises
    ------
    SpecError, SceneError
    """
    volumes = place(scene, spec)
    environment, named = read_environment(spec.environment, find)
    spec = spec.model_copy(update={"environment": named})
    positions = np.concatenate([v.positions() for v in volumes]) - scene.origin
    whole = Tracer.build(scene, spec, environment)
    offsets = np.zeros(positions.shape, np.float32)
    if spec.probes == "relocated":
        offsets = relocate(whole, volumes, positions)
        positions = positions + offsets
    shines = environment.sky is not None or bool(environment.constant.any())
    return Prepared(
        scene=scene,
        spec=spec,
        volumes=volumes,
        selection=select(scene, spec, volumes),
        tracer=whole.without_environment() if shines and is_sealed(scene, whole, positions) else whole,
        whole=whole,
        positions=positions,
        offsets=offsets,
        limits=np.concatenate([np.full(v.probe_count, v.distance_limit) for v in volumes]),
        units=np.concatenate([np.full(v.probe_count, v.spacing.min()) for v in volumes]),
        needed=needed_probes(scene, volumes) if spec.receivers == "surfaces" else np.ones(len(positions), np.bool_),
    )


def needed_probes(scene: Scene, volumes: Sequence[Volume]) -> NDArray[np.bool_]:
    """Which probes any query on a surface asks, (n,) bool, of all volumes in turn: :func:`bake_core.reach.probes_about_surfaces`.

    Surfaces are taken as far off as a query moves its point before it asks for visibility, which bounds what a renderer does to points.
    """
    counts = [np.asarray(v.counts, np.int64) for v in volumes]
    margins = [sum(biases(LARGEST, v.spacing, n)) for v, n in zip(volumes, counts, strict=True)]
    return np.concatenate([probes_about_surfaces(scene, v, margin) for v, margin in zip(volumes, margins, strict=True)])


def shard_ranges(probe_count: int, shards: int) -> list[tuple[int, int]]:
    """Half-open ranges of probes, as equal as they go; never an empty one."""
    shards = max(1, min(shards, probe_count))
    edges = [probe_count * i // shards for i in range(shards + 1)]
    return list(pairwise(edges))


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


def trace_shard(
    prepared: Prepared,
    probes: tuple[int, int],
    samples: tuple[int, int],
    allocation: Allocation,
    *,
    threads: int,
    cancelled: NDArray[np.uint8] | None = None,
    advance: Callable[[float], None] = lambda fraction: None,
) -> Tally:
    """One shard's part of one pass.

    Parameters
    ----------
    probes, samples : (int, int)
        Half-open ranges. The pass that starts at sample 0 captures distances first: who stands inside a solid is not traced.
    allocation : Allocation
        What each probe of the bake has had before this pass, and what part of it each gets.
    cancelled : (1,) uint8, optional
        Set it to 1 from any thread: the kernels stop within one texel.
    advance : callable
        Told the fraction of this shard done since it was last called; from any thread.

    Raises
    ------
    Cancelled
    """
    s = prepared.selection
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    positions = np.ascontiguousarray(prepared.positions[slice(*probes)])
    ids = np.arange(*probes, dtype=np.uint64)
    capture = Capture(s.capture, s.irradiance, prepared.spec.seed, s.keeps("radiance"))
    spans = allocation.spans(samples, slice(*probes))
    seen: dict[str, NDArray[np.float32]] = {}
    looked = 0
    if samples[0] == 0:
        needed = prepared.needed[slice(*probes)]
        seen, looked = _see(prepared, probes[0] + np.flatnonzero(needed), threads, flag)
        free = outside(seen["backface"])
        seen = {name: values if name == "backface" else values[free] for name, values in seen.items()}
        seen["backface"], kept = _spread(seen["backface"], needed), _spread(free, needed)
        spans[~kept, :, 1] = spans[~kept, :, 0]
    else:
        kept = allocation.eighths[slice(*probes)].max(1) > 0
    irradiance, radiance, rays = capture_radiance(
        prepared.tracer,
        np.ascontiguousarray(positions[kept]),
        ids[kept],
        np.ascontiguousarray(spans[kept]),
        capture,
        threads=threads,
        cancelled=flag,
        advance=advance,
    )
    empty = np.zeros
    return Tally(
        *probes,
        *samples,
        taken=spans[..., 1],
        irradiance=_stored(irradiance),
        radiance=_stored(radiance),
        visibility=seen.get("visibility", empty((0, 0, 0, 0), np.float32)),
        backface=seen.get("backface", empty(0, np.float32)),
        distance=seen.get("distance", empty((0, 0), np.float32)),
        normal=seen.get("normal", empty((0, 0, 0), np.float32)),
        rays=rays + looked,
    )


def _spread(values: NDArray[Any], where: NDArray[np.bool_]) -> NDArray[Any]:
    """Values of those where a mask says so; zeros for the others."""
    out = np.zeros(len(where), values.dtype)
    out[where] = values
    return out


def _stored(sums: NDArray[np.float64]) -> NDArray[np.float32]:
    """Sums in single precision: 2⁻²⁴ of a value is far below what its samples know. What overflows is refused where maps are checked."""
    with np.errstate(over="ignore"):
        return sums.astype(np.float32)


def compile_kernels(prepared: Prepared, *, audited: bool) -> None:
    """Compile, or fetch from the cache on disk, every kernel that a bake runs, and its audit: by tracing no probe at all."""
    trace_shard(prepared, (0, 0), (0, 0), Allocation.start(0), threads=1)
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


def _see(
    prepared: Prepared, probes: NDArray[np.int64], threads: int, flag: NDArray[np.uint8]
) -> tuple[dict[str, NDArray[np.float32]], int]:
    """Distances and what is made of them, a few probes at a time on each thread; and how many rays they took."""
    s = prepared.selection
    positions, limits, units = (np.ascontiguousarray(a[probes]) for a in (prepared.positions, prepared.limits, prepared.units))
    solid_angle = texel_solid_angles(s.distance).reshape(-1) / (4 * np.pi)

    def look(first: int) -> tuple[dict[str, NDArray[np.float32]], int]:
        chunk = slice(first, first + _DISTANCE_CHUNK)
        distance, normal, back, rays = capture_distance(prepared.tracer, positions[chunk], s.distance, cancelled=flag)
        # One row at a time: a matrix product's bits may depend on how many rows it has.
        seen = {"backface": np.array([solid_angle[row].sum() for row in back], np.float32)}
        if s.keeps("visibility"):
            seen["visibility"] = moments_and_walls(distance, limits[chunk], units[chunk], s.visibility)
        if s.keeps("distance"):
            seen["distance"] = np.where(np.isfinite(distance), distance, s.miss_distance).astype(np.float32)
        if s.keeps("normal"):
            if s.normal != s.distance:
                _, normal, _, more = capture_distance(prepared.tracer, positions[chunk], s.normal, cancelled=flag)
                rays += more
            seen["normal"] = normal
        return seen, rays

    with ThreadPoolExecutor(threads) as pool:
        parts, counts = zip(*pool.map(look, range(0, max(len(positions), 1), _DISTANCE_CHUNK)), strict=True)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, sum(counts)


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
                prepared.selection,
                prepared.left_out,
                state,
                run.stopped,
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
    prepared = prepare(scene, spec, find)
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
