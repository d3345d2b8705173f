"""Lines of a property, what was measured and its goal."""

from __future__ import annotations

from typing import Protocol


class Say(Protocol):
    """Tells a figure: `value` is to be at most `goal`."""

    def __call__(self, what: str, value: float, goal: float, unit: str) -> None:
        """One line."""


class Table:
    """Prints each figure as it comes; counts those that miss their goal."""

    def __init__(self) -> None:
        self.missed = 0
        print(f"{'property':<62}{'measured':>12}{'goal':>12}", flush=True)

    def __call__(self, what: str, value: float, goal: float, unit: str) -> None:
        """One line."""
        self.missed += not value <= goal
        print(f"{what:<62}{value:>9.3f} {unit:<2}{goal:>9g} {unit:<2}", flush=True)
