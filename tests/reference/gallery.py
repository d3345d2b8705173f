"""Bakes and verifies the scenes that are handed out beside a checkout, and writes docs/gallery.md with what came out.

`python -m tests.reference.gallery [NAME ...]` runs the commands that the page shows, each as anyone would. Scenes that are not named keep
what the page's data say of them.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared"
OWN = Path(__file__).with_name("gallery")
PAGE = ROOT / "docs" / "gallery.md"
PICTURES = ROOT / "docs" / "images" / "gallery"
DATA = PICTURES / "figures.json"
SIZE = ["--width", "480", "--height", "270"]
# Of a verification's reference, where fewer than 128 paths a pixel are enough to look at, and more would take minutes.
SAMPLES = {"godot_zdm2": 64}

SCENES = {
    "rtxgi_furnace": "A white, double-sided slab under an even sky: every ray brings 1. From NVIDIA's RTXGI test harness, as the next two.",
    "rtxgi_cornell": "A single-sided Cornell box with the sun through its open front, and 9 × 9 × 9 probes, 30 cm apart.",
    "rtxgi_two_rooms": "A closed room beside one that the sun shines into through its door. Walls have an albedo of exactly 1.",
    "bevy_irradiance_volume": "Four coloured floors under an even sky, roughness 0.5, from Bevy's examples. The volume is the node "
    "`IrradianceVolume`, and hovers above them.",
    "godot_zdm2": "59,000 triangles in one mesh without a material, from Godot's demo: glTF's default is a white metal of roughness 1, "
    "which loses no light at all, so what the path tracer needs is patience.",
    "playcanvas_house": "A textured and cut-out house of half a metre, from PlayCanvas's examples. Probes stand 5 cm apart, "
    "leaves and railings are finer, and the figures say so.",
    "atrium": "289,000 triangles with vertex colours under sun and sky, with up along +Z, and 8 × 8 × 8 probes up to 3.6 m apart.",
}


def commands(name: str) -> list[list[str]]:
    """What the page says was run, from the repository's folder."""
    scene, own = f"../shared/scenes/{name}.glb", OWN.relative_to(ROOT)
    bake = ["octobake", "bake", scene, "--spec", f"../shared/specs/{name}.json", "-o", f"out/{name}"]
    verify = ["octobake", "verify", f"out/{name}", "--scene", scene, *SIZE]
    for option, kind in (("--camera", "cameras"), ("--thresholds", "thresholds")):
        if (OWN / f"{name}.{kind}.json").is_file():
            verify += [option, f"{own}/{name}.{kind}.json"]
    if name in SAMPLES:
        verify += ["--samples", str(SAMPLES[name])]
    return [bake, [*verify, "-o", f"out/{name}-verified"]]


def measure(name: str, work: Path) -> dict[str, Any]:
    """Run the commands in another folder; the figures that the page needs. Writes the pictures."""
    (work / "tests").symlink_to(ROOT / "tests") if not (work / "tests").exists() else None
    out = work / "out"
    out.mkdir(exist_ok=True)
    reports = []
    for command in commands(name):
        line = [a.replace("../shared", str(SHARED)) for a in command]
        print("$", " ".join(command), file=sys.stderr)
        done = subprocess.run(
            [str(Path(sys.executable).with_name("octobake")), *line[1:], "--json"], cwd=work, stdout=subprocess.PIPE, check=False
        )
        if done.returncode not in (0, 4, 5):
            raise SystemExit(f"{' '.join(command)} ended with {done.returncode}")
        reports.append((done.returncode, json.loads(done.stdout)))
    (baked, bake), (verified, verification) = reports
    PICTURES.mkdir(parents=True, exist_ok=True)
    cameras = []
    for camera in verification["cameras"]:
        files = camera["files"]["whole"]
        picture = f"{name}-{files['raster'].removesuffix('.raster')}.jpg"
        side_by_side([out / f"{name}-verified" / f"{files[kind]}.png" for kind in ("raster", "path", "difference")], PICTURES / picture)
        figures = {part: {k: camera[part][k] for k in ("mean_ratio", "relmse", "flip")} for part in ("indirect", "whole")}
        cameras.append({"name": camera["name"], "picture": picture, **figures})
    return {
        "bake": {"exit": baked, **{k: bake[k] for k in ("probes", "samples", "error", "seconds")}},
        "verify": {"exit": verified, "samples": verification["samples"], "seconds": verification["seconds"]},
        "cameras": cameras,
        "receivers": {k: verification["receivers"][k] for k in ("count", "left_out", "mean_ratio", "relmse", "p95", "reference_noise")},
    }


def side_by_side(files: list[Path], out: Path) -> None:
    """Pictures of one size as one, from left to right."""
    row = np.concatenate([np.asarray(oiio.ImageBuf(str(f)).get_pixels(oiio.UINT8))[..., :3] for f in files], 1)
    spec = oiio.ImageSpec(row.shape[1], row.shape[0], 3, oiio.UINT8)
    spec.attribute("Compression", "jpeg:90")
    writer = oiio.ImageOutput.create(str(out))
    if writer is None or not writer.open(str(out), spec) or not writer.write_image(np.ascontiguousarray(row)) or not writer.close():
        raise SystemExit(f"{out}: {oiio.geterror() if writer is None else writer.geterror()}")


def page(figures: dict[str, Any]) -> str:
    """docs/gallery.md."""
    lines = [
        "# Gallery",
        "",
        "Scenes from elsewhere, baked with their specs and verified. They lie beside a checkout, in `../shared`, and are no part of it. "
        "From left to right: rasterised with the bundle; path-traced without it; the difference (white is equal, red too bright, blue too "
        "dark, full colour is half of the reference). [Verification](verification.md) says what the figures mean. "
        "`python -m tests.reference.gallery` wrote this page, by the commands that stand in it; the seconds are those of two cores that "
        "others used too.",
        "",
        "The limits that a verification is held to unless it is given others are the Cornell box's. Where a scene has more detail than its "
        "probes can know of, its own limits stand in `tests/reference/gallery/`, close to what was measured, so that a worse picture "
        "fails. They tighten.",
    ]
    for name, words in SCENES.items():
        if name not in figures:
            continue
        f = figures[name]
        baked, r = f["bake"], f["receivers"]
        verdict = "passed" if f["verify"]["exit"] == 0 else "failed"
        lines += ["", f"## {name}", "", words, "", *(f"    {' '.join(c)}" for c in commands(name)), ""]
        lines.append(
            f"{baked['probes']:,} probes, {baked['samples']} samples, error {100 * baked['error']:.2g} %, {baked['seconds']:.0f} s; "
            f"verification {verdict}, {f['verify']['samples']} paths a pixel, {f['verify']['seconds']:.0f} s."
        )
        lines += ["", "| | mean ratio | relMSE | HDR-FLIP | 95th percentile |", "|---|---|---|---|---|"]
        for camera in f["cameras"]:
            for part in ("indirect", "whole"):
                c = camera[part]
                lines.append(f"| {camera['name']}, {part} | {number(c['mean_ratio'])} | {number(c['relmse'])} | {number(c['flip'])} | |")
        lines.append(f"| {r['count']} receivers | {number(r['mean_ratio'])} | {number(r['relmse'])} | | {number(r['p95'])} |")
        for camera in f["cameras"]:
            lines += ["", f"![{name}, {camera['name']}: rasterised, path-traced, difference](images/gallery/{camera['picture']})"]
    return "\n".join(lines) + "\n"


def number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def main(names: list[str]) -> int:
    unknown = [n for n in names if n not in SCENES]
    if unknown:
        print(f"no such scene: {', '.join(unknown)}; there are {', '.join(SCENES)}", file=sys.stderr)
        return 2
    figures = json.loads(DATA.read_text()) if names and DATA.is_file() else {}
    for name in names or SCENES:
        with tempfile.TemporaryDirectory() as work:
            figures[name] = measure(name, Path(work))
        DATA.write_text(json.dumps({n: figures[n] for n in SCENES if n in figures}, indent=1) + "\n")
    PAGE.write_text(page(figures), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
