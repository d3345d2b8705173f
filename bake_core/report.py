"""The report of a bake: everything that was measured in time, as JSON for programs, as a page and as a plot for people."""

from __future__ import annotations

import html
import os
import platform
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bake_core.audit import Audit, Figures
from bake_core.bundle import dump_json
from bake_core.convergence import Point, Verdict
from bake_core.drawing import as_svg
from bake_core.error_plot import error_plot
from bake_core.images import write_drawing
from bake_core.rate import Rate, in_words, rate_by_samples, rate_by_seconds


@dataclass
class Run:
    """What happened in time: goes into the report, never into the manifest.

    Attributes
    ----------
    began : float or None
        Seconds before the first ray; None where the bake was resumed, for then its seconds have a gap.
    """

    threads: int
    shards: int
    began: float | None = None
    curve: list[Point] = field(default_factory=list)
    stopped: Verdict = "continue"
    seconds: float = 0.0
    stages: dict[str, float] = field(default_factory=dict)
    audit: Audit | None = None

    def rates(self) -> tuple[Rate, Rate | None]:
        """How fast the error fell, against samples and against seconds of tracing."""
        return rate_by_samples(self.curve), None if self.began is None else rate_by_seconds(self.curve, self.began)


def write(folder: Path, manifest: dict[str, Any], digest: str, run: Run) -> None:
    """Write ``report.json``, ``report.html``, ``report.svg`` and ``report.png``.

    Parameters
    ----------
    folder : Path
        The bundle's.
    manifest : dict
    digest : str
        The bundle's content digest.
    run : Run
    """
    by_samples, by_seconds = run.rates()
    document = {
        "content_digest": digest,
        "generator": manifest["generator"],
        "instruction_set": manifest["instruction_set"],
        "machine": {"cores": os.cpu_count(), "system": platform.system(), "python": platform.python_version()},
        "error": manifest["error"],
        "samples": manifest["samples"],
        "sampling": manifest["sampling"],
        **asdict(run),
        "rate": rate_json(run),
    }
    plot = error_plot(run.curve, manifest["error"]["target"], by_samples, by_seconds, run.began)
    svg = as_svg(plot)
    (folder / "report.json").write_bytes(dump_json(document))
    (folder / "report.svg").write_text(svg, encoding="utf-8")
    write_drawing(folder / "report.png", plot)
    (folder / "report.html").write_text(_page(manifest, document, run, svg), encoding="utf-8")


def rate_json(run: Run) -> dict[str, Any]:
    """Both rates as ``report.json`` has them: null for seconds that have a gap."""
    by_samples, by_seconds = run.rates()
    return {"samples": asdict(by_samples), "seconds": None if by_seconds is None else asdict(by_seconds)}


def percent(error: float | None) -> str:
    """An error as people read it; a dash where none could be measured."""
    return "–" if error is None else f"{100 * error:.2f} %"


def _page(manifest: dict[str, Any], document: dict[str, Any], run: Run, plot: str) -> str:
    probes = sum(v["probes"]["count"] for v in manifest["volumes"])
    active = sum(v["probes"]["active"] for v in manifest["volumes"])
    facts = {
        "error": f"{percent(manifest['error']['value'])} (target {percent(manifest['error']['target'])})",
        "stopped by": manifest["stopped"],
        "samples": _samples(manifest),
        "probes": f"{probes}, {active} of them active",
        "seconds": f"{document['seconds']:.1f}",
        "scene": manifest["scene"]["digest"],
        "bundle": document["content_digest"],
    }
    atlases = [
        (v["name"], a["output"], a["encoding"], percent(a["encoding_error"]), a["file"] or "none: constant")
        for v in manifest["volumes"]
        for a in v["atlases"]
    ]
    curve = [(p["samples"], f"{p['rays']:,}", f"{p['seconds']:.2f}", percent(p["error"])) for p in document["curve"]]
    fitted = [(f"against {name}", in_words(rate)) for name, rate in zip(("samples", "seconds of tracing"), run.rates(), strict=True)]
    outputs = [(x["output"], _output_error(x["value"])) for x in manifest["error"]["outputs"]]
    worst = [
        (p["volume"], p["probe"], ", ".join(f"{x:.4g}" for x in p["position"]), percent(p["error"]))
        for p in manifest["error"]["probes"]["worst"]
    ]
    left_out = [(x["what"], x["why"], f"{x['bytes']:,} bytes" if "bytes" in x else "time") for x in manifest["left_out"]]
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><title>octobake report</title>"
        "<style>body{font:16px system-ui;max-width:60rem;margin:2rem auto;padding:0 1rem}table{border-collapse:collapse;margin:1rem 0}"
        "td,th{padding:.2rem .8rem;border-bottom:1px solid #ccc;text-align:left}svg{max-width:100%;height:auto}</style><h1>Bake report</h1>"
        + _table((), facts.items())
        + "<h2>Error against time</h2>"
        + plot
        + _table(("samples", "rays", "seconds", "error"), curve)
        + "<p>How fast the error falls: the slope of its logarithm, and its standard error. Independent samples have -0.5.</p>"
        + _table((), fitted)
        + "<h2>Error by output and by probe</h2>"
        + _table(("output", "95 % bound of the relative RMS"), outputs)
        + f"<p>Standard error of a probe: median {percent(manifest['error']['probes']['median'])}, "
        + f"95th percentile {percent(manifest['error']['probes']['p95'])}. The largest:</p>"
        + _table(("volume", "probe", "position", "standard error"), worst)
        + _audited(run.audit)
        + "<h2>Atlases</h2>"
        + _table(("volume", "output", "stored as", "cost of storing", "file"), atlases)
        + "<h2>Left out</h2>"
        + (_table(("what", "why", "saves"), left_out) if left_out else "<p>Nothing.</p>")
        + "</html>\n"
    )


def _samples(manifest: dict[str, Any]) -> str:
    """How many, and what it saved to give easy probes fewer."""
    mean, uniform = manifest["sampling"]["mean_samples"], manifest["sampling"]["uniform_samples"]
    if mean >= manifest["samples"] or uniform is None:
        return str(manifest["samples"])
    return f"{manifest['samples']} at most, {mean:.0f} on average; the same error takes {uniform:.0f} if every probe gets as many"


def audit_of(report: dict[str, Any]) -> Audit | None:
    """The audit in a ``report.json``, as it was written from."""
    told = report.get("audit")
    if told is None:
        return None
    texels = {output: Figures(**figures) for output, figures in told["texels"].items()}
    return Audit(**{**told, "texels": texels, "surfaces": None if told["surfaces"] is None else Figures(**told["surfaces"])})


def chosen_in_words(parameters: dict[str, float], chosen: dict[str, Any]) -> str:
    """What a manifest says of a volume's query: its parameters, and what they were chosen by."""
    bias, floor, fade = (parameters[k] for k in ("normal_bias", "visibility_floor", "visibility_softness"))
    here, default = (percent(max(chosen[k], 0.0) ** 0.5) for k in ("error", "default_error"))
    measured = f"error {here} at {chosen['points']} points on surfaces"
    return f"bias {bias:g}, floor {floor:g}, fade {fade:g}: {measured}" + ("" if here == default else f", {default} by default")


def integrator_in_words(manifest: dict[str, Any]) -> str:
    """Where a manifest's paths ended."""
    # Bundles of before had no cache.
    cached = manifest["sampling"].get("cached")
    return (
        "traced to their ends" if cached is None else f"ended in the light cache, which knew {percent(cached)} of what probes see at first"
    )


def places_in_words(probes: dict[str, Any]) -> str:
    """What a manifest says of where a volume's probes stand, and what that was decided by."""
    tried = probes["tried"]
    near, lattice = (percent(max(tried[k], 0.0) ** 0.5) for k in ("error", "lattice_error"))
    points = f"{tried['points']} points on surfaces"
    if probes["offsets"] is None:
        return f"on the lattice: error {lattice} at {points}, {near} nearer to walls"
    return f"nearer to walls: error {near} at {points}, {lattice} on the lattice"


def audit_in_words(audit: Audit) -> str:
    """One line: what was looked at, and what came of it."""
    said = []
    f = audit.texels.get("irradiance")
    if f is not None:
        said.append(
            f"{f.places} irradiance texels err by {percent(f.error)} ({percent(f.low)} to {percent(f.high)}): "
            f"sampling {percent(f.sampling)}, filtering {percent(f.filtering)}, encoding {percent(f.encoding)}"
        )
    if audit.surfaces is not None:
        s = audit.surfaces
        said.append(f"answers at {s.places} surface points by {percent(s.error)}, bias {100 * s.bias:+.2f} ± {percent(s.bias_within)}")
    stated = "" if audit.stated is None else f": the stated {percent(audit.stated)} is {audit.verdict}"
    return "; ".join(said) + stated


def _audited(audit: Audit | None) -> str:
    if audit is None:
        return "<h2>Audit</h2><p>None.</p>"
    head = ("", "places", "paths each", "error", "95 % interval", "sampling", "filtering", "encoding", "bias")

    def row(name: str, f: Figures) -> tuple[str, ...]:
        parts = (percent(x) for x in (f.sampling, f.filtering, f.encoding))
        interval = f"{percent(f.low)} to {percent(f.high)}"
        return (
            name,
            str(f.places),
            str(2 * f.paths),
            percent(f.error),
            interval,
            *parts,
            f"{100 * f.bias:+.2f} ± {percent(f.bias_within)}",
        )

    rows = [row(f"{output} texels", f) for output, f in audit.texels.items()]
    if audit.surfaces is not None:
        rows.append(row("answers at surfaces, between probes", audit.surfaces))
    return (
        f"<h2>Audit</h2><p>In {audit.seconds:.1f} s, by paths that know nothing of how the bundle was made: the stated error of "
        f"{percent(audit.stated)} is <b>{audit.verdict}</b>. Sampling error at surfaces: at most {percent(audit.surface_bound)}.</p>"
        + _table(head, rows)
    )


def _output_error(error: float | None) -> str:
    return "not sampled: rays through texel centres" if error is None else percent(error)


def _table(head: tuple[str, ...], rows: Any) -> str:
    cells = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{cells}</tr>{body}</table>"
