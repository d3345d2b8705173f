"""The node hierarchy of one scene: which nodes are in it, and each one's matrix to world, composed in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bake_core.gltf.fields import Fields, fail
from bake_core.scene import F64, I64

# glTF demands unit quaternions; exporters write them in float32 or with a few digits. Further off it is some other thing.
_QUATERNION_TOLERANCE = 0.01


@dataclass(frozen=True)
class Nodes:
    """All nodes of the file, checked.

    Attributes
    ----------
    fields : list of Fields
    world : (n, 4, 4) float64
        Local to world.
    in_scene : (k,) int64
        Indices of the chosen scene's nodes, growing.
    """

    fields: list[Fields]
    world: F64
    in_scene: I64

    def name(self, index: int) -> str:
        return self.fields[index].text("name", "")

    def place(self, index: int) -> str:
        """A node for a message: ``node 'Lamp' (nodes[4])``."""
        name = self.name(index)
        return f"node {name[:60]!r} (nodes[{index}])" if name else f"nodes[{index}]"


def read_nodes(root: Fields) -> Nodes:
    """Read every node and choose the scene: the one that `scene` names, else the first.

    Raises
    ------
    SceneError
        What :class:`Fields` raises, ``gltf.no_scene``, ``gltf.two_parents``,
        ``gltf.duplicate_node``, ``gltf.node_cycle``, ``gltf.not_a_root``, ``gltf.bad_transform``, ``gltf.overflow``.
    """
    fields = root.children("nodes")
    children = [f.indices("children", len(fields), "nodes") if "children" in f else [] for f in fields]
    parent = np.full(len(fields), -1, np.int64)
    for i, below in enumerate(children):
        for k, child in enumerate(below):
            if parent[child] >= 0:
                message = f"node {child} is already a child of node {parent[child]}; a node has one parent"
                fail("two_parents", message, f"nodes[{i}].children[{k}]")
            parent[child] = i
    world = _locals(fields)
    seen = np.zeros(len(fields), np.bool_)
    level = np.flatnonzero(parent < 0)
    seen[level] = True
    with np.errstate(over="ignore", invalid="ignore"):
        while level.size:
            level = np.array([c for i in level.tolist() for c in children[i]], np.int64)
            seen[level] = True
            world[level] = world[parent[level]] @ world[level]
    nodes = Nodes(fields, world, _in_scene(root, parent, children))
    if not seen.all():
        fail("node_cycle", "is its own ancestor; a hierarchy must be a tree", nodes.place(int(np.argmin(seen))))
    finite = np.isfinite(world).all(axis=(1, 2))
    if not finite.all():
        fail("overflow", "its matrix to world is beyond float64", nodes.place(int(np.argmin(finite))))
    return nodes


def _in_scene(root: Fields, parent: I64, children: list[list[int]]) -> I64:
    scenes = root.children("scenes")
    chosen = root.index("scene", len(scenes), "scenes")
    if not scenes:
        fail("no_scene", "the file has no scene, so there is nothing to bake; export one", "scenes")
    tops: list[int] = []
    for i, scene in enumerate(scenes):
        listed = scene.indices("nodes", len(parent), "nodes")
        for k, node in enumerate(listed):
            if parent[node] >= 0:
                fail("not_a_root", f"node {node} is a child of node {parent[node]}; scenes list root nodes", f"{scene.where}.nodes[{k}]")
        if len(set(listed)) != len(listed):
            fail("duplicate_node", "lists a node twice", f"{scene.where}.nodes")
        if i == (chosen or 0):
            tops = listed
    # A root's descendants are a tree here: every node has at most one parent, and no root is below another.
    found = list(tops)
    for i in found:
        found.extend(children[i])
    return np.array(sorted(found), np.int64)


def _locals(fields: list[Fields]) -> F64:
    """(n, 4, 4) matrices of all nodes to their parents."""
    n = len(fields)
    translation, scale = np.zeros((n, 3)), np.ones((n, 3))
    rotation = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    given: dict[int, F64] = {}
    for i, f in enumerate(fields):
        if "matrix" in f:
            if "translation" in f or "rotation" in f or "scale" in f:
                fail("bad_transform", "stands beside translation, rotation or scale; give one or the other", f.place("matrix"))
            given[i] = np.array(f.numbers("matrix", (0.0,) * 16)).reshape(4, 4).T
            if given[i][3].tolist() != [0, 0, 0, 1]:
                fail("bad_transform", "its last row must be 0 0 0 1", f.place("matrix"))
        else:
            if "translation" in f:
                translation[i] = f.numbers("translation", (0.0,) * 3)
            if "rotation" in f:
                rotation[i] = f.numbers("rotation", (0.0,) * 4)
            if "scale" in f:
                scale[i] = f.numbers("scale", (0.0,) * 3)
    # Components beyond 2 are no unit quaternion's, and clipping them keeps the squares finite.
    length = np.linalg.norm(np.clip(rotation, -2, 2), axis=1)
    wrong = np.abs(length - 1) > _QUATERNION_TOLERANCE
    if wrong.any():
        i = int(np.argmax(wrong))
        fail("bad_transform", "is not a unit quaternion (x, y, z, w)", fields[i].place("rotation"))
    x, y, z, w = (rotation / length[:, None]).T
    turn = np.empty((n, 3, 3))
    turn[:, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1)
    turn[:, 1] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1)
    turn[:, 2] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)
    matrices = np.zeros((n, 4, 4))
    with np.errstate(over="ignore", invalid="ignore"):
        matrices[:, :3, :3] = turn * scale[:, None, :]
    matrices[:, :3, 3] = translation
    matrices[:, 3, 3] = 1
    for i, matrix in given.items():
        matrices[i] = matrix
    return matrices
