"""Every component type, stride and sparse form that core glTF allows gives the same arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.unit.gltf_build import FLOAT, UBYTE, UINT, USHORT, Raw

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
ORDER = [0, 1, 2, 0, 2, 3]


@pytest.mark.parametrize("component", [UBYTE, USHORT, UINT])
def test_index_types(component: int, tmp_path: Path) -> None:
    raw = Raw()
    position, order = raw.accessor(SQUARE), raw.accessor(ORDER, component)
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": {"POSITION": position}, "indices": order}]}])
    assert scene.indices.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert scene.indices.dtype == np.uint32 and scene.positions.dtype == np.float32


@pytest.mark.parametrize("component", [UBYTE, USHORT, FLOAT])
@pytest.mark.parametrize("width", [3, 4])
def test_color_types(component: int, width: int, tmp_path: Path) -> None:
    scale = {UBYTE: 255, USHORT: 65535, FLOAT: 1}[component]
    colors = np.round(np.linspace(0, 1, 4 * width).reshape(4, width) * 255) / 255
    raw = Raw()
    # A VEC3 of ubyte is padded to 4 bytes by its stride, as vertex attributes are.
    stored = np.zeros((4, 4), np.float64)
    stored[:, :width] = np.round(colors * scale) if scale > 1 else colors
    dtype = {UBYTE: "<u1", USHORT: "<u2", FLOAT: "<f4"}[component]
    data = stored.astype(dtype)
    raw.accessor(SQUARE)
    raw.accessors.append(
        {
            "bufferView": raw.view(data.tobytes(), byteStride=data.strides[0]),
            "componentType": component,
            "count": 4,
            "type": f"VEC{width}",
            "normalized": component != FLOAT,
        }
    )
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": raw.accessor(ORDER, UBYTE)}
    scene = raw.load(tmp_path, meshes=[{"primitives": [primitive]}])
    np.testing.assert_allclose(scene.colors[:, :width], colors, atol=1e-7)
    assert width == 4 or (scene.colors[:, 3] == 1).all()


def test_colors_are_clamped(tmp_path: Path) -> None:
    raw = Raw()
    attributes = {"POSITION": raw.accessor(SQUARE[:3]), "COLOR_0": raw.accessor([[2, -1, 0.5]] * 3)}
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": attributes}]}])
    assert scene.colors.tolist() == [[1, 0, 0.5, 1]] * 3


def test_interleaved(tmp_path: Path) -> None:
    vertex = np.zeros(4, [("position", "<f4", 3), ("pad", "<u4"), ("normal", "<f4", 3), ("color", "<u1", 4)])
    vertex["position"] = SQUARE
    vertex["normal"] = [[0, 3, 4], [0, 0, 1], [1, 0, 0], [0, 0, 2]]
    vertex["color"] = [[255, 0, 51, 255]] * 4
    raw = Raw()
    view = raw.view(b"\0\0\0\0" + vertex.tobytes(), byteStride=vertex.itemsize)
    for offset, component, kind in ((0, FLOAT, "VEC3"), (16, FLOAT, "VEC3"), (28, UBYTE, "VEC4")):
        accessor = {"bufferView": view, "byteOffset": 4 + offset, "componentType": component, "count": 4, "type": kind}
        raw.accessors.append(accessor | ({"normalized": True} if component == UBYTE else {}))
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": raw.accessor(ORDER, USHORT)}
    scene = raw.load(tmp_path, meshes=[{"primitives": [primitive]}])
    np.testing.assert_array_equal(scene.positions + scene.origin, SQUARE)
    np.testing.assert_allclose(scene.normals, np.array([[0, 0.6, 0.8], [0, 0, 1], [1, 0, 0], [0, 0, 1]]), atol=1e-7)
    np.testing.assert_allclose(scene.colors, [[1, 0, 0.2, 1]] * 4, atol=1e-7)


@pytest.mark.parametrize("with_base", [True, False])
@pytest.mark.parametrize("component", [UBYTE, USHORT, UINT])
def test_sparse(with_base: bool, component: int, tmp_path: Path) -> None:
    base = np.array([[9, 9, 9], [1, 0, 0], [9, 9, 9], [0, 1, 0]] if with_base else [[0, 0, 0]] * 4, np.float32)
    changes = {0: [0, 0, 5], 2: [1, 1, 6]}
    expected = base.copy()
    for i, value in changes.items():
        expected[i] = value
    raw = Raw()
    places = raw.view(np.array(list(changes)).astype({UBYTE: "<u1", USHORT: "<u2", UINT: "<u4"}[component]).tobytes())
    values = raw.view(np.array(list(changes.values()), "<f4").tobytes())
    sparse = {"count": 2, "indices": {"bufferView": places, "componentType": component}, "values": {"bufferView": values}}
    raw.accessor(base, sparse=sparse)
    if not with_base:
        del raw.accessors[0]["bufferView"]
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": raw.accessor(ORDER, UBYTE)}]}])
    np.testing.assert_array_equal(scene.positions + scene.origin, expected)


def test_sparse_indices(tmp_path: Path) -> None:
    raw = Raw()
    position = raw.accessor(SQUARE)
    places, values = raw.view(b"\x03\x05"), raw.view(b"\x01\x03")
    sparse = {"count": 2, "indices": {"bufferView": places, "componentType": UBYTE}, "values": {"bufferView": values}}
    order = raw.accessor([0, 1, 2, 2, 2, 2], UBYTE, sparse=sparse)
    scene = raw.load(tmp_path, meshes=[{"primitives": [{"attributes": {"POSITION": position}, "indices": order}]}])
    assert scene.indices.tolist() == [[0, 1, 2], [1, 2, 3]]
