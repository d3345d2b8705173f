"""The plot of error against time: its axes, its marks at the right places, the same in SVG and PNG."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import OpenImageIO as oiio
import pytest

from bake_core.convergence import Point
from bake_core.drawing import Drawing, Line, Text, as_svg, lines_as_pixels
from bake_core.error_plot import error_plot, ticks
from bake_core.images import write_drawing
from bake_core.rate import rate_by_samples, rate_by_seconds

SVG = "{http://www.w3.org/2000/svg}"
CURVE = [Point(16 * 2**k, 0, 2 + 2.0**k, 0.16 / 2**k) for k in range(4)]


def plot(curve: list[Point], target: float | None = 0.02, began: float | None = 2.0) -> Drawing:
    by_seconds = None if began is None else rate_by_seconds(curve, began)
    return error_plot(curve, target, rate_by_samples(curve), by_seconds, began)


def words(drawing: Drawing) -> list[str]:
    return [t.words for t in drawing.texts]


@pytest.mark.parametrize(
    ("values", "base", "expected"),
    [
        ([16, 256], 2, [16, 32, 64, 128, 256]),
        ([16], 2, [16, 32]),
        ([16, 100], 2, [16, 32, 64, 128]),
        ([1.9, 12.0], 10, [1, 2, 5, 10, 20]),
        ([2.0, 10.0], 10, [2, 5, 10]),
        ([5.0], 10, [5, 10]),
        ([0.001, 1000.0], 10, [0.001, 0.01, 0.1, 1, 10, 100, 1000]),
        ([1e-30, 1e-30], 10, [1e-30, 2e-30]),
    ],
)
def test_ticks_span_the_values_and_are_round(values: list[float], base: int, expected: list[float]) -> None:
    assert ticks(values, base) == expected


def test_points_stand_where_their_figures_say() -> None:
    """Doubling samples and seconds, halving errors: equal steps along both axes, of which the ends are known."""
    drawing = plot(CURVE)
    dots = [a.start for a in drawing.lines if a.start == a.end]
    left, right = np.array(dots[:4]), np.array(dots[4:])
    for panel in (left, right):
        np.testing.assert_allclose(np.diff(panel, axis=0), np.broadcast_to(panel[1] - panel[0], (3, 2)), atol=1e-9)
    # 16 to 128 samples fill the axis, 1 to 8 seconds that from 1 to 10; 16 % to 2 % that from 20 % to 2 %.
    assert left[0, 0] == 70.5 and left[3, 0] == 450.5 and left[3, 1] == 360.5
    assert left[0, 1] == pytest.approx(360.5 - 304 * math.log(8) / math.log(10))
    assert right[0, 0] == 550.5 and right[3, 0] == pytest.approx(550.5 + 380 * math.log10(8))
    told = words(drawing)
    assert told.count("target 2 %") == 2 and told.count("rate -1.00 ± 0.00") == 2 and "128" in told and "seconds of tracing" in told


def test_what_is_not_known_is_said() -> None:
    assert words(plot([])).count("no error above 0 was measured") == 2
    one = words(plot([Point(2, 0, 1.0, None), Point(16, 0, 3.0, 0.1)], None))
    assert one.count("rate cannot be told from one point with an error above 0") == 2 and "target 2 %" not in one
    resumed = words(plot(CURVE, began=None))
    assert "rate cannot be told: its seconds are not of tracing alone" in resumed and "seconds of tracing" not in resumed


def test_the_svg_is_well_formed_and_whole() -> None:
    drawing = Drawing(40, 30, [Line((1, 2.5), (3, 4), (255, 0, 16), 1.5)], [Text((5, 6), "a < b & ±", 12, (0, 0, 0), "end")])
    root = ElementTree.fromstring(as_svg(drawing))
    (line,), (text,) = root.iter(SVG + "line"), root.iter(SVG + "text")
    assert root.get("viewBox") == "0 0 40 30" and line.get("y1") == "2.5" and line.get("stroke") == "#ff0010"
    assert text.text == "a < b & ±" and text.get("text-anchor") == "end"


def test_a_line_covers_the_pixels_that_it_lies_on() -> None:
    """Its ink is its area, wherever it lies; and a place off the page is cut off."""
    for start, end in (((5.0, 8.0), (25.0, 8.0)), ((5.3, 8.7), (22.1, 17.9))):
        ink = (1 - lines_as_pixels(Drawing(32, 24, [Line(start, end, (0, 0, 0), 3)], []))[..., 0]).sum()
        # Round ends: half a disc each.
        assert ink == pytest.approx(3 * math.dist(start, end) + math.pi * 1.5**2, rel=0.03)
    assert lines_as_pixels(Drawing(8, 8, [Line((-5, -5), (20, 20), (0, 0, 0), 1)], [])).shape == (8, 8, 3)


def test_the_png_shows_the_same(tmp_path: Path) -> None:
    drawing = plot(CURVE)
    write_drawing(tmp_path / "plot.png", drawing)
    pixels = np.asarray(oiio.ImageBuf(str(tmp_path / "plot.png")).get_pixels(oiio.UINT8))
    assert pixels.shape == (drawing.height, drawing.width, 3) and tuple(pixels[0, 0]) == (255, 255, 255)
    for dot in (a for a in drawing.lines if a.start == a.end):
        assert tuple(pixels[int(dot.start[1]), int(dot.start[0])]) == dot.colour
    # Words, too: dark pixels where the title begins.
    title = drawing.texts[0]
    x, y = (int(a) for a in title.place)
    assert (pixels[y - 10 : y, x : x + 100] < 100).any()
