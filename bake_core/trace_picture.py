"""The picture of a trace-check: how rays go wrong against spacing and map resolution, a panel for each way."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from bake_core.drawing import Colour, Drawing, Line, Text
from bake_core.error_plot import INK, log_frame, ticks

# Of a panel: its frame's size, and how far panels are apart; the first frame's corner is on the middle of a pixel, so that it is sharp.
_PANEL, _PITCH, _FIRST = (210, 170), (310, 280), (70.5, 86.5)
_COLOURS: tuple[Colour, ...] = ((0, 90, 181), (220, 50, 32), (120, 120, 120))


def _of_rays(name: str) -> Callable[[dict[str, Any], str], float]:
    return lambda row, who: 100 * float(row[who][name])


def _apart(row: dict[str, Any], who: str) -> float:
    spacing: float = min(side for volume in row["volumes"] for side in volume["spacing"]) / row["spacing"]
    return 100 * float(row[who]["error"]) / spacing


_PANELS: tuple[tuple[str, Callable[[dict[str, Any], str], float]], ...] = (
    ("Disagree with Embree", lambda row, who: 100 * (1 - float(row[who]["agree"]))),
    ("False hits", _of_rays("false_hits")),
    ("Late hits", _of_rays("late_hits")),
    ("False misses", _of_rays("false_misses")),
    ("Unknown", _of_rays("unknown")),
    ("Hits' error, of the spacing", _apart),
)


def picture(report: dict[str, Any]) -> Drawing:
    """Six panels of logarithmic axes over texels along a side, a colour for each spacing: lines for Python, dots for GLSL.

    What is 0 has no place on such an axis and is left out.
    """
    lines: list[Line] = []
    texts = [Text((_FIRST[0], 24), "Rays beside Embree's, by maps and spacing (lines: Python, dots: GLSL)", 15, INK, "start")]
    steps = sorted({row["spacing"] for row in report["rows"]})
    for i, step in enumerate(steps):
        first = next(row for row in report["rows"] if row["spacing"] == step)
        probes = sum(v["probes"] for v in first["volumes"])
        texts.append(Text((_FIRST[0] + 150 * i, 46), f"× {step}: {probes} probes", 13, _COLOURS[i % len(_COLOURS)], "start"))
    for k, (title, value) in enumerate(_PANELS):
        left, top = _FIRST[0] + k % 3 * _PITCH[0], _FIRST[1] + k // 3 * _PITCH[1]
        box = (left, top, left + _PANEL[0], top + _PANEL[1])
        texts.append(Text((left, top - 10), title, 13, INK, "start"))
        told = [(row, who, value(row, who)) for row in report["rows"] for who in ("python", "glsl")]
        told = [t for t in told if t[2] > 0]
        if not told:
            texts.append(Text((left + _PANEL[0] / 2, top + _PANEL[1] / 2), "none", 13, INK, "middle"))
            continue
        across = ticks([row["resolution"] for row in report["rows"]], 2)
        at = log_frame(lines, texts, box, across, ticks([y for _, _, y in told], 10), "texels along a side")
        for i, step in enumerate(steps):
            colour = _COLOURS[i % len(_COLOURS)]
            places = {
                w: [at(row["resolution"], y) for row, who, y in told if who == w and row["spacing"] == step] for w in ("python", "glsl")
            }
            lines += [Line(a, b, colour, 2) for a, b in pairwise(places["python"])] + [Line(a, a, colour, 7) for a in places["glsl"]]
    return Drawing(3 * _PITCH[0] + 20, 2 * _PITCH[1] + 50, lines, texts)
