"""Write the fixtures that every implementation of the query runs: `python tests/conformance/generate.py`.

Numbers are printed with nine digits, enough for any float32; inputs are exact. docs/shaders.md describes the files.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from numpy.typing import ArrayLike

from bake_core import irradiance
from bake_core.bundle import VolumeData
from bake_core.octahedral import dir_to_oct, oct_to_dir, with_border
from bake_core.shader_constants import bundle_constants, probe_texels, surface_bias
from tests.conformance import synthetic

HERE = Path(__file__).resolve().parent


def rounded(values: ArrayLike) -> Any:
    """Nested lists of numbers with nine significant digits; -0 keeps its sign."""
    a = np.asarray(values)
    if a.ndim:
        return [rounded(x) for x in a]
    return int(a) if np.issubdtype(a.dtype, np.integer) else float(f"{a:.9g}")


def octahedral() -> dict[str, Any]:
    """Directions and their points, both ways; and where a tile's border comes from."""
    directions = np.concatenate([synthetic.DIRECTIONS, synthetic.points(40)[1][-40:]])
    squares = np.stack([synthetic.sequence(40), synthetic.sequence(40, 100)], -1) * 2 - 1
    edges = np.array([[x, y] for x in (-1.0, -0.5, -0.0, 0.0, 0.5, 1.0) for y in (-1.0, -0.5, -0.0, 0.0, 0.5, 1.0)])
    points = np.concatenate([edges, squares])
    texels = np.arange(16.0).reshape(4, 4, 1)
    return {
        "dir_to_oct": [{"direction": rounded(d), "oct": rounded(o)} for d, o in zip(directions, dir_to_oct(directions), strict=True)],
        "oct_to_dir": [{"oct": rounded(o), "direction": rounded(d)} for o, d in zip(points, oct_to_dir(points), strict=True)],
        "border": {"interior": rounded(texels[..., 0].astype(int)), "tile": rounded(with_border(texels)[..., 0].astype(int))},
    }


def grid() -> dict[str, Any]:
    """Which volume answers for a point, and which cell of it."""
    volumes = synthetic.volumes()
    positions = synthetic.points(80)[0]
    chosen = irradiance.select_volume(volumes, positions)
    queries = []
    for position, v in zip(positions, chosen, strict=True):
        base, fraction = irradiance.cell(volumes[v], position[None])
        queries.append({"position": rounded(position), "volume": int(v), "base": rounded(base[0]), "fraction": rounded(fraction[0])})
    return {"volumes": [_lattice(v) for v in volumes], "queries": queries}


def query() -> dict[str, Any]:
    """A whole tiny bundle and the irradiance at points in it."""
    volumes = synthetic.volumes()
    positions, normals, wo = synthetic.points(80)
    answer = irradiance.sample(volumes, positions, normals, wo)
    rows = zip(positions, normals, wo, answer.irradiance, answer.volume, answer.volumes, answer.probes, answer.weights, strict=True)
    keys = ("position", "normal", "wo", "irradiance", "volume", "volumes", "probes", "weights")
    return {
        "constants.glsl": bundle_constants(volumes).splitlines(),
        "volumes": [_volume(v) for v in volumes],
        "queries": [dict(zip(keys, map(rounded, row), strict=True)) for row in rows],
    }


def _lattice(volume: VolumeData) -> dict[str, Any]:
    return {"origin": rounded(volume.origin), "spacing": rounded(volume.spacing), "counts": rounded(volume.counts)}


def _volume(volume: VolumeData) -> dict[str, Any]:
    normal_bias, view_bias = surface_bias(volume)
    atlases = {
        name: {"interior": a.interior, "tile": a.tile, "shape": list(a.texels.shape), "texels": rounded(a.texels.ravel())}
        for name, a in volume.atlases.items()
    }
    probes = probe_texels(volume)
    return {
        **_lattice(volume),
        "tiles": [next(iter(volume.atlases.values())).columns, next(iter(volume.atlases.values())).rows],
        "distance_limit": rounded(volume.distance_limit),
        "normal_bias": rounded(normal_bias),
        "view_bias": rounded(view_bias),
        "visibility_softness": rounded(volume.parameters["visibility_softness"]),
        "visibility_floor": rounded(volume.parameters["visibility_floor"]),
        "probes": {"shape": list(probes.shape), "texels": rounded(probes.ravel())},
        "atlases": atlases,
    }


def text(document: Mapping[str, Any]) -> str:
    """JSON with one row a line, so that a change can be read in a diff."""
    parts = []
    for key, value in document.items():
        rows = ",\n  ".join(json.dumps(row) for row in value) if isinstance(value, list) else ""
        parts.append(f"{json.dumps(key)}: [\n  {rows}\n ]" if rows else f"{json.dumps(key)}: {json.dumps(value)}")
    return "{\n " + ",\n ".join(parts) + "\n}\n"


def files() -> dict[str, str]:
    """Every fixture: file name to text."""
    return {"octahedral.json": text(octahedral()), "grid.json": text(grid()), "irradiance.json": text(query())}


if __name__ == "__main__":
    for name, content in files().items():
        (HERE / name).write_text(content, encoding="utf-8")
        print(f"wrote {name}: {len(content)} bytes")
