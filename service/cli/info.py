"""``octobake info``: what is in a bundle, what was left out and why, error against time."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("info", help="what is in a bundle, what was left out and why, error against time")
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="a folder or a zip")
    parser.add_argument("--json", action="store_true", help="print manifest, report and content digest as one JSON document")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print it."""
    from bake_core.bundle import content_digest, dump_json, read_bundle, read_report

    manifest, report = read_bundle(args.bundle).manifest, read_report(args.bundle)
    digest = content_digest(dump_json(manifest))
    if args.json:
        print(json.dumps({"content_digest": digest, "manifest": manifest, "report": report}, indent=2))
    else:
        print("\n".join(_lines(manifest, report, digest)))
    return 0


def _lines(manifest: dict[str, Any], report: dict[str, Any] | None, digest: str) -> list[str]:
    from bake_core.rate import Rate, in_words
    from bake_core.report import audit_in_words, audit_of, chosen_in_words, integrator_in_words, percent, places_in_words
    from service.cli.plan import left_out_lines
    from service.cli.progress import count

    error = manifest["error"]
    size = sum(f["bytes"] for f in manifest["files"].values())
    lines = [
        f"bundle     {digest}",
        f"made by    {manifest['generator']} on {manifest['instruction_set']}",
        f"scene      {manifest['scene']['digest']}, {manifest['scene']['triangles']} triangles",
        f"samples    {manifest['samples']}, stopped by {manifest['stopped']}",
        # What was made of pictures has traced none.
        *([f"paths      {integrator_in_words(manifest)}"] if manifest["samples"] else []),
        f"error      {percent(error['value'])} (target {percent(error['target'])}), sampling only",
        f"size       {size} bytes",
    ]
    for v in manifest["volumes"]:
        probes = v["probes"]
        counts, inside, unneeded = "×".join(map(str, v["counts"])), probes["states"].count(0), probes["states"].count(2)
        none_asks = f", {unneeded} needed by no surface" if unneeded else ""
        lines.append(f"volume     {v['name']}: {counts} probes, {probes['active']} active, {inside} inside geometry{none_asks}")
        for a in v["atlases"]:
            cost, file = percent(a["encoding_error"]), a["file"] or "no file, all texels are the same"
            lines.append(f"  {a['output']:<11}{a['interior']}² texels, stored as {a['encoding']}, which costs {cost}: {file}")
        if probes.get("tried") is not None:
            lines.append(f"  {'places':<11}{places_in_words(probes)}")
        if v.get("chosen") is not None:
            lines.append(f"  {'weights':<11}{chosen_in_words(v['parameters'], v['chosen'])}")
    lines += left_out_lines(manifest["left_out"])
    lines += [f"ignored    {line}" for line in manifest["scene"]["ignored"]]
    if report is not None:
        lines += ["", f"{'samples':>9}{'rays':>9}{'seconds':>10}{'error':>10}"]
        lines += [f"{p['samples']:>9}{count(p['rays']):>9}{p['seconds']:>10.2f}{percent(p['error']):>10}" for p in report["curve"]]
        rates = {name: rate and Rate(**rate) for name, rate in report["rate"].items()}
        audit = audit_of(report)
        if audit is not None:
            lines += ["", f"audit      {audit_in_words(audit)}"]
        lines += ["", *(f"rate       {in_words(rate)}, against {name}" for name, rate in rates.items())]
    return lines
