"""The table in docs/method.md is what its command prints."""

from __future__ import annotations

import re
from pathlib import Path

from tests.closed_form.resolution_table import CASES, RESOLUTIONS, table

PAGE = Path(__file__).resolve().parents[2] / "docs" / "method.md"


def figures(text: str) -> dict[str, list[float]]:
    """By the name of a row: the closed form and the deviations in percent."""
    found = {}
    for line in text.splitlines():
        name, *cells = (c.strip() for c in line.strip("|").split("|"))
        if name in {case[0] for case in CASES}:
            found[name] = [float(re.sub("[ %]", "", c)) for c in cells]
    return found


def test_what_resolution_costs() -> None:
    documented, measured = figures(PAGE.read_text(encoding="utf-8")), figures(table())
    assert documented.keys() == measured.keys() and len(measured) == len(CASES)
    for name, row in measured.items():
        # Deterministic within an instruction set; another one's rounding may move a figure by its last digit.
        assert all(abs(a - b) < 0.02 for a, b in zip(row, documented[name], strict=True)), name
        eight, sixteen, thirty_two = (abs(c) for c in row[1 : 1 + len(RESOLUTIONS)])
        assert 0.3 < eight < 1.25 and sixteen < 0.5 and thirty_two < 0.25
