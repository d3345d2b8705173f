"""``octobake sample``: irradiance at points, by the same mathematics as the GLSL module."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

Vector = tuple[float, float, float]


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("sample", help="irradiance at points, by the same mathematics as the GLSL module")
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="a folder or a zip")
    parser.add_argument("--at", metavar="X,Y,Z", type=vector, action="append", default=[], help="a point, world, metres; may be repeated")
    parser.add_argument(
        "--normal", metavar="X,Y,Z", type=vector, action="append", default=[], help="its normal, any length; one for each --at"
    )
    parser.add_argument("--points", metavar="FILE.json", type=Path, help='[{"position": [x,y,z], "normal": [x,y,z]}, ...]')
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.set_defaults(run=run)


def vector(text: str) -> Vector:
    """An argparse type: three finite numbers with commas between."""
    parts = [float(p) for p in text.split(",")]
    if len(parts) != 3 or not all(map(math.isfinite, parts)):
        raise argparse.ArgumentTypeError("three finite numbers with commas between, as in 0,1.5,-2 (write --at=-1,0,0 for a leading minus)")
    return parts[0], parts[1], parts[2]


def run(args: argparse.Namespace) -> int:
    """Print irradiance, and the weights of the probes that gave it."""
    import numpy as np

    from bake_core.bundle import read_bundle
    from bake_core.errors import InputError
    from bake_core.irradiance import sample

    if len(args.at) != len(args.normal):
        raise InputError("sample.usage", f"{len(args.at)} --at and {len(args.normal)} --normal: give one normal for each point", "--normal")
    points = list(zip(args.at, args.normal, strict=True)) + (_read_points(args.points) if args.points else [])
    if not points:
        raise InputError("sample.usage", "give --at and --normal, or --points FILE.json", "--at")
    positions, normals = (np.array(part, np.float64) for part in zip(*points, strict=True))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if (lengths == 0).any():
        raise InputError("sample.zero_normal", "a normal is the zero vector; give a direction", f"point {int(np.argmin(lengths))}")
    volumes = read_bundle(args.bundle).volumes
    if "irradiance" not in volumes[0].atlases:
        raise InputError("sample.no_irradiance", "the bundle holds no irradiance; bake it with that output", str(args.bundle))
    answer = sample(volumes, positions, normals / lengths)
    samples: list[dict[str, Any]] = []
    for i, (position, normal) in enumerate(points):
        # Eight probes for each volume that answers, the finest first; what is behind them is for points that more volumes answer for.
        count = max(1, int((answer.shares[:, i] > 0).sum()))
        answering = answer.volumes[i, : 8 * count : 8]
        samples.append(
            {
                "position": list(position),
                "normal": list(normal),
                "irradiance": answer.irradiance[i].tolist(),
                "volume": volumes[answer.volume[i]].name,
                "volumes": [{"name": volumes[v].name, "weight": float(answer.shares[v, i])} for v in answering],
                "probes": answer.probes[i, : 8 * count].tolist(),
                "weights": answer.weights[i, : 8 * count].tolist(),
            }
        )
    if args.json:
        print(json.dumps({"samples": samples}, indent=2))
        return 0
    for found in samples:
        irradiance = " ".join(f"{e:.6g}" for e in found["irradiance"])
        print(f"at {_text(found['position'])} normal {_text(found['normal'])}: irradiance {irradiance}")
        for k, volume in enumerate(found["volumes"]):
            eight = slice(8 * k, 8 * k + 8)
            weights = [f"{p} × {w:.3f}" for p, w in zip(found["probes"][eight], found["weights"][eight], strict=True) if w > 0]
            probes = ", ".join(weights) or "none: not one around it is active, and 0 is no measurement"
            part = "" if len(found["volumes"]) == 1 else f" × {volume['weight']:.3f}"
            print(f"  volume {volume['name']}{part}, probes {probes}")
    return 0


def _text(v: list[float]) -> str:
    return ",".join(f"{x:g}" for x in v)


def _read_points(path: Path) -> list[tuple[Vector, Vector]]:
    from bake_core import strict_json
    from bake_core.errors import InputError

    try:
        text = path.read_bytes()
    except OSError as e:
        raise InputError("sample.unreadable", f"cannot be read: {e.strerror}", str(path)) from None
    document = strict_json.parse(text, InputError, "sample", path.name)
    if not isinstance(document, list):
        raise InputError("sample.invalid", 'must be a list of {"position": [x,y,z], "normal": [x,y,z]}', path.name)
    return [(_vector(p, "position", i, path), _vector(p, "normal", i, path)) for i, p in enumerate(document)]


def _vector(point: object, key: str, i: int, path: Path) -> Vector:
    from bake_core.errors import InputError

    value = point.get(key) if isinstance(point, dict) else None
    numbers = isinstance(value, list) and len(value) == 3 and all(type(x) in (int, float) and abs(x) < 1e30 for x in value)
    if not isinstance(value, list) or not numbers:
        raise InputError("sample.invalid", "must be three finite numbers", f"{path.name}: [{i}].{key}")
    return float(value[0]), float(value[1]), float(value[2])
