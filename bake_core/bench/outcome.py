"""What every measurement leaves behind: a table, the same as JSON and CSV, a plot, and a section of a page."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

from bake_core import __version__
from bake_core.bundle import dump_json
from bake_core.drawing import Colour, Drawing, Line, Place, Text, as_svg
from bake_core.embree import instruction_set
from bake_core.error_plot import INK, log_frame, ticks
from bake_core.errors import MachineError
from bake_core.images import write_drawing
from bake_core.rate import Rate

_WIDTH, _BOX = 720, (70.5, 30.5, 690.5, 400.5)
_LINE_HEIGHT = 20
# One line of JSON for every measurement that a folder has seen.
HISTORY = "history.jsonl"
# Okabe and Ito 2008, "Color Universal Design": told apart by colour-blind readers, too; their yellow is too pale for lines on white.
_COLOURS: tuple[Colour, ...] = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (0, 0, 0))


@dataclass(frozen=True)
class Series:
    """A curve in a plot: points, both coordinates above 0, and the law fitted to them."""

    name: str
    points: Sequence[tuple[float, float]]
    rate: Rate | None = None


class Outcome(Protocol):
    """What a measurement has to say of itself."""

    def document(self) -> dict[str, Any]: ...

    def rows(self) -> list[dict[str, Any]]:
        """Plain numbers, all with the same keys."""

    def table(self) -> list[tuple[str, ...]]:
        """Head and rows as people read them."""

    def notes(self) -> list[str]:
        """What the numbers are, a sentence or two each."""

    def plot(self) -> Drawing: ...


def write(outcome: Outcome, name: str, command: str, folder: Path, page: Path | None) -> None:
    """Write ``NAME.json``, ``.csv``, ``.md``, ``.svg`` and ``.png`` into a folder, and the table into a page.

    ``history.jsonl`` in the folder gets a line: when, where and with what version, and the rows of the CSV.

    Parameters
    ----------
    command : str
        What was run, for whoever wants to run it again.
    page : Path or None
        Markdown; see :func:`put_section`.

    Raises
    ------
    MachineError
        ``machine.cannot_write``.
    """
    rows, plot = outcome.rows(), outcome.plot()
    sheet = io.StringIO()
    writer = csv.DictWriter(sheet, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    section = as_markdown(outcome, command)
    machine = {
        "cores": os.cpu_count(),
        "processor": _processor(),
        "instruction_set": instruction_set(),
        "system": platform.system(),
        "python": platform.python_version(),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        document = {"bench": name, "version": __version__, "command": command, "machine": machine, **outcome.document()}
        (folder / f"{name}.json").write_bytes(dump_json(document))
        moment = datetime.now(UTC).isoformat(timespec="seconds")
        entry = {"at": moment, "bench": name, "version": __version__, "command": command, "machine": machine, "rows": rows}
        with open(folder / HISTORY, "a", encoding="utf-8") as history:
            history.write(json.dumps(entry) + "\n")
        (folder / f"{name}.csv").write_text(sheet.getvalue(), encoding="utf-8")
        (folder / f"{name}.md").write_text(section, encoding="utf-8")
        (folder / f"{name}.svg").write_text(as_svg(plot), encoding="utf-8")
        write_drawing(folder / f"{name}.png", plot)
        if page is not None:
            before = page.read_text(encoding="utf-8") if page.exists() else ""
            page.write_text(put_section(before, name, section), encoding="utf-8")
    except OSError as e:
        raise MachineError("machine.cannot_write", f"{e.strerror or e}; is there room on the disk?", str(e.filename or folder)) from e


def _processor() -> str:
    """As Linux calls it; elsewhere as Python does."""
    try:
        found = re.search(r"^model name\s*:\s*(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found.group(1) if found else platform.processor()


def as_text(table: Sequence[Sequence[str]]) -> str:
    """Columns under each other."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in table)


def as_markdown(outcome: Outcome, command: str) -> str:
    """A section of a page: the command, the machine, the table, what the numbers are."""
    head, *rows = outcome.table()
    lines = [f"    {command}", "", f"On {os.cpu_count()} threads of {_processor()}, octobake {__version__}.", ""]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join([*lines, "", *outcome.notes()]) + "\n"


def put_section(page: str, name: str, section: str) -> str:
    """A page with what stands between ``<!-- bench NAME -->`` and ``<!-- /bench NAME -->`` replaced, or added at its end."""
    begin, end = f"<!-- bench {name} -->\n", f"<!-- /bench {name} -->\n"
    before, found, rest = page.partition(begin)
    if not found:
        return page + ("\n" if page and not page.endswith("\n\n") else "") + begin + section + end
    _, _, after = rest.partition(end)
    return before + begin + section + end + after


def error_against_seconds(series: Sequence[Series]) -> Drawing:
    """Curves of error (1 is 100 %) against seconds."""
    return curves(series, "Error against seconds", "seconds", " %", 100)


def curves(series: Sequence[Series], title: str, across: str, unit: str = "", scale: float = 1) -> Drawing:
    """Curves with a legend below, both axes logarithmic; what is not above 0 has no place on them.

    Parameters
    ----------
    across, unit : str
        What the two axes show; `scale` takes values to that unit.
    """
    told = [(s, [(x, scale * y) for x, y in s.points if x > 0 and y > 0]) for s in series]
    shown = [(s, points) for s, points in told if points]
    height = int(_BOX[3]) + 66 + _LINE_HEIGHT * max(len(shown), 1)
    lines: list[Line] = []
    texts: list[Text] = []
    if not shown:
        texts.append(Text((_WIDTH / 2, height / 2), "nothing above 0 was measured", 13, INK, "middle"))
        return Drawing(_WIDTH, height, lines, texts)
    everything = [p for _, points in shown for p in points]
    at = log_frame(lines, texts, _BOX, ticks([x for x, _ in everything], 10), ticks([e for _, e in everything], 10), across, unit)
    texts.append(Text((_BOX[0], 20), title, 15, INK, "start"))
    for i, (s, points) in enumerate(shown):
        colour = _COLOURS[i % len(_COLOURS)]
        rate = s.rate
        if rate is not None and rate.slope is not None and rate.coefficient is not None and rate.points > 1:
            fit = [at(x, scale * rate.coefficient * x**rate.slope) for x in (points[0][0], points[-1][0])]
            if all(_inside(p) for p in fit):
                lines.append(Line(fit[0], fit[1], colour, 0.7))
        lines.extend(Line(at(*a), at(*b), colour, 2) for a, b in pairwise(points))
        lines.extend(Line(at(*a), at(*a), colour, 8) for a in points)
        y = _BOX[3] + 66 + _LINE_HEIGHT * i
        lines.append(Line((_BOX[0], y), (_BOX[0] + 24, y), colour, 3))
        fall = f", rate {rate.slope:.2f}" if rate is not None and rate.slope is not None else ""
        texts.append(Text((_BOX[0] + 34, y + 4), s.name + fall, 13, INK, "start"))
    return Drawing(_WIDTH, height, lines, texts)


def _inside(place: Place) -> bool:
    left, top, right, bottom = _BOX
    return all(map(math.isfinite, place)) and left <= place[0] <= right and top <= place[1] <= bottom
