"""What leaving out saves and costs, measured: one bake as it would be, and one with everything demanded back."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bake_core.bake import check_finite, compile_kernels, finish, gather
from bake_core.bundle import VolumeData, read_bundle
from bake_core.clock import Clock
from bake_core.environment import Find, no_images
from bake_core.prepared import Prepared, prepare
from bake_core.report import Run
from bake_core.scene import Scene
from bake_core.spec import OUTPUTS, Spec


@dataclass(frozen=True)
class Way:
    """One bake.

    Attributes
    ----------
    seconds : float
        From the first ray to the last; no compilation.
    bytes : int
        Of the bundle's files, as compressed.
    error : float or None
        The error figure.
    digests : dict of str to str
        SHA-256 of the texels that both bakes have as a reader has them, by ``volume.output``: however many channels a file spends on them.
    """

    seconds: float
    bytes: int
    samples: int
    error: float | None
    digests: dict[str, str]


@dataclass(frozen=True)
class BothWays:
    """`same` names the maps that both bundles hold with the same texels, bit for bit; `other` those that differ."""

    without: Way
    everything: Way

    @property
    def same(self) -> list[str]:
        a, b = self.without.digests, self.everything.digests
        return sorted(name for name in a if b.get(name) == a[name])

    @property
    def other(self) -> list[str]:
        return sorted(name for name in self.without.digests if name not in self.same)


def everything(scene: Scene, spec: Spec, find: Find = no_images, *, threads: int = 1) -> Prepared:
    """A bake that leaves out no output, no probe that stands outside solids, no environment, nor code for textures, holes and gloss."""
    prepared = prepare(scene, spec.model_copy(update={"outputs": OUTPUTS, "receivers": "everywhere"}), find, threads=threads)
    return prepared.traced_with(prepared.whole.general(scene))


def measure(scene: Scene, spec: Spec, *, threads: int, find: Find = no_images) -> BothWays:
    """Bake twice, here and now, and keep neither bundle.

    Raises
    ------
    SpecError, SceneError
        As a bake would.
    """
    without, ours = _bake(prepare(scene, spec, find, threads=threads), threads)
    with_all, theirs = _bake(everything(scene, spec, find, threads=threads), threads)
    # Of probes that one bake has and the other has not there is nothing to compare.
    kept = [(a.states == 1) & (b.states == 1) for a, b in zip(ours, theirs, strict=True)]
    return BothWays(replace(without, digests=_digests(ours, kept)), replace(with_all, digests=_digests(theirs, kept)))


def _bake(prepared: Prepared, threads: int) -> tuple[Way, tuple[VolumeData, ...]]:
    compile_kernels(prepared, audited=False)
    check_finite(prepared, threads=threads)
    clock, run = Clock(prepared.spec, None), Run(threads, 1)
    state = gather(prepared, run, clock)
    seconds = run.curve[-1].seconds
    with tempfile.TemporaryDirectory(prefix="octobake-both-ways-") as folder:
        manifest = finish(prepared, state, run, Path(folder) / "bundle", audit_seconds=0)
        volumes = read_bundle(Path(folder) / "bundle").volumes
    size = sum(entry["bytes"] for entry in manifest["files"].values())
    return Way(seconds, size, state.samples, state.error(), {}), volumes


def _digests(volumes: Sequence[VolumeData], kept: Sequence[NDArray[np.bool_]]) -> dict[str, str]:
    """By ``volume.output``, of the maps of some probes."""
    out = {}
    for volume, some in zip(volumes, kept, strict=True):
        active = volume.states == 1
        for output in volume.atlases:
            out[f"{volume.name}.{output}"] = sha256(volume.maps(output)[some[active]].tobytes()).hexdigest()
    return out
