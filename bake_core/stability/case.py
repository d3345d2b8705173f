"""One stiff or extreme case: what it bakes, what must come out, and how far from it noise and rounding may lead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.bake import bake
from bake_core.bundle import Bundle, read_bundle
from bake_core.environment import beside
from bake_core.errors import BakeError
from bake_core.examples import Example
from bake_core.spec import parse_spec

F64 = NDArray[np.float64]

# A case that holds a claim about noise holds it at four standard errors: one run in 16,000 fails by chance, and seeds are fixed.
SIGMAS = 4.0
# Half an ulp of half floats, and eight of float32, in which up to 64 numbers are summed before they are stored: with the first, 1 % of it.
HALF_ROUNDING, FLOAT_ROUNDING = 2.0**-11, 2.0**-20


@dataclass(frozen=True)
class Result:
    """What a case found.

    Attributes
    ----------
    expected, measured : float or str
        Numbers, or words where the answer is one (the slug of a refusal).
    tolerance : float
        How far the one may be from the other; 0 for words and for what must be exact.
    note : str
        What the numbers are, where the expected one and the tolerance come from, and what accuracy is lost.
    """

    expected: float | str
    measured: float | str
    tolerance: float
    note: str

    @property
    def passed(self) -> bool:
        if isinstance(self.expected, str) or isinstance(self.measured, str):
            return self.expected == self.measured
        # False for NaN.
        return abs(self.measured - self.expected) <= self.tolerance


@dataclass(frozen=True)
class Baker:
    """Bakes scenes the way everybody does, in a folder of its own."""

    folder: Path
    threads: int

    def __call__(self, example: Example, **changes: Any) -> Bundle:
        """Bake an example with some of its spec's keys changed; the bundle as read back from disk.

        Raises
        ------
        OctobakeError
            As the bake does; ``bake.not_finite`` also for what might have slipped through.
        """
        glb, spec = example
        scene = self.folder / "scene.glb"
        scene.write_bytes(glb)
        out = self.folder / "bundle"
        bake(scene, parse_spec({**spec, **changes}), out, threads=self.threads, find=beside(self.folder))
        bundle = read_bundle(out)
        for volume in bundle.volumes:
            for atlas in volume.atlases.values():
                if not np.isfinite(atlas.texels).all() or (atlas.output != "normal" and (atlas.texels < 0).any()):
                    raise BakeError(
                        "bake.not_finite", f"the {atlas.output} atlas holds a value that is not finite or is negative", volume.name
                    )
        return bundle


@dataclass(frozen=True)
class Case:
    """`slow` cases take more than a few seconds, and are left out of the quick tests."""

    name: str
    run: Callable[[Baker], Result]
    slow: bool = False


def maps(bundle: Bundle, output: str = "irradiance", volume: int = 0) -> F64:
    """The map of every probe outside solids, in flat order, without borders: (n, t, t, channels)."""
    return bundle.volumes[volume].maps(output).astype(np.float64)


def near(expected: float, found: F64, relative: float, note: str) -> Result:
    """The number farthest from one that all must equal, within a relative tolerance."""
    flat = np.asarray(found, np.float64).reshape(-1)
    return Result(expected, float(flat[np.abs(flat - expected).argmax()]), relative * abs(expected), note)


def at_most(bound: float, found: float, note: str) -> Result:
    """A deviation, 0 at best, and its bound."""
    return Result(0.0, float(found), bound, note)


def one_probe(at: tuple[float, float, float], cell: float = 1.0, counts: tuple[int, int, int] = (1, 1, 1)) -> list[dict[str, Any]]:
    """The spec's volumes: probes from a place on, in cubic cells."""
    return [{"name": "probes", "origin": list(at), "spacing": [cell] * 3, "counts": list(counts)}]


def samples(count: int) -> dict[str, Any]:
    """The spec's stop: exactly so many samples."""
    return {"target_error": None, "max_samples": count}


def sky(radiance: float) -> dict[str, Any]:
    return {"kind": "constant", "radiance": [radiance] * 3}
