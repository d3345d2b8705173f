"""Lights as the kernels see them: punctual and directional lights, and the triangles that emit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import kernel
from bake_core.scene import LIGHT_DIRECTIONAL, LIGHT_POINT, LIGHT_SPOT, Lights, Scene
from bake_core.spec import DirectionalLight, PointLight, Spec

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class LightTable(NamedTuple):
    """Punctual lights by column, and a running sum of their weights (the last is 1) to choose one by.

    kind (n,) int32; position, direction, value (n, 3) float64; cone (n, 2) float64: scale and offset of the cosine ramp;
    range (n,) float64; cdf (n,) float64.
    """

    kind: NDArray[np.int32]
    position: F64
    direction: F64
    value: F64
    cone: F64
    range: F64
    cdf: F64


class EmitterTable(NamedTuple):
    """Emissive triangles in the local frame.

    vertices (e, 3, 3) float64; normal (e, 3) float64 unit, towards the front; material (e,) uint32; triangle (e,) int64, among all of the
    scene's; double_sided (e,) bool; cdf (e,) float64: running sum of the chance to be chosen; total float64: Σ area × weight × sides, where
    weight is the channel sum of the triangle's mean radiance, so that pdf_area = weight × sides / total; strength (t,) float64: that
    weight by triangle of the scene, empty where it is the material's emission.
    """

    vertices: F64
    normal: F64
    material: NDArray[np.uint32]
    triangle: NDArray[np.int64]
    double_sided: NDArray[np.bool_]
    cdf: F64
    total: float
    strength: F64


def merge_lights(scene: Scene, spec: Spec) -> Lights:
    """The glTF's lights and the spec's, in this order, in the scene's local frame."""
    own = scene.lights
    kind, position, direction, value, cosines = [], [], [], [], []
    for light in spec.lights:
        if isinstance(light, DirectionalLight):
            kind.append(LIGHT_DIRECTIONAL)
            position.append((0.0, 0.0, 0.0))
            direction.append(light.direction)
            value.append(light.irradiance)
            cosines.append((1.0, -1.0))
        elif isinstance(light, PointLight):
            kind.append(LIGHT_POINT)
            position.append(tuple(np.subtract(light.position, scene.origin)))
            direction.append((0.0, 0.0, 0.0))
            value.append(light.intensity)
            cosines.append((1.0, -1.0))
        else:
            kind.append(LIGHT_SPOT)
            position.append(tuple(np.subtract(light.position, scene.origin)))
            direction.append(light.direction)
            value.append(light.intensity)
            cosines.append((math.cos(light.inner_angle), math.cos(light.outer_angle)))
    if not kind:
        return own
    toward = np.asarray(direction, np.float64)
    length = np.linalg.norm(toward, axis=1, keepdims=True)
    unit = np.divide(toward, length, out=np.zeros_like(toward), where=length > 0)
    cone = np.asarray(cosines, np.float32)

    def join(a: NDArray[np.generic], b: NDArray[np.generic] | list[object]) -> NDArray[np.float32]:
        return np.concatenate([a, np.asarray(b, np.float32)]).astype(np.float32)

    return Lights(
        kind=np.concatenate([own.kind, np.asarray(kind, np.int32)]),
        position=join(own.position, np.asarray(position)),
        direction=join(own.direction, unit),
        value=join(own.value, np.asarray(value)),
        cos_inner=join(own.cos_inner, cone[:, 0]),
        cos_outer=join(own.cos_outer, cone[:, 1]),
        range=join(own.range, np.full(len(kind), np.inf)),
    )


def cone_ramps(lights: Lights) -> F64:
    """Scale and offset of each light's cone, (n, 2): by KHR_lights_punctual it is dimmed by saturate(cosθ · scale + offset)².

    The extension's sample code keeps cos inner - cos outer above 0.001, which would darken every spot narrower than 2.5° to nothing much;
    here only cosines that float32 cannot tell apart are held off each other, and make a hard edge.
    """
    inner, outer = lights.cos_inner.astype(np.float64), lights.cos_outer.astype(np.float64)
    scale = 1 / np.maximum(2.0**-22, inner - outer)
    return np.stack([scale, -outer * scale], 1)


def light_table(lights: Lights, bounds: F64) -> LightTable:
    """The kernels' view of punctual lights.

    Parameters
    ----------
    lights : Lights
    bounds : (2, 3) float64
        Of the scene, in the local frame: what makes a point light's intensity comparable with a sun's irradiance.
    """
    strength = lights.value.astype(np.float64).sum(1)
    # A light in the middle of the scene lights a surface a quarter of the diagonal away, as a typical case.
    typical = max(float(np.sum((bounds[1] - bounds[0]) ** 2)) / 16, 1e-60)
    weight = np.where(lights.kind == LIGHT_DIRECTIONAL, strength, strength / typical)
    shining = weight > 0
    weight = weight[shining]
    return LightTable(
        lights.kind[shining],
        lights.position[shining].astype(np.float64),
        lights.direction[shining].astype(np.float64),
        lights.value[shining].astype(np.float64),
        cone_ramps(lights)[shining],
        lights.range[shining].astype(np.float64),
        running_sum(weight),
    )


class Emitting(NamedTuple):
    """What is known of emitters beside what kernels read, each (e,): which item's they are; their power, area × weight × sides."""

    item: NDArray[np.int64]
    power: F64


def emitter_table(scene: Scene, strength: F64 | None = None) -> tuple[EmitterTable, Emitting]:
    """All emissive triangles of a scene, instances included; those without area are left out.

    Parameters
    ----------
    strength : (t,) float64, optional
        Channel sum of each triangle's mean radiance, where it is not simply its material's emission.
    """
    corners, fronts, materials, numbers, owners = [], [], [], [], []
    first = scene.mesh_first_triangle
    items = [(0, np.eye(3, 4))] + list(zip(scene.instance_mesh.tolist(), scene.instance_transform, strict=True))
    weight = scene.materials.emission.astype(np.float64).sum(axis=1)[scene.triangle_material] if strength is None else strength
    for mesh in range(len(first) - 1):
        triangles = np.arange(first[mesh], first[mesh + 1])
        triangles = triangles[weight[triangles] > 0]
        if not triangles.size:
            continue
        v = scene.positions[scene.indices[triangles]].astype(np.float64)
        for item, (of_mesh, m) in enumerate(items):
            if of_mesh == mesh:
                corners.append(v @ m[:, :3].T + m[:, 3])
                mirrored = np.sign(np.linalg.det(m[:, :3]))
                world = corners[-1]
                fronts.append(np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0]) * mirrored)
                materials.append(scene.triangle_material[triangles])
                numbers.append(triangles)
                owners.append(np.full(len(triangles), item))
    by_triangle = np.zeros(0) if strength is None else strength
    if not corners:
        none, number = np.zeros((0, 3)), np.zeros(0, np.int64)
        table = EmitterTable(
            np.zeros((0, 3, 3)), none, np.zeros(0, np.uint32), number, np.zeros(0, np.bool_), np.zeros(0), 0.0, by_triangle
        )
        return table, Emitting(number, np.zeros(0))
    vertices, front, material, number, owner = (np.concatenate(a) for a in (corners, fronts, materials, numbers, owners))
    twice_area = np.linalg.norm(front, axis=1)
    solid = twice_area > 0
    vertices, front, material, number, twice_area = (a[solid] for a in (vertices, front, material, number, twice_area))
    double_sided = scene.materials.double_sided[material]
    power = weight[number] * twice_area / 2 * np.where(double_sided, 2, 1)
    normal, total = front / twice_area[:, None], float(power.sum())
    table = EmitterTable(vertices, normal, material, number, double_sided, running_sum(power), total, by_triangle)
    return table, Emitting(owner[solid], power)


def running_sum(weight: F64) -> F64:
    """Of weights over all of them together: what :func:`choose` takes. The last is 1."""
    cdf: F64 = np.cumsum(weight / weight.sum()) if weight.size else np.zeros(0)
    cdf[-1:] = 1
    return cdf


@kernel
def choose(cdf, u):  # type: ignore[no-untyped-def]
    """First index whose running sum exceeds u: an index, and its chance."""
    low, high = 0, cdf.shape[0] - 1
    while low < high:
        middle = (low + high) // 2
        if cdf[middle] > u:
            high = middle
        else:
            low = middle + 1
    return low, cdf[low] - (cdf[low - 1] if low else 0.0)


@kernel
def toward_light(lights, i, px, py, pz):  # type: ignore[no-untyped-def]
    """From a point to light i: unit direction, distance (inf for directional), irradiance over value on a plane facing it.

    KHR_lights_punctual: 1/d², the window (1 - (d/range)⁴)+, and the squared cosine ramp of a spot.
    """
    if lights.kind[i] == LIGHT_DIRECTIONAL:
        return -lights.direction[i, 0], -lights.direction[i, 1], -lights.direction[i, 2], math.inf, 1.0
    x = lights.position[i, 0] - px
    y = lights.position[i, 1] - py
    z = lights.position[i, 2] - pz
    d2 = x * x + y * y + z * z
    if d2 <= 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    d = math.sqrt(d2)
    x, y, z = x / d, y / d, z / d
    gain = max(0.0, 1 - (d / lights.range[i]) ** 4) / d2
    if lights.kind[i] == LIGHT_SPOT:
        cosine = -(x * lights.direction[i, 0] + y * lights.direction[i, 1] + z * lights.direction[i, 2])
        ramp = min(max(cosine * lights.cone[i, 0] + lights.cone[i, 1], 0.0), 1.0)
        gain *= ramp * ramp
    return x, y, z, d, gain
