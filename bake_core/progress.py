"""How long work says how far it has come: a plain callback, so that nothing below depends on a terminal or a server."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """One report of a running bake.

    Attributes
    ----------
    stage : str
        ``reading``, ``compiling``, ``building``, ``tracing`` or ``writing``.
    fraction : float
        Of the whole bake, in [0, 1]; never falls.
    samples : int
        Samples per capture texel so far.
    error : float or None
        The bake's error so far (DESIGN: a relative RMS, 95 % upper bound), None before the first pass has ended.
    seconds : float
        Since the bake began.
    eta : float or None
        Seconds to go, None while unknown.
    """

    stage: str
    fraction: float
    samples: int = 0
    error: float | None = None
    seconds: float = 0.0
    eta: float | None = None


ProgressCallback = Callable[[Progress], None]
