"""Thousands of deterministic mutations: whatever comes in, a Scene of finite numbers or a SceneError comes out.

pytest turns warnings into errors, so numpy's overflow warnings count as failures too.
"""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np

from bake_core.errors import SceneError
from bake_core.gltf.reader import load_scene_files
from bake_core.gltf.writer import pack_glb
from bake_core.scene import Scene
from tests.faults.fault import changed, sound

VALUES: tuple[Any, ...] = (
    *(None, True, False, "", "x", "\ud800", "\x00", "../x", [], {}, [[]], [{}], {"a": 1}),
    *(
        0,
        -0.0,
        1,
        -1,
        2,
        3,
        4,
        5,
        12,
        252,
        255,
        256,
        5120,
        5121,
        5123,
        5125,
        5126,
        65535,
        2**31,
        2**32,
        2**63,
        2**64,
        10**18,
        10**300,
        10**350,
    ),
    *(0.5, -0.5, 1e-320, 1e-45, 1e-30, 1e18, 1e30, 1e38, 1e39, 1e154, 1e200, 1e308, -1e308),
    *([0, 0, 0], [0, 0, 0, 0], [1e308, -1e308, 1e308], [1e-200, 1e-200, 1e-200], [1e200, 1, 1], [0.5, 0.5, 0.5, 0.5], [-1, 1, 1]),
    *(
        [0, 1, 2],
        [2, 1],
        [0] * 16,
        [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 3, 4, 5, 1],
        [1e300] * 12 + [1e300, 0, 0, 1],
        "VEC2",
        "VEC3",
        "SCALAR",
    ),
)


def _load(data: bytes, folder: Path) -> Scene | None:
    path = folder / "scene.glb"
    path.write_bytes(data)
    try:
        return load_scene_files("scene.glb", {"scene.glb": path})
    except SceneError as e:
        refusal = e
    assert refusal.slug.startswith("gltf.") and refusal.where and refusal.message and "\n" not in str(refusal)
    # Half a surrogate pair would break whatever prints it.
    str(refusal).encode()
    return None


def _check(scene: Scene | None) -> int:
    if scene is None:
        return 0
    for values in (scene.positions, scene.normals, scene.colors, scene.bounds, scene.origin, scene.instance_transform):
        assert np.isfinite(values).all()
    assert (
        np.isfinite(scene.materials.emission).all() and np.isfinite(scene.lights.value).all() and np.isfinite(scene.lights.position).all()
    )
    assert scene.indices.size == 0 or scene.indices.max() < len(scene.positions)
    assert len(scene.indices) == len(scene.triangle_material) == scene.mesh_first_triangle[-1]
    assert scene.triangle_material.size == 0 or scene.triangle_material.max() < len(scene.materials.name)
    return 1


def test_changed_bytes(tmp_path: Path) -> None:
    whole = changed()
    draw = random.Random(1)
    read = 0
    for _ in range(1500):
        data = bytearray(whole)
        for _ in range(draw.randint(1, 4)):
            at = draw.randrange(len(data))
            match draw.randrange(4):
                case 0:
                    data[at] = draw.randrange(256)
                case 1:
                    data[at] ^= 1 << draw.randrange(8)
                case 2:
                    del data[at : at + draw.randint(1, 9)]
                case 3:
                    data[at:at] = data[draw.randrange(len(data)) :][: draw.randint(1, 40)]
        read += _check(_load(bytes(data), tmp_path))
    # Mutations that change nothing that matters must exist, else nothing past the header is tested.
    assert read > 30


def test_changed_vertices(tmp_path: Path) -> None:
    """Bytes of the binary chunk alone: every float32 there is, in positions, normals and colours."""
    document, binary = sound()
    text = json.dumps(document).encode()
    draw = random.Random(2)
    read = 0
    for _ in range(1500):
        data = bytearray(binary)
        for _ in range(draw.randint(1, 8)):
            data[draw.randrange(len(data))] = draw.choice((0, 1, 0x3F, 0x7F, 0x80, 0xFF, draw.randrange(256)))
        read += _check(_load(pack_glb(text, bytes(data)), tmp_path))
    assert read > 100


def test_changed_fields(tmp_path: Path) -> None:
    document, binary = sound()
    draw = random.Random(3)
    read = 0
    for _ in range(2500):
        gltf = copy.deepcopy(document)
        for _ in range(draw.randint(1, 3)):
            _mutate(gltf, draw)
        read += _check(_load(pack_glb(json.dumps(gltf).encode(), binary), tmp_path))
    assert read > 100


def _mutate(gltf: Any, draw: random.Random) -> None:
    """Replace, remove, copy or move one field somewhere in the document."""
    places: list[tuple[Any, Any]] = []
    stack = [gltf]
    while stack:
        thing = stack.pop()
        keys = list(thing) if isinstance(thing, dict) else range(len(thing)) if isinstance(thing, list) else ()
        for key in keys:
            places.append((thing, key))
            stack.append(thing[key])
    owner, key = draw.choice(places)
    match draw.randrange(5):
        case 0:
            del owner[key]
        case 1:
            other, name = draw.choice(places)
            owner[key] = copy.deepcopy(other[name])
        case 2 if isinstance(owner[key], list) and owner[key]:
            owner[key] = owner[key] * 2
        case _:
            owner[key] = copy.deepcopy(draw.choice(VALUES))
