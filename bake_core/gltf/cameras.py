"""Perspective cameras at the nodes that carry them."""

from __future__ import annotations

import math

import numpy as np

from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.gltf.nodes import Nodes
from bake_core.scene import F64, Camera


def read_cameras(root: Fields, nodes: Nodes, notes: Notes) -> tuple[Camera, ...]:
    """The perspective cameras of the scene's nodes, in the order of nodes; orthographic ones are noted.

    A camera is named as its node, else as itself, else ``camera3`` by its node's index. Scale and skew of a node do not reach its camera.

    Raises
    ------
    SceneError
        What :class:`Fields` raises, ``gltf.bad_camera``, ``gltf.bad_transform``.
    """
    cameras = root.children("cameras")
    angles = [_yfov(f) for f in cameras]
    camera_of = [node.index("camera", len(cameras), "cameras") for node in nodes.fields]
    found = []
    for i in nodes.in_scene.tolist():
        index = camera_of[i]
        if index is None:
            continue
        angle = angles[index]
        if angle is None:
            notes.add("orthographic camera", nodes.place(i))
            continue
        name = nodes.name(i) or cameras[index].text("name", "") or f"camera{i}"
        found.append(Camera(name, _rigid(nodes.world[i], nodes.place(i)), angle))
    return tuple(found)


def _yfov(f: Fields) -> float | None:
    """A perspective camera's angle, None for an orthographic one."""
    kind = f.text("type")
    if kind == "orthographic":
        return None
    if kind != "perspective":
        fail("bad_camera", f"is {quoted(kind)}, must be perspective or orthographic", f.place("type"))
    if "perspective" not in f:
        fail("missing_key", "is required for a perspective camera", f.place("perspective"))
    lens = f.child("perspective")
    yfov = lens.number("yfov")
    if not 0 < yfov < math.pi:
        fail("bad_camera", f"is {yfov:g}, must be between 0 and π", lens.place("yfov"))
    near = lens.number("znear")
    if near <= 0:
        fail("bad_camera", f"is {near:g}, must be greater than 0", lens.place("znear"))
    if lens.number("zfar", default=math.inf) <= near:
        fail("bad_camera", "must be greater than znear", lens.place("zfar"))
    lens.positive("aspectRatio", 1.0)
    return yfov


def _rigid(world: F64, where: str) -> F64:
    """`world` without scale and skew: right, up and back orthonormal, looking where its -Z looked."""
    matrix = np.eye(4)
    matrix[:3, 3] = world[:3, 3]
    size = np.abs(world[:3, :3]).max()
    back, up = (world[:3, 2] / size, world[:3, 1] / size) if size > 0 else (np.zeros(3), np.zeros(3))
    right = np.cross(up, back)
    depth, width = float(np.linalg.norm(back)), float(np.linalg.norm(right))
    # 1e-12: the cross product of parallel axes is rounding, not a direction.
    if min(depth, width) < 1e-12:
        fail("bad_transform", "its scale leaves its camera no direction", where)
    back, right = back / depth, right / width
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    return matrix
