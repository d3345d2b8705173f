"""Verification: what a renderer shows with a bundle, beside what a path tracer shows without one."""

from __future__ import annotations

import itertools
import math
import re
import shutil
import time
import uuid
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.automatic_cameras import automatic_cameras
from bake_core.bundle import Bundle, content_digest, dump_json
from bake_core.comparison import Figures, compare
from bake_core.environment import Find, Sky, look_up_sky, no_images, read_environment
from bake_core.errors import BundleError, InputError
from bake_core.irradiance import covered
from bake_core.picture import Picture, path_trace_picture
from bake_core.progress import Progress, ProgressCallback
from bake_core.published_weights import ddgi, trilinear
from bake_core.raster import Rasterizer
from bake_core.ray_radiance import measure_radiance
from bake_core.receiver_comparison import compare_receivers, measure_receivers
from bake_core.scene import Camera, Scene
from bake_core.spec import Spec, parse_spec
from bake_core.thresholds import Thresholds
from bake_core.trace_check import compare_traces
from bake_core.tracer import Tracer
from bake_core.verification_report import PARTS, page, write_pictures
from bake_core.volume_chains import traceable
from bake_core.vulkan import Device

REPORT = "verification.json"
RECEIVERS = "receivers.json"
# Defaults of every way to ask for a verification: the reference's noise is kept out of the figures, so these are for eyes.
WIDTH, HEIGHT, SAMPLES = 640, 360, 128
LARGEST_SIDE, MOST_SAMPLES = 8192, 1 << 20
# The two halves of the reference.
_SEEDS = (0x0C70BA4E, 0x0C70BA4F)
# From each receiver, for one a pixel: 2,048 receivers take a seventh of what the default picture does, and their noise stays out of sight.
_PATHS_PER_SAMPLE = 16
# Along each ray that leaves a surface: half of the time of the receivers, whose paths are one vertex longer.
_PATHS_PER_RAY = 8
# Along each side of a pixel that shows sky.
_SKY_POINTS = 4


def verify(
    bundle: Bundle,
    scene: Scene,
    cameras: Sequence[Camera] | None,
    out: Path,
    *,
    width: int = WIDTH,
    height: int = HEIGHT,
    samples: int = SAMPLES,
    threads: int = 1,
    thresholds: Thresholds | None = None,
    find: Find = no_images,
    progress: ProgressCallback | None = None,
    cancelled: NDArray[np.uint8] | None = None,
) -> dict[str, Any]:
    """Render a scene with its bundle and path-traced, compare, and write pictures and a report.

    1. Check that the bundle is this scene's.
    2. Choose cameras: those given, else the glTF's own, else automatic ones.
    3. For each camera, rasterise on Vulkan with the bundle's probes, and path-trace two halves of the reference.
    4. Compare the indirect part and the whole, hold the figures against the thresholds.
    5. Do the same with the bundle's irradiance at thousands of surface points, and with radiance along rays where it has that.
    6. Write everything into a folder beside `out`, and put that in its place.

    Parameters
    ----------
    out : Path
        A folder. One that exists is replaced only if it holds a verification or nothing.
    samples : int
        Paths a pixel of the reference, both halves together; even. Sixteen times as many from each surface point.
    thresholds : Thresholds, optional
        Default: those of :class:`Thresholds`.
    find : callable, optional
        Where the image of the sky lies, where the bake had one.
    cancelled : (1,) uint8, optional
        Set from any thread to stop.

    Returns
    -------
    dict
        The report, as written to ``verification.json``; ``passed`` says whether every threshold is kept.

    Raises
    ------
    BundleError
        ``bundle.other_scene``, ``bundle.no_irradiance``.
    InputError
        ``verification.invalid``, ``verification.in_the_way``; as :func:`bake_core.environment.read_environment` for an image of the sky.
    MachineError
        ``vulkan.*`` where this machine cannot rasterise.
    Cancelled
    """
    started = time.perf_counter()
    thresholds = thresholds or Thresholds()
    _check_request(width, height, samples, out)
    spec = _check_bundle(bundle, scene)
    tell = _Teller(progress)
    tell("building", 0.0)
    tracer = Tracer.build(scene, spec, read_environment(spec.environment, find)[0])
    work = out.with_name(f".{out.name}.{uuid.uuid4().hex}")
    work.mkdir()
    try:
        with Device() as device:
            rasterizer = Rasterizer(device, scene, tracer.lights, tracer.tables.environment, bundle.volumes, tracer.tables.textures)
            if not cameras:
                cameras = scene.cameras or automatic_cameras(rasterizer, scene, bundle.volumes)
            entries = []
            parts = len(cameras) + 1
            for i, (camera, name) in enumerate(zip(cameras, _file_names(cameras), strict=True)):
                begun = time.perf_counter()
                raster = rasterizer.render(camera, width, height)
                if tracer.tables.sky is not None:
                    raster = _before(raster, tracer.tables.sky, camera)
                rastered = time.perf_counter()
                halves = _halves(tracer, camera, width, height, samples, spec, threads, tell.part(i, parts), cancelled)
                seconds = {"raster": rastered - begun, "path": time.perf_counter() - rastered}
                inside = _inside(rasterizer, bundle, camera, width, height)
                entries.append(_entry(work, camera, name, raster, halves, inside, thresholds, seconds))
            name = device.name
        receivers = _receivers(work, bundle, scene, tracer, samples, thresholds, threads, tell.part(len(cameras), parts), cancelled)
        glossy = _glossy(bundle, scene, tracer, samples, threads, cancelled) if traceable(bundle.volumes) else None
        tell("writing", 1.0)
        report: dict[str, Any] = {
            "passed": not any(e["failures"] for e in [*entries, receivers]),
            "failures": [f"{e['name']}: {failure}" for e in entries for failure in e["failures"]]
            + [f"receivers: {failure}" for failure in receivers["failures"]],
            "scene": scene.digest,
            "bundle": content_digest(dump_json(bundle.manifest)),
            "width": width,
            "height": height,
            "samples": samples,
            "device": name,
            "thresholds": thresholds.model_dump(mode="json"),
            "cameras": entries,
            "receivers": receivers,
            "glossy": glossy,
            "seconds": time.perf_counter() - started,
        }
        (work / REPORT).write_bytes(dump_json(report))
        (work / "index.html").write_text(page(report), encoding="utf-8")
        _publish(work, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return report


def _before(raster: Picture, sky: Sky, camera: Camera) -> Picture:
    """A picture with the sky where it shows nothing: even points of every pixel, as the rasteriser leaves it black."""
    height, width = raster.hit.shape
    half = math.tan(camera.yfov / 2)
    steps = (np.arange(_SKY_POINTS) + 0.5) / _SKY_POINTS
    behind = np.zeros((height * width, 3))
    for v, u in itertools.product(steps, steps):
        x = ((np.arange(width) + u) / width * 2 - 1) * half * width / height
        y = (1 - (np.arange(height) + v) / height * 2) * half
        rays = np.stack(np.broadcast_arrays(x, y[:, None], -1.0), -1).reshape(-1, 3) @ camera.matrix[:3, :3].T
        behind += look_up_sky(sky, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    seen = (behind / len(steps) ** 2).reshape(height, width, 3) * (1 - raster.hit[..., None])
    return replace(raster, emission=(raster.emission + seen).astype(np.float32))


def _check_request(width: int, height: int, samples: int, out: Path) -> None:
    for name, side in (("width", width), ("height", height)):
        if not 16 <= side <= LARGEST_SIDE:
            raise InputError("verification.invalid", f"must be from 16 to {LARGEST_SIDE}", name)
    if not 2 <= samples <= MOST_SAMPLES or samples % 2:
        raise InputError("verification.invalid", f"must be an even number from 2 to {MOST_SAMPLES}: two halves are compared", "samples")
    if not out.parent.is_dir():
        raise InputError("verification.in_the_way", "the folder that it should go into does not exist; create it", str(out))
    if out.exists() and not (out.is_dir() and (not any(out.iterdir()) or (out / REPORT).is_file())):
        raise InputError("verification.in_the_way", "exists and is not a verification; give another name or remove it", str(out))


def _check_bundle(bundle: Bundle, scene: Scene) -> Spec:
    digest = bundle.manifest["scene"]["digest"]
    if digest != scene.digest:
        raise BundleError("bundle.other_scene", f"was baked from {digest}, this scene is {scene.digest}; give that scene", str(bundle.path))
    if not all("irradiance" in v.atlases for v in bundle.volumes):
        raise BundleError("bundle.no_irradiance", "holds no irradiance to light a picture with; bake it with that output", str(bundle.path))
    return parse_spec(bundle.manifest["spec"], f"{bundle.path}: spec")


def _file_names(cameras: Sequence[Camera]) -> list[str]:
    """A camera's name as a file's, different for each."""
    names: list[str] = []
    for i, camera in enumerate(cameras):
        plain = re.sub(r"[^A-Za-z0-9_-]+", "-", camera.name).strip("-") or f"camera{i}"
        names.append(f"{plain}-{i}" if plain in names else plain)
    return names


def _halves(
    tracer: Tracer,
    camera: Camera,
    width: int,
    height: int,
    samples: int,
    spec: Spec,
    threads: int,
    progress: ProgressCallback,
    cancelled: NDArray[np.uint8] | None,
) -> tuple[Picture, Picture]:
    # A probe's ray stands for the ray that leaves a surface, so the picture's paths scatter once more than the probes'.
    bounces = None if spec.max_bounces is None else spec.max_bounces + 1

    def half(k: int) -> Picture:
        def tell(p: Progress) -> None:
            progress(Progress("tracing", (k + p.fraction) / 2, samples))

        return path_trace_picture(
            tracer,
            camera,
            width,
            height,
            samples=samples // 2,
            seed=_SEEDS[k],
            max_bounces=bounces,
            threads=threads,
            progress=tell,
            cancelled=cancelled,
        )

    return half(0), half(1)


def _inside(rasterizer: Rasterizer, bundle: Bundle, camera: Camera, width: int, height: int) -> NDArray[np.bool_]:
    """Pixels that may count, (height, width): all but those whose centre shows a surface that the volumes do not reach."""
    _, points = rasterizer.glimpse(camera, width, height)
    return covered(bundle.volumes, points.reshape(-1, 3)).reshape(height, width) | np.isnan(points[..., 0])


def _entry(
    work: Path,
    camera: Camera,
    name: str,
    raster: Picture,
    halves: tuple[Picture, Picture],
    inside: NDArray[np.bool_],
    thresholds: Thresholds,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """One camera's part of the report; writes its pictures."""
    surface = (raster.hit > 0) | (halves[0].hit > 0) | (halves[1].hit > 0)
    counted = surface & inside
    figures: dict[str, Figures] = {}
    files: dict[str, dict[str, str]] = {}
    for part in PARTS:
        picture, first, second = (getattr(p, part) for p in (raster, *halves))
        figures[part] = compare(picture, (first, second), counted)
        files[part] = write_pictures(work, name, part, picture, (first + second) / 2)
    return {
        "name": camera.name or name,
        "position": camera.matrix[:3, 3].tolist(),
        "direction": (-camera.matrix[:3, 2]).tolist(),
        "yfov": camera.yfov,
        "surface": float(surface.mean()),
        "counted": float(counted.mean()),
        **{part: asdict(f) for part, f in figures.items()},
        "failures": thresholds.failures(figures),
        "files": files,
        "seconds": seconds,
    }


def _receivers(
    work: Path,
    bundle: Bundle,
    scene: Scene,
    tracer: Tracer,
    samples: int,
    thresholds: Thresholds,
    threads: int,
    progress: ProgressCallback,
    cancelled: NDArray[np.uint8] | None,
) -> dict[str, Any]:
    """The report's part on irradiance at surface points; writes the points."""
    begun = time.perf_counter()
    paths = _PATHS_PER_SAMPLE * samples
    done = 0.0

    def advance(share: float) -> None:
        nonlocal done
        done += share
        progress(Progress("tracing", min(done, 1.0), samples))

    receivers, answers, estimates = measure_receivers(
        scene, tracer, bundle.volumes, samples=paths, threads=threads, advance=advance, cancelled=cancelled
    )
    figures = compare_receivers(answers, estimates)
    # What the same probes would have answered by others' weights.
    others = {"trilinear": trilinear, "ddgi": ddgi}
    beside = {
        name: compare_receivers(ask(bundle.volumes, receivers.positions, receivers.normals), estimates) for name, ask in others.items()
    }
    columns = {"position": receivers.positions, "normal": receivers.normals, "irradiance": answers, "reference": estimates.mean(0)}
    rows = [{key: column[i].tolist() for key, column in columns.items()} for i in range(len(receivers))]
    (work / RECEIVERS).write_bytes(dump_json(rows))
    return {
        "count": len(receivers),
        "left_out": {"behind": receivers.behind, "unseen": receivers.unseen},
        "samples": paths,
        **asdict(figures),
        "beside": {name: {"mean_ratio": f.mean_ratio, "relmse": f.relmse, "p95": f.p95} for name, f in beside.items()},
        "failures": thresholds.receivers.failures(figures),
        "seconds": time.perf_counter() - begun,
    }


def _glossy(
    bundle: Bundle, scene: Scene, tracer: Tracer, samples: int, threads: int, cancelled: NDArray[np.uint8] | None
) -> dict[str, Any]:
    """The report's part on radiance along rays that leave surfaces: what a mirror shows."""
    begun = time.perf_counter()
    paths = _PATHS_PER_RAY * samples
    rays, traces, answers, estimates = measure_radiance(scene, tracer, bundle.volumes, samples=paths, threads=threads, cancelled=cancelled)
    return {
        "count": len(answers),
        "samples": paths,
        **asdict(compare_receivers(answers, estimates)),
        "rays": asdict(compare_traces(bundle.volumes, rays, traces)),
        "seconds": time.perf_counter() - begun,
    }


def _publish(work: Path, out: Path) -> None:
    """Put the finished folder in its place; a verification that stood there goes away."""
    if out.exists():
        old = work.with_name(work.name + ".old")
        out.replace(old)
        work.replace(out)
        shutil.rmtree(old)
    else:
        work.replace(out)


class _Teller:
    """Reports fractions of the whole from fractions of its parts."""

    def __init__(self, callback: ProgressCallback | None) -> None:
        self._callback, self._started = callback, time.perf_counter()

    def __call__(self, stage: str, fraction: float, samples: int = 0) -> None:
        if self._callback is not None:
            seconds = time.perf_counter() - self._started
            eta = seconds / fraction * (1 - fraction) if fraction > 0.02 else None
            self._callback(Progress(stage, fraction, samples, None, seconds, eta))

    def part(self, i: int, count: int) -> ProgressCallback:
        return lambda p: self("tracing", (i + p.fraction) / count * 0.99, p.samples)
