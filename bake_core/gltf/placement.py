"""Meshes into the world: what occurs once is baked into mesh 0, the rest becomes prototypes with instances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bake_core.gltf.fields import fail
from bake_core.gltf.meshes import Mesh, check_size, join
from bake_core.gltf.nodes import Nodes
from bake_core.scene import F32, F64, I32, I64, U32

# Embree drops geometry beyond 1.84e18 without a word (its squares would overflow float32).
MAX_COORDINATE = 1e18
# Rays are taken into a prototype's space in float32: through a flatter transform, nothing would be left of their accuracy.
MIN_FLATNESS = 1e-5
# Products of vertices and instances that one side of the world's box may cost, about a second.
MAX_BOX_WORK = 1 << 31
# Below this a transform has no inverse that float64 knows: it leaves a plane, a line or a point.
SINGULAR = 1e-14


@dataclass(frozen=True)
class Placed:
    """The geometric columns of a :class:`bake_core.scene.Scene`."""

    origin: F64
    bounds: F64
    positions: F32
    normals: F32
    colors: F32
    uvs: F32
    indices: U32
    triangle_material: U32
    mesh_first_triangle: I64
    instance_mesh: I32
    instance_transform: F64


def place_meshes(meshes: Mapping[int, Mesh], uses: Sequence[tuple[int, int]], nodes: Nodes, sets: int) -> Placed:
    """Place meshes by their nodes, around the centre of what they cover.

    A mesh of several nodes becomes a prototype, but where a node flattens it (`MIN_FLATNESS`) it is baked.

    Parameters
    ----------
    meshes : mapping of int to Mesh
        By their index in the file; each has a triangle.
    uses : sequence of (node, mesh)
        In the order of nodes.
    sets : int
        How many sets of texture coordinates meshes have.

    Raises
    ------
    SceneError
        ``gltf.overflow`` for coordinates that Embree cannot hold, ``gltf.too_large``.
    """
    node = np.array([n for n, _ in uses], np.int64)
    mesh = np.array([m for _, m in uses], np.int64)
    matrix = nodes.world[node, :3, :]
    flatness = _flatness(matrix[:, :, :3])
    instanced = (np.bincount(mesh, minlength=1)[mesh] > 1) & (flatness >= MIN_FLATNESS)
    once = np.flatnonzero(~instanced).tolist()
    check_size(sum(len(meshes[mesh[i]].triangles) for i in once), "nodes")

    boxes: list[F64] = []
    baked: list[tuple[F64, Mesh]] = []
    for i in once:
        world, turned = _bake(meshes[mesh[i]], matrix[i], bool(flatness[i] > SINGULAR))
        boxes.append(_box(world))
        baked.append((world, turned))
        _check_range(boxes[-1], nodes.place(int(node[i])))

    prototypes, which = np.unique(mesh[instanced], return_inverse=True)
    transform = matrix[instanced]
    centred: list[Mesh] = []
    for p, m in enumerate(prototypes.tolist()):
        mine = which == p if len(prototypes) > 1 else slice(None)
        vertices = meshes[m].positions.astype(np.float64)
        centre = _box(vertices).mean(axis=0)
        vertices -= centre
        extent = _box(vertices)
        _check_range(extent, f"meshes[{m}]")
        with np.errstate(over="ignore", invalid="ignore"):
            transform[mine, :, 3] += transform[mine, :, :3] @ centre
            reach = np.abs(transform[mine, :, 3]) + np.abs(transform[mine, :, :3]) @ extent[1]
        _check_range(reach.max(axis=0), nodes.place(int(node[instanced][mine][np.argmax(reach.max(axis=1))])))
        boxes.append(_instances_box(vertices, transform[mine]))
        centred.append(_moved(meshes[m], vertices))

    bounds = np.array([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)]) if boxes else np.zeros((2, 3))
    # Adding 0 turns -0 into 0: these two are read by people.
    bounds = bounds + 0.0
    origin: F64 = bounds.mean(axis=0) + 0.0
    transform[:, :, 3] -= origin
    everything = [_moved(turned, world - origin) for world, turned in baked] + centred
    first_vertex = np.cumsum([0] + [len(m.positions) for m in everything])
    counts = [sum(len(m.triangles) for m in everything[: len(baked)])] + [len(m.triangles) for m in centred]
    normals = join([(m.normals, len(m.positions)) for m in everything], 3, 0.0)
    colors = join([(m.colors, len(m.positions)) for m in everything], 4, 1.0)
    uvs = join([(m.uvs, len(m.positions)) for m in everything], 2 * sets, 0.0)
    return Placed(
        origin=origin,
        bounds=bounds,
        positions=np.concatenate([m.positions for m in everything] or [np.zeros((0, 3), np.float32)]),
        normals=normals if normals is not None else np.zeros((0, 3), np.float32),
        colors=colors if colors is not None else np.zeros((0, 4), np.float32),
        uvs=uvs if uvs is not None else np.zeros((sum(len(m.positions) for m in everything), 2 * sets), np.float32),
        indices=np.concatenate(
            [m.triangles + np.uint32(v) for m, v in zip(everything, first_vertex, strict=False)] or [np.zeros((0, 3), np.uint32)]
        ),
        triangle_material=np.concatenate([m.material for m in everything] or [np.zeros(0, np.uint32)]),
        mesh_first_triangle=np.cumsum([0, *counts], dtype=np.int64),
        instance_mesh=(which + 1).astype(np.int32),
        instance_transform=transform,
    )


def _flatness(linear: F64) -> F64:
    """(n,) smallest over largest singular value of (n, 3, 3) matrices; 0 for a zero matrix."""
    values = np.linalg.svd(linear, compute_uv=False)
    ratio: F64 = np.divide(values[:, 2], values[:, 0], out=np.zeros(len(values)), where=values[:, 0] > 0)
    return ratio


def _bake(mesh: Mesh, matrix: F64, regular: bool) -> tuple[F64, Mesh]:
    """World positions in float64, and the mesh with its winding and normals as its node turns them.

    The front's normal is the inverse transpose's image of the front's normal in object space; so a mirrored mesh has its winding
    reversed (glTF 2.0, 3.7.4). Where the matrix is singular, the winding stays and the triangles are flat.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        world = mesh.positions.astype(np.float64) @ matrix[:, :3].T + matrix[:, 3]
    if not regular:
        return world, replace(mesh, normals=None)
    linear = matrix[:, :3] / np.abs(matrix[:, :3]).max()
    side = np.sign(np.linalg.det(linear))
    normals = mesh.normals
    if normals is not None:
        # The cofactors are the inverse transpose times the determinant, and need no division.
        cofactors = np.stack([np.cross(linear[1], linear[2]), np.cross(linear[2], linear[0]), np.cross(linear[0], linear[1])])
        turned = normals.astype(np.float64) @ (side * cofactors).T
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        normals = np.divide(turned, length, out=np.zeros_like(turned), where=length > 0).astype(np.float32)
    triangles = mesh.triangles if side > 0 else mesh.triangles[:, [0, 2, 1]]
    return world, replace(mesh, normals=normals, triangles=triangles)


def _moved(mesh: Mesh, positions: F64) -> Mesh:
    return replace(mesh, positions=positions.astype(np.float32))


def _box(points: F64) -> F64:
    return np.array([points.min(axis=0), points.max(axis=0)])


def _check_range(box: F64, where: str) -> None:
    # Written so that NaN fails too.
    if not (np.abs(box) <= MAX_COORDINATE).all():
        fail("overflow", f"puts vertices beyond {MAX_COORDINATE:g} m, where float32 ray tracing ends", where)


def _instances_box(vertices: F64, transform: F64) -> F64:
    """World box of all instances of one prototype."""
    box = np.empty((2, 3))
    for axis in range(3):
        rows, offset = transform[:, axis, :3], transform[:, axis, 3]
        box[0, axis] = -_furthest(vertices, -rows, -offset)
        box[1, axis] = _furthest(vertices, rows, offset)
    return box


def _furthest(vertices: F64, rows: F64, offset: F64) -> float:
    """Largest, over i and v, of rows[i]·v + offset[i], without going through every vertex of every instance.

    A prototype's box bounds what each instance can reach; in falling order of that bound, few instances need a closer look. Where
    they are not few (`MAX_BOX_WORK`), the bound stands for the rest.
    """
    low, high = _box(vertices)
    bound = np.where(rows > 0, rows * high, rows * low).sum(axis=1) + offset
    reach: dict[bytes, float] = {}
    best = -np.inf
    for i in np.argsort(-bound, kind="stable").tolist():
        if bound[i] <= best:
            break
        key = rows[i].tobytes()
        if key not in reach:
            if len(reach) * len(vertices) > MAX_BOX_WORK:
                return float(bound[i])
            reach[key] = float((vertices @ rows[i]).max())
        best = max(best, reach[key] + offset[i])
    return best
