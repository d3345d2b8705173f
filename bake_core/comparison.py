"""How far one picture is from another: mean ratio, relMSE, HDR-FLIP. docs/verification.md defines them for a reader."""

from __future__ import annotations

import math
from dataclasses import dataclass

import flip_evaluator
import numpy as np
from numpy.typing import NDArray

from bake_core.relmse import RELMSE_FLOOR

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class Figures:
    """What one part of a picture is like beside its reference, over pixels that show a surface (FLIP: over all pixels).

    Attributes
    ----------
    mean : float
        Of the picture's channels.
    reference_mean : float
    mean_ratio : float or None
        mean / reference_mean; 1 where both are black, None where only the reference is.
    relmse : float or None
        Free of the reference's noise, so that it may come out a little below 0. None where only the reference is black.
    reference_noise : float
        relMSE of the reference itself, from the difference of its halves: what was kept out of `relmse`.
    flip : float
        Mean HDR-FLIP, in [0, 1].
    """

    mean: float
    reference_mean: float
    mean_ratio: float | None
    relmse: float | None
    reference_noise: float
    flip: float


def compare(picture: F32, halves: tuple[F32, F32], surface: NDArray[np.bool_]) -> Figures:
    """Compare a picture with two independent renderings of its reference.

    Parameters
    ----------
    picture : (h, w, 3) float32
        Radiance.
    halves : two (h, w, 3) float32
        Radiance, with independent noise.
    surface : (h, w) bool
        Pixels that count.

    Notes
    -----
    relMSE = mean of (a - b₁)(a - b₂) / (b² + (m/10)²) over pixels and channels. The product of two differences with independent noise has
    the squared error's mean without the noise's, as long as what it is divided by knows nothing of that noise: b is the reference's mean
    over the 24 pixels around, not the pixel's own value, and m its mean over the picture.
    """
    reference = ((halves[0].astype(np.float64) + halves[1]) / 2).astype(np.float32)
    flip = float(flip_map(reference, picture).mean())
    a, b1, b2 = (x[surface].astype(np.float64) for x in (picture, *halves))
    if not a.size:
        return Figures(0.0, 0.0, 1.0, 0.0, 0.0, flip)
    mean, reference_mean = float(a.mean()), float(b1.mean() + b2.mean()) / 2
    if reference_mean == 0:
        same = mean == 0
        return Figures(mean, 0.0, 1.0 if same else None, 0.0 if same else None, 0.0, flip)
    around = _mean_around(reference, surface)[surface]
    weight = 1 / (around * around + (RELMSE_FLOOR * reference_mean) ** 2)
    relmse = float(((a - b1) * (a - b2) * weight).mean())
    noise = float(((b1 - b2) ** 2 * weight).mean()) / 4
    return Figures(mean, reference_mean, mean / reference_mean, relmse, noise, flip)


def _mean_around(image: F32, surface: NDArray[np.bool_]) -> F64:
    """Mean over the 5 × 5 pixels around each pixel that show a surface, the pixel itself left out; 0 where there are none."""
    height, width = surface.shape
    counted = np.concatenate([image * surface[..., None], surface[..., None]], -1).astype(np.float64)
    padded = np.pad(counted, ((2, 2), (2, 2), (0, 0)))
    total = -counted
    for y in range(5):
        for x in range(5):
            total += padded[y : y + height, x : x + width]
    out: F64 = total[..., :-1] / np.maximum(total[..., -1:], 1)
    return out


def flip_map(reference: F32, picture: F32) -> F32:
    """HDR-FLIP's error map, (h, w) float32 in [0, 1].

    Andersson et al. 2021, "Visualizing Errors in Rendered High Dynamic Range Images". Exposures are chosen as there, but from the median
    of the pixels that are not black: a picture that is black for the most part has no other.
    """
    luminance = reference.astype(np.float64) @ LUMINANCE
    lit = luminance[luminance > 0]
    start = stop = 0.0
    if lit.size:
        start, stop = (math.log2(_BRIGHTEST / y) for y in (float(lit.max()), float(np.median(lit))))
    parameters = {"startExposure": start, "stopExposure": stop, "numExposures": max(2, math.ceil(stop - start))}
    # flip_evaluator calls itself with the process's exit on bad input, so it is given none: contiguous, finite, not negative.
    images = [np.ascontiguousarray(np.maximum(x, 0), np.float32) for x in (reference, picture)]
    error, _, _ = flip_evaluator.evaluate(*images, "HDR", applyMagma=False, computeMeanError=False, parameters=parameters)
    out: F32 = np.asarray(error, np.float32)[..., 0]
    return out


def _brightest() -> float:
    """Where the ACES tone curve reaches 0.85, as HDR-FLIP's choice of exposures asks.

    Narkowicz 2015, "ACES Filmic Tone Mapping Curve": (x (2.51 x + 0.03)) / (x (2.43 x + 0.59) + 0.14), of 0.6 times the radiance.
    """
    target, scale = 0.85, 0.6
    a, b, c = (2.51 - target * 2.43) * scale**2, (0.03 - target * 0.59) * scale, -target * 0.14
    return (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a)


_BRIGHTEST = _brightest()
