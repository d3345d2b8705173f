"""``octobake trace-check``: a bundle's light field beside Embree, ray by ray, and what spacing and resolution have to do with it."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.bundle import Bundle, content_digest, dump_json
from bake_core.drawing import as_svg
from bake_core.environment import Find, read_environment
from bake_core.errors import BundleError, InputError
from bake_core.images import write_drawing
from bake_core.light_field import Traces, light_field, trace
from bake_core.scene import Scene
from bake_core.spec import SMALLEST_RESOLUTION, parse_spec
from bake_core.trace_check import FOOTPRINTS, compare_traces, draw_rays
from bake_core.trace_picture import picture
from bake_core.trace_shader import trace_on_device
from bake_core.trace_variants import looked_again, thinned
from bake_core.tracer import Tracer
from bake_core.volume_chains import traceable
from bake_core.vulkan import Device

RAYS = 20000
REPORT = "trace-check.json"
_SEED = 0x7ACE
# Beside the bundle itself: every second and every fourth probe, and maps of a quarter of its texels along a side to twice as many.
_STEPS = (1, 2, 4)
_SCALES = (1 / 4, 1 / 2, 1, 2)
# More texels along the side of an atlas than every device takes.
_LARGEST_ATLAS = 16384
_COLUMNS = ("agree", "false_hits", "late_hits", "false_misses", "unknown")


def trace_check(
    bundle: Bundle,
    scene: Scene,
    *,
    rays: int = RAYS,
    find: Find,
    tell: Callable[[str], None] = lambda what: None,
    cancelled: NDArray[np.uint8] | None = None,
) -> dict[str, Any]:
    """Trace the same rays by Embree, by the Python twin and by GLSL, through the bundle and through variants of it.

    Returns
    -------
    dict
        ``rays``, ``device`` and ``rows``; each row has ``volumes`` (spacing and probes of each), ``spacing`` (how many times the bundle's),
        ``resolution``, ``bundle`` (whether it is the bundle as it stands), and under ``python`` and ``glsl`` an
        :class:`bake_core.trace_check.Agreement`.

    Raises
    ------
    BundleError
        ``bundle.other_scene``, ``bundle.not_traceable``.
    InputError
        ``trace_check.no_surfaces``
    MachineError
        ``vulkan.*``
    Cancelled
    """
    if bundle.manifest["scene"]["digest"] != scene.digest:
        digest = bundle.manifest["scene"]["digest"]
        raise BundleError("bundle.other_scene", f"was baked from {digest}, this scene is {scene.digest}; give that scene", str(bundle.path))
    if not traceable(bundle.volumes) or "irradiance" not in bundle.volumes[0].atlases:
        what = "irradiance, radiance, distance and normal"
        raise BundleError("bundle.not_traceable", f'lacks some of {what}; bake it with all of these in "outputs"', str(bundle.path))
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    spec = parse_spec(bundle.manifest["spec"], f"{bundle.path}: spec")
    tracer = Tracer.build(scene, spec, read_environment(spec.environment, find)[0])
    tell("drawing rays")
    drawn = draw_rays(scene, tracer, bundle.volumes, rays, _SEED, cancelled=flag)
    if not len(drawn.distance):
        raise InputError("trace_check.no_surfaces", "no surface lies inside the volumes that their probes see", str(bundle.path))
    own = bundle.volumes[0].atlases["distance"].interior
    rows = []
    before = 0
    for step in _STEPS:
        sparse = thinned(bundle.volumes, step)
        probes = sum(len(v.states) for v in sparse)
        if probes == before or not all((v.states == 1).any() for v in sparse):
            continue
        before = probes
        across = max(max(v.atlases["distance"].columns, v.atlases["distance"].rows) for v in sparse)
        for scale in _SCALES:
            side = round(own * scale) // 2 * 2
            if side < SMALLEST_RESOLUTION or across * (side + 2) > _LARGEST_ATLAS:
                continue
            tell(f"{step} × the spacing, {side} × {side} texels")
            volumes = sparse if scale == 1 else looked_again(tracer, sparse, side, flag)
            found: dict[str, Traces] = {"python": trace(light_field(volumes), drawn.origins, drawn.directions)}
            # One for each, as nothing that is made on a device goes before it does.
            with Device() as device:
                found["glsl"] = trace_on_device(device, volumes, drawn.origins, drawn.directions, scene.origin)
                name = device.name
            rows.append(
                {
                    "spacing": step,
                    "resolution": side,
                    "bundle": step == 1 and scale == 1,
                    "volumes": [{"name": v.name, "spacing": v.spacing.tolist(), "probes": int((v.states == 1).sum())} for v in volumes],
                    **{who: asdict(compare_traces(volumes, drawn, traces)) for who, traces in found.items()},
                }
            )
    return {
        "bundle": content_digest(dump_json(bundle.manifest)),
        "scene": scene.digest,
        "rays": len(drawn.distance),
        "misses": float(np.isinf(drawn.distance).mean()),
        "footprints": FOOTPRINTS,
        "device": name,
        "rows": rows,
    }


def table(report: dict[str, Any]) -> list[tuple[str, ...]]:
    """Rows of words, the first of them the heads."""
    heads = ("spacing", "texels", "by", "agree", "false hits", "late hits", "false misses", "unknown", "error", "p95", "probes")
    out: list[tuple[str, ...]] = [heads]
    for row in report["rows"]:
        for who in ("python", "glsl"):
            a = row[who]
            shares = [f"{100 * a[name]:.2f} %" for name in _COLUMNS]
            probes = f"{a['probes']:.2f}" if who == "python" else ""
            mark = " *" if row["bundle"] else ""
            first = (f"× {row['spacing']}{mark}", f"{row['resolution']}²", who)
            out.append((*first, *shares, f"{a['error']:.3g} m", f"{a['p95']:.3f}", probes))
    return out


def write_report(report: dict[str, Any], out: Path) -> Path:
    """Write ``trace-check.json``, ``.svg``, ``.png`` and ``index.html`` into a folder, which is made where it is not there."""
    out.mkdir(parents=True, exist_ok=True)
    drawing = picture(report)
    (out / REPORT).write_bytes(dump_json(report))
    svg = as_svg(drawing)
    (out / "trace-check.svg").write_text(svg, encoding="utf-8")
    write_drawing(out / "trace-check.png", drawing)
    rows = table(report)
    cells = "\n".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows[1:])
    head = "".join(f"<th>{html.escape(c)}</th>" for c in rows[0])
    facts = f"{report['rays']} rays from surfaces, {100 * report['misses']:.1f} % of which meet nothing. * is the bundle."
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>trace-check</title><style>body{font:15px sans-serif;margin:2em}'
        "td,th{padding:.2em .8em;text-align:right}svg{max-width:720px}</style>\n"
        f"<h1>Ray by ray</h1><p>{facts}</p>\n"
        f"{svg}<table><tr>{head}</tr>\n{cells}</table></html>\n"
    )
    (out / "index.html").write_text(page, encoding="utf-8")
    return out / "index.html"
