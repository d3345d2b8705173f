"""A bake's curve as a picture: error against samples and against seconds of tracing, both axes logarithmic."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

from bake_core.convergence import Point
from bake_core.drawing import Colour, Drawing, Line, Place, Text
from bake_core.rate import Rate, in_words

_WIDTH, _HEIGHT = 960, 420
# Of one of the two panels: where its frame lies; on the middles of pixels, so that it is sharp.
_LEFT, _RIGHT, _TOP, _BOTTOM = 70.5, 450.5, 56.5, 360.5
INK: Colour = (32, 32, 32)
_GRID: Colour = (225, 225, 225)
_CURVE: Colour = (0, 90, 181)
_FIT: Colour = (220, 50, 32)
_TARGET: Colour = (120, 120, 120)
# Labels along an axis before they touch each other.
_MOST_LABELS = 7


def error_plot(curve: Sequence[Point], target: float | None, by_samples: Rate, by_seconds: Rate | None, began: float | None) -> Drawing:
    """Two panels beside each other.

    Parameters
    ----------
    curve : sequence of Point
        Points whose error is unknown or 0 have no place on a logarithmic axis and are left out.
    target : float or None
        The error that was asked for.
    by_samples, by_seconds : Rate
        Drawn as lines; the second is None where `began` is.
    began : float or None
        When tracing began, on the curve's clock; None where that is not known: then seconds are those since the bake began.
    """
    lines: list[Line] = []
    texts: list[Text] = []
    told = [(p, 100 * p.error) for p in curve if p.error is not None and p.error > 0]
    errors = [e for _, e in told] + ([100 * target] if target is not None else [])
    samples, seconds = [float(p.samples) for p, _ in told], [p.seconds - (began or 0.0) for p, _ in told]
    for shift, rate, across, label, base in (
        (0, by_samples, samples, "samples", 2),
        (_WIDTH // 2, by_seconds, seconds, "seconds" if began is None else "seconds of tracing", 10),
    ):
        texts.append(Text((_LEFT + shift, 24), f"Error against {label}", 15, INK, "start"))
        texts.append(Text((_LEFT + shift, 43), f"rate {in_words(rate)}", 13, _FIT if rate and rate.slope is not None else INK, "start"))
        places = [(x, e) for x, (_, e) in zip(across, told, strict=True) if x > 0]
        if not places:
            texts.append(Text(((_LEFT + _RIGHT) / 2 + shift, (_TOP + _BOTTOM) / 2), "no error above 0 was measured", 13, INK, "middle"))
            continue
        _panel(lines, texts, shift, places, errors, rate, None if target is None else 100 * target, label, base)
    return Drawing(_WIDTH, _HEIGHT, lines, texts)


def _panel(
    lines: list[Line],
    texts: list[Text],
    shift: float,
    places: Sequence[tuple[float, float]],
    errors: Sequence[float],
    rate: Rate | None,
    target: float | None,
    label: str,
    base: int,
) -> None:
    box = (_LEFT + shift, _TOP, _RIGHT + shift, _BOTTOM)
    at = log_frame(lines, texts, box, ticks([x for x, _ in places], base), ticks(errors, 10), label)
    if target is not None:
        height = at(places[0][0], target)[1]
        lines.append(Line((box[0], height), (box[2], height), _TARGET, 1.5))
        # To the left, where the curve is still above it.
        texts.append(Text((box[0] + 6, height - 5), f"target {target:g} %", 12, _TARGET, "start"))
    if rate is not None and rate.slope is not None and rate.coefficient is not None:
        first, last = (at(x, 100 * rate.coefficient * x**rate.slope) for x in (places[0][0], places[-1][0]))
        lines.append(Line(first, last, _FIT, 1.5))
    lines.extend(Line(at(*a), at(*b), _CURVE, 2) for a, b in pairwise(places))
    lines.extend(Line(at(*a), at(*a), _CURVE, 8) for a in places)


def log_frame(
    lines: list[Line],
    texts: list[Text],
    box: tuple[float, float, float, float],
    x_ticks: Sequence[float],
    y_ticks: Sequence[float],
    label: str,
    unit: str = " %",
) -> Callable[[float, float], Place]:
    """Draw a frame with a grid and numbers.

    Parameters
    ----------
    lines, texts : list
        Added to.
    box : (left, top, right, bottom)
        Pixels.
    x_ticks, y_ticks : sequence of float
        From :func:`ticks`.
    unit : str
        Of what goes upwards.

    Returns
    -------
    callable
        From a pair of values to a place on the page.
    """
    left, top, right, bottom = box
    x_low, x_high, y_low, y_high = x_ticks[0], x_ticks[-1], y_ticks[0], y_ticks[-1]

    def at(x: float, y: float) -> Place:
        across, up = math.log(x / x_low) / math.log(x_high / x_low), math.log(y / y_low) / math.log(y_high / y_low)
        return left + across * (right - left), bottom - up * (bottom - top)

    for x in x_ticks:
        lines.append(Line(at(x, y_low), at(x, y_high), _GRID, 1))
    for y in y_ticks:
        lines.append(Line(at(x_low, y), at(x_high, y), _GRID, 1))
    every = math.ceil(len(x_ticks) / _MOST_LABELS)
    for x in x_ticks[::every]:
        texts.append(Text((at(x, y_low)[0], bottom + 19), f"{x:g}", 12, INK, "middle"))
    for y in y_ticks:
        texts.append(Text((left - 8, at(x_low, y)[1] + 4), f"{y:g}{unit}", 12, INK, "end"))
    texts.append(Text(((left + right) / 2, bottom + 42), label, 13, INK, "middle"))
    corners = [at(x_low, y_low), at(x_high, y_low), at(x_high, y_high), at(x_low, y_high), at(x_low, y_low)]
    lines.extend(Line(a, b, INK, 1) for a, b in pairwise(corners))
    return at


def ticks(values: Sequence[float], base: int) -> list[float]:
    """Where an axis has its lines: the first and the last are its ends, with all values between them.

    Parameters
    ----------
    values : sequence of float
        All above 0.
    base : int
        2: powers of two. 10: powers of ten, or 1, 2, 5, 10, … where they span no more than two decades.
    """
    low, high = min(values), max(values)
    if base == 2:
        first, last = math.floor(math.log2(low)), math.ceil(math.log2(high))
        return [2.0**k for k in range(first, max(last, first + 1) + 1)]
    steps = (1, 2, 5) if high <= 100 * low else (1,)
    # A hair beyond the ends: a logarithm of 1000 in floating point is a little less than 3.
    first, last = math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1
    every = [float(f"{m}e{k}") for k in range(first, last + 1) for m in steps]
    below = max(i for i, t in enumerate(every) if t <= low)
    above = min(i for i, t in enumerate(every) if t >= high)
    return every[below : max(above, below + 1) + 1]
