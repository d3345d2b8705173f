"""What an irradiance resolution costs, where the answer is known: `python -m tests.closed_form.resolution_table` prints the table.

A query between texel centres interpolates; at 8×8 texels that alone takes light away where irradiance is curved. The table in
docs/method.md is this one.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from bake_core.examples import Example, plane_under_sun, square_emitter, square_emitter_irradiance
from bake_core.irradiance import sample
from tests.baking import bake_example

RESOLUTIONS = (8, 16, 32)
# Name, scene, point, normal, irradiance there in closed form.
CASES: tuple[tuple[str, Example, tuple[float, ...], tuple[float, ...], float], ...] = (
    ("a sun over a plane, facing down", plane_under_sun(albedo=0.5, irradiance=3.0), (0, 1, 0), (0, -1, 0), 0.5 * 3.0 * 0.8),
    ("a unit square from 1 m, facing it", square_emitter(2.0), (0, 0, 0), (1, 0, 0), square_emitter_irradiance(2.0)),
    ("its mirrored twin, facing it", square_emitter(2.0), (0, 0, 0), (-1, 0, 0), square_emitter_irradiance(2.0)),
)


def costs(example: Example, point: tuple[float, ...], normal: tuple[float, ...], expected: float) -> list[float]:
    """Relative deviation from the closed form at each of RESOLUTIONS, with 256 samples."""
    found = []
    for resolution in RESOLUTIONS:
        with tempfile.TemporaryDirectory() as folder:
            bundle = bake_example(Path(folder), example, resolution={"irradiance": resolution})
            e = sample(bundle.volumes, np.array([point]), np.array([normal])).irradiance[0]
        found.append(float(e[0]) / expected - 1)
    return found


def table() -> str:
    """A Markdown table, in percent."""
    lines = ["| | closed form |" + "".join(f" {r}×{r} |" for r in RESOLUTIONS), "|---|---|" + "---|" * len(RESOLUTIONS)]
    for name, example, point, normal, expected in CASES:
        cells = "".join(f" {100 * c:+.2f} % |" for c in costs(example, point, normal, expected))
        lines.append(f"| {name} | {expected:.4f} |{cells}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
