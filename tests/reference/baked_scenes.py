"""Scenes by name, baked as the tables of docs/leaks.md need them, and what a renderer holds of such a bake."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.bake import bake
from bake_core.bench.outcome import put_section
from bake_core.bundle import VolumeData, read_bundle
from bake_core.examples import Example, cornell, glossy_cornell, tunnel, two_rooms
from bake_core.irradiance import sample
from bake_core.spec import parse_spec

F64 = NDArray[np.float64]
Volumes = tuple[VolumeData, ...]
# Irradiance of positions and normals.
Ask = Callable[[F64, F64], F64]

SHARED = Path(__file__).resolve().parents[3] / "shared"
EXAMPLES: dict[str, Callable[[], Example]] = {
    "cornell": cornell,
    "two_rooms": two_rooms,
    "tunnel": tunnel,
    "mirror_cornell": partial(glossy_cornell, 0.0),
}
THREADS = os.cpu_count() or 1


def files_of(name: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    """The scene's file and its spec: an example's, or that of `../shared/scenes` with its spec from `../shared/specs`."""
    if name in EXAMPLES:
        glb, document = EXAMPLES[name]()
        (folder / "scene.glb").write_bytes(glb)
        return folder / "scene.glb", document
    return SHARED / "scenes" / f"{name}.glb", json.loads((SHARED / "specs" / f"{name}.json").read_text())


def bake_at(
    scene: Path,
    document: dict[str, Any],
    changes: dict[str, Any],
    samples: int,
    folder: Path,
    outputs: Sequence[str] = ("irradiance", "visibility"),
) -> Volumes:
    """Bake with exactly so many samples, and with some other keys of the spec."""
    stop = {"target_error": None, "max_samples": samples}
    spec = parse_spec({**document, "outputs": list(outputs), "stop": stop, **changes})
    bake(scene, spec, folder / "bundle", threads=THREADS, audit_seconds=0)
    return read_bundle(folder / "bundle").volumes


def bytes_of(volumes: Volumes, name: str) -> int:
    """What a renderer holds for a probe: a tile with its border, as the bundle stores it."""
    atlas = volumes[0].atlases[name]
    return atlas.tile**2 * int(atlas.texels.shape[-1]) * {"half": 2, "float": 4}[atlas.encoding]


def ours(volumes: Volumes) -> Ask:
    return lambda positions, normals: sample(volumes, positions, normals).irradiance


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "".join("| " + " | ".join(cells) + " |\n" for cells in (heads, ["---"] * len(heads), *rows))


def publish(page: Path | None, name: str, section: str) -> None:
    """Print a section, and put it into a page between its marks; other sections of the page stay as they are."""
    print(section, flush=True)
    if page is not None:
        page.write_text(put_section(page.read_text(encoding="utf-8"), name, section), encoding="utf-8")
