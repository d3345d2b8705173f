"""The report of a bake: everything that was measured in time, as JSON for programs and as a page for people."""

from __future__ import annotations

import html
import os
import platform
from pathlib import Path
from typing import Any

from bake_core.bundle import dump_json


def write(folder: Path, manifest: dict[str, Any], digest: str, run: dict[str, Any]) -> None:
    """Write ``report.json`` and ``report.html``.

    Parameters
    ----------
    folder : Path
        The bundle's.
    manifest : dict
    digest : str
        The bundle's content digest.
    run : dict
        threads, shards, curve (samples, seconds, error), stopped, seconds, stages.
    """
    document = {
        "content_digest": digest,
        "generator": manifest["generator"],
        "instruction_set": manifest["instruction_set"],
        "machine": {"cores": os.cpu_count(), "system": platform.system(), "python": platform.python_version()},
        "error": manifest["error"],
        "samples": manifest["samples"],
        **run,
    }
    (folder / "report.json").write_bytes(dump_json(document))
    (folder / "report.html").write_text(_page(manifest, document), encoding="utf-8")


def percent(error: float | None) -> str:
    """An error as people read it; a dash where none could be measured."""
    return "–" if error is None else f"{100 * error:.2f} %"


def _page(manifest: dict[str, Any], document: dict[str, Any]) -> str:
    probes = sum(v["probes"]["count"] for v in manifest["volumes"])
    active = sum(v["probes"]["active"] for v in manifest["volumes"])
    facts = {
        "error": f"{percent(manifest['error']['value'])} (target {percent(manifest['error']['target'])})",
        "stopped by": manifest["stopped"],
        "samples": manifest["samples"],
        "probes": f"{probes}, {active} of them active",
        "seconds": f"{document['seconds']:.1f}",
        "scene": manifest["scene"]["digest"],
        "bundle": document["content_digest"],
    }
    atlases = [
        (v["name"], a["output"], a["encoding"], percent(a["encoding_error"]), a["file"]) for v in manifest["volumes"] for a in v["atlases"]
    ]
    curve = [(p["samples"], f"{p['seconds']:.2f}", percent(p["error"])) for p in document["curve"]]
    left_out = [(x["what"], x["why"]) for x in manifest["left_out"]]
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><title>octobake report</title>"
        "<style>body{font:16px system-ui;max-width:60rem;margin:2rem auto;padding:0 1rem}table{border-collapse:collapse;margin:1rem 0}"
        "td,th{padding:.2rem .8rem;border-bottom:1px solid #ccc;text-align:left}</style><h1>Bake report</h1>"
        + _table((), facts.items())
        + "<h2>Error against time</h2>"
        + _table(("samples", "seconds", "error"), curve)
        + "<h2>Atlases</h2>"
        + _table(("volume", "output", "stored as", "cost of storing", "file"), atlases)
        + "<h2>Left out</h2>"
        + (_table(("what", "why"), left_out) if left_out else "<p>Nothing.</p>")
        + "</html>\n"
    )


def _table(head: tuple[str, ...], rows: Any) -> str:
    cells = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{cells}</tr>{body}</table>"
