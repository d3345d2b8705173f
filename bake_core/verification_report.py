"""What a verification leaves behind for people: pictures, and a page that shows them."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.comparison import LUMINANCE
from bake_core.images import write_exr, write_png
from bake_core.texture_tables import linear_to_srgb

F32 = NDArray[np.float32]

# This share of the reference's pixels is shown within the display's range; lamps and sunlit spots may clip.
EXPOSED = 0.97
# Of the reference (or of its mean, where that is less): the relative difference that the difference picture shows at full colour.
FULL_DIFFERENCE = 0.5
# Ways to weigh the same probes, in the receivers' part.
BESIDE = {"trilinear": "plain trilinear", "ddgi": "DDGI's weights"}
PARTS = ("whole", "indirect")


def write_pictures(folder: Path, name: str, part: str, picture: F32, reference: F32) -> dict[str, str]:
    """Write a picture, its reference and their difference as EXR (radiance) and PNG (for eyes, both with the reference's exposure).

    Returns
    -------
    dict of str to str
        ``raster``, ``path`` and ``difference``: file names without their endings.
    """
    stem = name if part == "whole" else f"{name}.{part}"
    exposure = exposure_for(reference)
    shown = {
        "raster": (picture, display(picture, exposure)),
        "path": (reference, display(reference, exposure)),
        "difference": (picture - reference, difference_picture(picture, reference)),
    }
    for kind, (radiance, pixels) in shown.items():
        write_exr(folder / f"{stem}.{kind}.exr", radiance, ("R", "G", "B"))
        write_png(folder / f"{stem}.{kind}.png", pixels)
    return {kind: f"{stem}.{kind}" for kind in shown}


def exposure_for(reference: F32) -> float:
    """What radiance is multiplied by, so that most of what is not black fits the display; 1 for a black picture."""
    luminance = reference @ LUMINANCE
    lit = luminance[luminance > 0]
    return 0.8 / float(np.quantile(lit, EXPOSED)) if lit.size else 1.0


def display(radiance: F32, exposure: float) -> NDArray[np.uint8]:
    """Radiance as sRGB bytes (IEC 61966-2-1)."""
    encoded = linear_to_srgb(np.clip(radiance.astype(np.float64) * exposure, 0, 1))
    return np.asarray(np.rint(encoded * 255), np.uint8)


def difference_picture(picture: F32, reference: F32) -> NDArray[np.uint8]:
    """Relative difference of luminance: white where there is none, red where the picture is too bright, blue where it is too dark."""
    a, b = picture.astype(np.float64) @ LUMINANCE, reference.astype(np.float64) @ LUMINANCE
    scale = np.maximum(b, b.mean())
    relative = np.divide(a - b, scale, out=np.sign(a - b), where=scale > 0)
    t = np.clip(relative / FULL_DIFFERENCE, -1, 1)[..., None]
    bright, dark = np.array([178, 24, 43]), np.array([33, 102, 172])
    return np.asarray(np.rint(255 + np.abs(t) * (np.where(t > 0, bright, dark) - 255)), np.uint8)


def page(report: dict[str, Any]) -> str:
    """The verification as a page beside its pictures."""
    verdict = "passed" if report["passed"] else "failed"
    blocks = []
    for camera in report["cameras"]:
        rows = "".join(
            f"<tr><th>{part}</th>" + "".join(f"<td>{number(camera[part][k])}</td>" for k in ("mean_ratio", "relmse", "flip")) + "</tr>"
            for part in PARTS
        )
        pictures = "".join(
            f"<figure><img src='{html.escape(camera['files'][part][kind])}.png' alt=''><figcaption>{part}, {words}</figcaption></figure>"
            for part in PARTS
            for kind, words in (("raster", "from the bundle"), ("path", "path-traced"), ("difference", "difference"))
        )
        failures = "".join(f"<li>{html.escape(f)}</li>" for f in camera["failures"])
        blocks.append(
            f"<h2>{html.escape(camera['name'])}</h2>"
            f"<table><tr><th></th><th>mean ratio</th><th>relMSE</th><th>HDR-FLIP</th></tr>{rows}</table>"
            f"<ul class=bad>{failures}</ul><div class=row>{pictures}</div>"
        )
    blocks.append(_receivers(report["receivers"]))
    if report["glossy"] is not None:
        blocks.append(_glossy(report["glossy"]))
    facts = f"{report['width']} × {report['height']}, {report['samples']} paths a pixel, {html.escape(report['device'])}"
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        "<title>octobake verification</title>"
        "<style>body{font:16px system-ui;max-width:110rem;margin:2rem auto;padding:0 1rem}td,th{padding:.2rem .8rem;text-align:right}"
        ".row{display:grid;grid-template-columns:repeat(3,1fr);gap:.5rem}figure{margin:0}img{width:100%;display:block}"
        "figcaption{color:#555;padding:.2rem 0 .6rem}.bad{color:#b2182b}</style>"
        f"<h1>Verification {verdict}</h1><p>{facts}. In difference pictures red is too bright and blue too dark; full colour is "
        f"{FULL_DIFFERENCE:.0%} of the reference.</p>{''.join(blocks)}</html>\n"
    )


def _receivers(figures: dict[str, Any]) -> str:
    """The block on irradiance at surface points."""
    columns = (("mean ratio", "mean_ratio"), ("relMSE", "relmse"), ("95th percentile", "p95"))
    failures = "".join(f"<li>{html.escape(f)}</li>" for f in figures["failures"])
    return (
        f"<h2>Irradiance at {figures['count']} surface points</h2><table><tr><th></th>"
        + "".join(f"<th>{title}</th>" for title, _ in columns)
        + "</tr>"
        + "".join(
            f"<tr><th>{html.escape(name)}</th>" + "".join(f"<td>{number(row[key])}</td>" for _, key in columns) + "</tr>"
            for name, row in [("receivers", figures), *((words, figures["beside"][way]) for way, words in BESIDE.items())]
        )
        + f"</table><ul class=bad>{failures}</ul><p>{html.escape(receiver_facts(figures))}.</p>"
    )


def _glossy(figures: dict[str, Any]) -> str:
    """The block on radiance along rays."""
    columns = (("mean ratio", "mean_ratio"), ("relMSE", "relmse"), ("95th percentile", "p95"))
    return (
        f"<h2>Radiance along {figures['count']} rays from surfaces</h2><table><tr><th></th>"
        + "".join(f"<th>{title}</th>" for title, _ in columns)
        + "</tr><tr><th>rays</th>"
        + "".join(f"<td>{number(figures[key])}</td>" for _, key in columns)
        + f"</tr></table><p>{html.escape(glossy_facts(figures))}.</p>"
    )


def glossy_facts(figures: dict[str, Any]) -> str:
    """What became of the rays, in a line."""
    rays = figures["rays"]
    return (
        f"{figures['count']} rays, {figures['samples']} paths along each; {100 * rays['agree']:.2f} % meet what they should, "
        f"{100 * rays['false_hits']:.2f} % are false hits, {100 * rays['unknown']:.2f} % unknown; "
        f"noise of the reference: relMSE {number(figures['reference_noise'])}"
    )


def receiver_facts(figures: dict[str, Any]) -> str:
    """How the receivers were come by, and how well their reference is known, in a line."""
    if not figures["count"]:
        return "no surface that can be seen lies within half a spacing of the volumes"
    left_out = figures["left_out"]
    return (
        f"{figures['count']} receivers, {figures['samples']} paths from each; left out: {left_out['behind']} behind surfaces, "
        f"{left_out['unseen']} seen by no probe; noise of the reference: relMSE {number(figures['reference_noise'])}, "
        f"95th percentile {number(figures['reference_p95'])}"
    )


def number(value: float | None) -> str:
    """A figure with four significant digits; a dash where there is none."""
    return "–" if value is None else f"{value:.4g}"
