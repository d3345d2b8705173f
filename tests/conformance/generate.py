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
from bake_core.light_field import HIT, MISS, UNKNOWN, arriving, light_field, trace
from bake_core.octahedral import dir_to_oct, oct_to_dir, with_border
from bake_core.shader_constants import bundle_constants, probe_texels, surface_bias
from bake_core.volume_chains import CHAINS, volume_chain
from tests.conformance import rooms, synthetic

HERE = Path(__file__).resolve().parent
VERDICTS = {HIT: "hit", MISS: "miss", UNKNOWN: "unknown"}
ROUGHNESS = (0.0, 0.35, 0.9)


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


def tracing() -> dict[str, Any]:
    """A room that is open to the sky, with a block in it, two volumes of probes in closed form, and what rays through them meet."""
    room = rooms.Room(solids=(((-1.2, 0.0, -1.0), (-0.3, 1.7, -0.2)),), open_top=True)
    volumes = (
        rooms.volume(room, (-1.5, 0.5, -1.5), (3.0, 2.0, 3.0), (2, 2, 2), n=12, normals=8, light=4, moved=0.05, name="coarse"),
        rooms.volume(room, (0.5, 0.5, -0.5), (1.0, 1.0, 1.0), (2, 1, 2), n=12, normals=8, light=4, moved=0.1, name="fine"),
    )
    field = light_field(volumes)
    positions, directions = rooms.rays(room, 4000, seed=7)
    found = trace(field, positions, directions)
    # Rays of which another rounding would make something else are no fixture.
    chosen = np.ones(len(positions), np.bool_)
    for seed in range(8):
        nudge = np.random.default_rng(seed).uniform(-1e-5, 1e-5, (2, *positions.shape))
        near = trace(field, positions + nudge[0], directions + nudge[1])
        chosen &= (near.verdict == found.verdict) & (near.volume == found.volume) & (near.probe == found.probe)
        chosen &= np.isclose(near.distance, found.distance, rtol=0, atol=1e-3)
    kinds = np.stack([found.verdict, found.volume], -1)
    few = np.sort(np.concatenate([np.flatnonzero(chosen & (kinds == kind).all(-1))[:30] for kind in np.unique(kinds, axis=0)]))
    roughness = np.array(ROUGHNESS)[np.arange(len(positions)) % len(ROUGHNESS)]
    light = np.zeros_like(positions)
    for r in ROUGHNESS:
        light = np.where((roughness == r)[:, None], arriving(volumes, found, positions, directions, r), light)
    queries = [
        {
            "position": rounded(positions[i]),
            "direction": rounded(directions[i]),
            "roughness": rounded(roughness[i]),
            "verdict": VERDICTS[int(found.verdict[i])],
            "distance": rounded(found.distance[i]) if np.isfinite(found.distance[i]) else None,
            "normal": rounded(found.normal[i]),
            "volume": int(found.volume[i]),
            "probe": int(found.probe[i]),
            "radiance": rounded(light[i]),
        }
        for i in few
    ]
    return {
        "constants.glsl": bundle_constants(volumes).splitlines(),
        "volumes": [_volume(v) | {"chains": {c: _chain(v, c) for c in CHAINS}} for v in volumes],
        "queries": queries,
    }


def _chain(volume: VolumeData, chain: str) -> dict[str, Any]:
    texels = volume_chain(volume, chain)
    return {"shape": list(texels.shape), "texels": rounded(texels.ravel())}


def _lattice(volume: VolumeData) -> dict[str, Any]:
    return {"origin": rounded(volume.origin), "spacing": rounded(volume.spacing), "counts": rounded(volume.counts)}


def _volume(volume: VolumeData) -> dict[str, Any]:
    normal_bias, view_bias = surface_bias(volume)
    atlases = {
        name: {"interior": a.interior, "tile": a.tile, "shape": list(a.texels.shape), "texels": rounded(a.texels.ravel())}
        | ({"miss": rounded(a.miss)} if np.isfinite(a.miss) else {})
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
    return {
        "octahedral.json": text(octahedral()),
        "grid.json": text(grid()),
        "irradiance.json": text(query()),
        "trace.json": text(tracing()),
    }


if __name__ == "__main__":
    for name, content in files().items():
        (HERE / name).write_text(content, encoding="utf-8")
        print(f"wrote {name}: {len(content)} bytes")
