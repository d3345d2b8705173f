"""`octobake demo`: everything once, as a build farm would do it: a service, a client, a bake, a verification, pictures."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
import zipfile
from pathlib import Path
from typing import Any


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = commands.add_parser("demo", help="serve, bake and verify a Cornell box, and show the figures")
    parser.add_argument("-o", "--out", metavar="DIR", type=Path, default=Path("out/demo"), help="default out/demo")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the demo; 4 where the bake missed its target, 5 where a threshold is not kept."""
    from bake_core.examples import cornell
    from service.cli.alone import service_alone
    from service.cli.remote import connect, exit_code, follow

    out: Path = args.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    glb, spec = cornell()
    (out / "cornell.glb").write_bytes(glb)
    (out / "cornell.json").write_text(json.dumps(spec, indent=2) + "\n")
    # What `kill` sends must go through `finally`, too, or the service would outlive this.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    began = time.monotonic()
    with service_alone(out) as url, connect(url) as client:
        _say(f"service at {url}")
        scene = client.add_scene(out / "cornell.glb")
        _say(f"scene {scene.digest[:19]}…: {scene.triangles} triangles; baking it")
        bake = follow(client, client.submit(scene.digest, spec, labels={"demo": "cornell"}))
        bundle = client.fetch(bake, out / "cornell.zip")
        _say("verifying: rasterised on Vulkan with the bundle's probes, beside a path-traced twin")
        # Half the default samples: the figures leave the noise of the path-traced twin out, so this only makes its picture grainier.
        verification = follow(client, client.verify(bake, samples=64))
        pictures = [p for p in client.fetch_files(verification, out / "verification") if p.suffix in (".png", ".html")]
    assert bake.result is not None and verification.result is not None, "follow() returns jobs that have succeeded"
    print(_table(bundle, bake.result, verification.result["report"], time.monotonic() - began))
    print(f"\nbundle    {bundle}")
    for picture in pictures:
        print(f"picture   {picture}")
    return exit_code(bake) or exit_code(verification)


def _table(bundle: Path, result: dict[str, Any], report: dict[str, Any], seconds: float) -> str:
    """Probes, samples, error, seconds; then each threshold with what was measured."""
    from bake_core.verification_report import PARTS, number
    from service.cli.progress import duration, percent

    receivers, named = report["receivers"], {"mean ratio": "mean_ratio", "relMSE": "relmse", "95th percentile": "p95"}
    with zipfile.ZipFile(bundle) as archive:
        manifest = json.loads(archive.read("manifest.json"))
    rows: list[tuple[str, ...]] = [
        ("probes", str(sum(v["probes"]["count"] for v in manifest["volumes"]))),
        ("samples", str(result["samples"])),
        ("error", "unknown" if result["error"] is None else percent(result["error"])),
        ("bake", duration(result["seconds"])),
        (f"{receivers['count']} surface points", ", ".join(f"{name} {number(receivers[key])}" for name, key in named.items())),
        ("verification", f"{duration(report['seconds'])} on {report['device']}"),
        ("everything", duration(seconds)),
    ]
    limits: list[tuple[str, ...]] = [("camera", "part", "figure", "measured", "threshold", "verdict")]
    for name, part, figures in [(camera["name"], part, camera[part]) for camera in report["cameras"] for part in PARTS]:
        for figure, limit in report["thresholds"][part].items():
            if limit is not None:
                measured = figures[figure]
                low, high = limit if isinstance(limit, list) else (None, limit)
                kept = measured is not None and measured <= high and (low is None or measured >= low)
                shown = "none" if measured is None else f"{measured:.4f}"
                wish = f"≤ {high:g}" if low is None else f"{low:g} to {high:g}"
                limits.append((name, part, figure, shown, wish, "pass" if kept else "FAIL"))
    return f"\n{_columns(rows)}\n\n{_columns(limits)}"


def _columns(rows: list[tuple[str, ...]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def _say(text: str) -> None:
    print(f"demo: {text}", file=sys.stderr, flush=True)
