"""Lines and words on a page, as SVG and as pixels: all that a plot needs."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
# Red, green, blue of the screen, 0 to 255.
Colour = tuple[int, int, int]
Place = tuple[float, float]


@dataclass(frozen=True)
class Line:
    """A straight line with round ends, or where both ends are one place a dot."""

    start: Place
    end: Place
    colour: Colour
    width: float


@dataclass(frozen=True)
class Text:
    """Words; `place` is on the base line, `anchor` (``start``, ``middle``, ``end``) says which part of them stands there."""

    place: Place
    words: str
    size: float
    colour: Colour
    anchor: str


@dataclass(frozen=True)
class Drawing:
    """Places are in pixels, x to the right and y down from the upper left corner; later lines lie over earlier ones, words over all."""

    width: int
    height: int
    lines: Sequence[Line]
    texts: Sequence[Text]


def as_svg(drawing: Drawing) -> str:
    """An SVG element, complete as a file of its own."""
    marks = [
        f'<line x1="{_number(a.start[0])}" y1="{_number(a.start[1])}" x2="{_number(a.end[0])}" y2="{_number(a.end[1])}" '
        f'stroke="{_hex(a.colour)}" stroke-width="{_number(a.width)}"/>'
        for a in drawing.lines
    ]
    marks += [
        f'<text x="{_number(t.place[0])}" y="{_number(t.place[1])}" font-size="{_number(t.size)}" fill="{_hex(t.colour)}" '
        f'text-anchor="{t.anchor}">{html.escape(t.words)}</text>'
        for t in drawing.texts
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {drawing.width} {drawing.height}" width="{drawing.width}" '
        f'height="{drawing.height}" font-family="sans-serif" stroke-linecap="round">\n'
        f'<rect width="{drawing.width}" height="{drawing.height}" fill="#ffffff"/>\n' + "\n".join(marks) + "\n</svg>\n"
    )


def lines_as_pixels(drawing: Drawing) -> F64:
    """The lines on white, (height, width, 3) in [0, 1], their edges smoothed; :func:`bake_core.images.write_drawing` adds the words."""
    pixels = np.ones((drawing.height, drawing.width, 3))
    for line in drawing.lines:
        # A pixel is covered by what of its own width lies within the line's.
        reach = line.width / 2 + 1
        low = np.floor(np.minimum(line.start, line.end) - reach).astype(int).clip(0)
        high = np.ceil(np.maximum(line.start, line.end) + reach).astype(int)
        box = pixels[low[1] : high[1], low[0] : high[0]]
        y, x = np.mgrid[low[1] : low[1] + box.shape[0], low[0] : low[0] + box.shape[1]] + 0.5
        along = np.subtract(line.end, line.start)
        t = ((x - line.start[0]) * along[0] + (y - line.start[1]) * along[1]) / max(float(along @ along), 1e-12)
        t = t.clip(0, 1)
        distance = np.hypot(x - line.start[0] - t * along[0], y - line.start[1] - t * along[1])
        cover = (line.width / 2 + 0.5 - distance).clip(0, min(1.0, line.width))[..., None]
        box += cover * (np.array(line.colour) / 255 - box)
    return pixels


def _number(x: float) -> str:
    return f"{x:.2f}".rstrip("0").rstrip(".")


def _hex(colour: Colour) -> str:
    return "#" + bytes(colour).hex()
