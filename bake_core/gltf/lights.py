"""KHR_lights_punctual: directional, point and spot lights at the nodes that carry them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.gltf.nodes import Nodes
from bake_core.scene import F64, LIGHT_DIRECTIONAL, LIGHT_POINT, LIGHT_SPOT, Lights

_KINDS = {"directional": LIGHT_DIRECTIONAL, "point": LIGHT_POINT, "spot": LIGHT_SPOT}
_MAX_VALUE = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class _Light:
    kind: int
    value: tuple[float, ...]
    inner: float
    outer: float
    range: float


def read_lights(root: Fields, nodes: Nodes, origin: F64, notes: Notes) -> Lights:
    """The lights of the scene's nodes, in the order of nodes; every light and every reference in the file is checked.

    A light looks along its node's -Z, whatever the node's scale; `Lights.value` is color × intensity.

    Raises
    ------
    SceneError
        What :class:`Fields` raises, ``gltf.bad_light``, ``gltf.overflow``, ``gltf.bad_transform``.
    """
    lights = [_check(f) for f in root.child("extensions").child("KHR_lights_punctual").children("lights")]
    light_of = {}
    for i, node in enumerate(nodes.fields):
        if "extensions" in node and "KHR_lights_punctual" in (found := node.child("extensions")):
            light_of[i] = found.child("KHR_lights_punctual").required_index("light", len(lights), "lights")
    placed = [(int(i), lights[light_of[int(i)]]) for i in nodes.in_scene if int(i) in light_of]
    if len(set(light_of.values())) < len(lights):
        notes.add("a light that no node carries", "extensions.KHR_lights_punctual.lights")
    n = len(placed)
    world = nodes.world[[i for i, _ in placed]].reshape(n, 4, 4)
    kind = np.array([light.kind for _, light in placed], np.int32)
    back = world[:, :3, 2]
    # Lengths by the largest component first: a node may scale by 1e-200.
    largest = np.abs(back).max(axis=1, initial=0.0)
    for (i, light), size in zip(placed, largest.tolist(), strict=True):
        if size == 0 and light.kind != LIGHT_POINT:
            fail("bad_transform", "its scale is 0 along Z, so its light has no direction", nodes.place(i))
    back = back / np.where(largest > 0, largest, 1)[:, None]
    length = np.linalg.norm(back, axis=1, keepdims=True)
    direction = -back / np.where(length > 0, length, 1)
    position = world[:, :3, 3] - origin
    direction[kind == LIGHT_POINT] = 0
    position[kind == LIGHT_DIRECTIONAL] = 0
    for (i, _), where in zip(placed, position.tolist(), strict=True):
        if max(map(abs, where)) > _MAX_VALUE:
            fail("overflow", "its light's position is beyond float32", nodes.place(i))
    return Lights(
        kind=kind,
        position=position.astype(np.float32),
        # + 0.0 turns -0 into 0: directions are read by people too.
        direction=(direction + 0.0).astype(np.float32),
        value=np.array([light.value for _, light in placed], np.float32).reshape(n, 3),
        cos_inner=np.array([math.cos(light.inner) for _, light in placed], np.float32),
        cos_outer=np.array([math.cos(light.outer) for _, light in placed], np.float32),
        range=np.array([light.range for _, light in placed], np.float32),
    )


def _check(f: Fields) -> _Light:
    kind = f.text("type")
    if kind not in _KINDS:
        fail("bad_light", f"is {quoted(kind)}, must be directional, point or spot", f.place("type"))
    color = f.numbers("color", (1.0, 1.0, 1.0), low=0, high=1)
    intensity = f.number("intensity", default=1.0, low=0)
    if intensity > _MAX_VALUE:
        fail("overflow", f"{intensity:g} is beyond float32", f.place("intensity"))
    reach = f.positive("range", math.inf)
    # cos 0 = 1 and cos π = -1 for lights without a cone.
    inner, outer = 0.0, math.pi
    if kind == "spot":
        if "spot" not in f:
            fail("missing_key", "is required for a spot light", f.place("spot"))
        cone = f.child("spot")
        inner = cone.number("innerConeAngle", default=0.0, low=0)
        outer = cone.number("outerConeAngle", default=math.pi / 4, low=0)
        # Exporters write π/2 in float32, which is a little more.
        if not inner < outer <= math.pi / 2 + 1e-6:
            fail("bad_light", f"needs innerConeAngle < outerConeAngle <= π/2, has {inner:g} and {outer:g}", cone.where)
    elif kind == "directional":
        reach = math.inf
    return _Light(_KINDS[kind], tuple(c * intensity for c in color), inner, outer, reach)
