"""A tree over many emitters, by which a point draws those that light it rather than those that are strong somewhere else.

Conty Estevez and Kulla 2018, "Importance Sampling of Many Lights with Adaptive Tree Splitting", without the splitting: a node knows where
its emitters are, how strong they are together and which ways they shine, hence how much of them a point may get, whatever is in the way.
The tree is complete, with its leaves side by side in powers of two (missing ones have no power), so that nodes need no links: those of
node i are 2 i + 1 and 2 i + 2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core.kernels import either, kernel
from bake_core.lights import EmitterTable, Emitting, choose, running_sum
from bake_core.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# Emissive triangles below which power alone chooses: a tree costs a tenth of a microsecond a light.
FEWEST_EMITTERS = 16
_BELOW_ONE = 1 - 2.0**-53


class LightTree(NamedTuple):
    """Few arrays, as in :class:`bake_core.light_cache.LightCache`.

    Attributes
    ----------
    nodes : (2 · leaves - 1, 10) float64
        Centre, local frame, and radius of a sphere about a node's emitters, metres; axis, and cosine and sine of the half angle, of a cone
        about their normals; their power, as :class:`bake_core.lights.EmitterTable` has it. Leaves are the emitters in their order.
    lookup : (items + triangles + …,) int64
        Which emitter an item's triangle is: ``lookup[lookup[item] + lookup[items + triangle]]``. The second or the whole is -1 where the
        triangle is none, or has no area in this item.
    """

    nodes: F64
    lookup: I64


def light_tree(scene: Scene, emitters: EmitterTable, emitting: Emitting) -> tuple[EmitterTable, LightTree]:
    """Emitters, as :func:`bake_core.lights.emitter_table` has them, in the order of a tree's leaves; and the tree."""
    n = len(emitters.cdf)
    leaves = 1 << (n - 1).bit_length()
    order = _ordered(emitters.vertices.mean(1), leaves)
    # Not the differences of the running sum: beside a sun a candle's is 0.
    item, power = emitting.item[order], emitting.power[order]
    table = emitters._replace(
        vertices=emitters.vertices[order],
        normal=emitters.normal[order],
        material=emitters.material[order],
        triangle=emitters.triangle[order],
        double_sided=emitters.double_sided[order],
        cdf=running_sum(power),
    )
    low, high = np.full((leaves, 3), np.inf), np.full((leaves, 3), -np.inf)
    low[:n], high[:n] = table.vertices.min(1), table.vertices.max(1)
    axis, cosine, strong = np.zeros((leaves, 3)), np.ones(leaves), np.zeros(leaves)
    axis[:n], cosine[:n], strong[:n] = table.normal, np.where(table.double_sided, -1.0, 1.0), power
    levels = [_nodes(low, high, axis, cosine, strong)]
    while len(strong) > 1:
        low, high = np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])
        axis, cosine = _cones(axis, cosine, strong)
        strong = strong[::2] + strong[1::2]
        levels.append(_nodes(low, high, axis, cosine, strong))
    return table, LightTree(np.concatenate(levels[::-1]), _lookup(scene, item, table.triangle))


def _ordered(centre: F64, leaves: int) -> I64:
    """Emitters in the order of leaves: cut in the middle across the longest side, again and again (Bentley 1975), all parts at once."""
    order = np.arange(len(centre))
    size = leaves
    while size > 1:
        part = np.arange(len(order)) // size
        starts = np.arange(0, len(order), size)
        at = centre[order]
        extent = np.maximum.reduceat(at, starts) - np.minimum.reduceat(at, starts)
        along = at[np.arange(len(at)), extent.argmax(1)[part]]
        order = order[np.lexsort((along, part))]
        size //= 2
    return order


def _lookup(scene: Scene, item: I64, triangle: I64) -> I64:
    """:attr:`LightTree.lookup` of emitters in their order: which item's and which triangle each is."""
    emissive = np.unique(triangle)
    # Of each mesh, where its emissive triangles begin among all; and how many an item has before it.
    begins = np.searchsorted(emissive, scene.mesh_first_triangle)
    mesh = np.concatenate([[0], scene.instance_mesh])
    count = np.diff(begins)
    before = np.cumsum(count[mesh]) - count[mesh]
    items = len(mesh)
    rank = np.full(scene.triangle_count, -1)
    rank[emissive] = np.arange(len(emissive)) - begins[np.searchsorted(scene.mesh_first_triangle, emissive, side="right") - 1]
    emitter = np.full(int(count[mesh].sum()), -1)
    emitter[before[item] + rank[triangle]] = np.arange(len(item))
    return np.concatenate([items + scene.triangle_count + before, rank, emitter])


def _nodes(low: F64, high: F64, axis: F64, cosine: F64, power: F64) -> F64:
    """One level of :attr:`LightTree.nodes`; what has no power has no place either."""
    low, high = (np.where(power[:, None] > 0, x, 0.0) for x in (low, high))
    radius = np.linalg.norm(high - low, axis=1) / 2
    return np.column_stack([(low + high) / 2, radius, axis, cosine, np.sqrt(1 - cosine**2), power])


def _cones(axis: F64, cosine: F64, power: F64) -> tuple[F64, F64]:
    """Of each two neighbours, a cone about both of theirs; one without power does not count."""
    a, b = axis[::2], axis[1::2]
    both = (power[::2] > 0) & (power[1::2] > 0)
    middle = a + b
    length = np.linalg.norm(middle, axis=1)
    unit = middle / np.maximum(length, 1e-300)[:, None]
    half = np.maximum(*(np.arccos(np.clip((unit * x).sum(1), -1, 1)) + np.arccos(c) for x, c in ((a, cosine[::2]), (b, cosine[1::2]))))
    # A hair wider: rounding must not leave out what they shine on.
    wide = np.where((length > 1e-6) & (half < math.pi), np.cos(np.minimum(half + 1e-6, math.pi)), -1.0)
    return np.where(both[:, None], unit, a), np.where(both, wide, cosine[::2])


@kernel
def importance(nodes, i, p):  # type: ignore[no-untyped-def]
    """What a point may get of a node: its power over the squared distance d² to its centre, times the greatest n · (p - x) / d, at most 1.

    Of all normals n in a cone and all places x in a sphere, none gives a greater n · (p - x) than the normal that leans most towards the
    point does at the sphere's centre, and the sphere's radius more. So, but for rounding, it is 0 only where no emitter of the node shines.
    """
    x, y, z = p[0] - nodes[i, 0], p[1] - nodes[i, 1], p[2] - nodes[i, 2]
    d2 = x * x + y * y + z * z
    radius, power = nodes[i, 3], nodes[i, 9]
    if d2 <= radius * radius:
        return power / (radius * radius) if power > 0 else 0.0
    d = math.sqrt(d2)
    along = x * nodes[i, 4] + y * nodes[i, 5] + z * nodes[i, 6]
    if along < d * nodes[i, 7]:
        leaning = along * nodes[i, 7] + math.sqrt(max(d2 - along * along, 0.0)) * nodes[i, 8] + radius
        return power * min(max(leaning, 0.0), d) / (d2 * d)
    return power / d2


@kernel
def _first_chance(nodes, i, p):  # type: ignore[no-untyped-def]
    """The chance that node i is chosen before node i + 1; below 0 where neither lights the point."""
    a, b = importance(nodes, i, p), importance(nodes, i + 1, p)
    return a / (a + b) if a + b > 0 else -1.0


@kernel
def _by_power(emitters, w):  # type: ignore[no-untyped-def]
    i, chance = choose(emitters.cdf, w)
    rest = (w - (emitters.cdf[i] - chance)) / chance if chance > 0 else 0.0
    return i, 1 / emitters.total, min(max(rest, 0.0), _BELOW_ONE)


def _pick(t, p, w):  # type: ignore[no-untyped-def]
    nodes = t.tree.nodes
    leaf = nodes.shape[0] // 2
    i, chance = 0, 1.0
    while i < leaf:
        i = 2 * i + 1
        first = _first_chance(nodes, i, p)
        if first < 0:
            return 0, 0.0, 0.0
        if w < first:
            w = w / first
            chance *= first
        else:
            w = (w - first) / (1 - first)
            chance *= 1 - first
            i += 1
        # Rounding must not make it 1, which no chance is above.
        w = min(w, _BELOW_ONE)
    return i - leaf, chance / nodes[i, 9], w


def _share(t, item, triangle, p):  # type: ignore[no-untyped-def]
    nodes, lookup = t.tree.nodes, t.tree.lookup
    rank = lookup[t.item_first_triangle.shape[0] + triangle]
    emitter = lookup[lookup[item] + rank] if rank >= 0 else -1
    if emitter < 0:
        return 0.0
    i = nodes.shape[0] // 2 + emitter
    share = 1 / nodes[i, 9]
    while i > 0:
        left = i - 1 + i % 2
        first = _first_chance(nodes, left, p)
        if first < 0:
            return 0.0
        share *= first if i == left else 1 - first
        i = (i - 1) // 2
    return share


# An emitter for a point (t, point, number in [0, 1)): which, and its chance over its power; a chance of 0 where none lights the point.
pick_emitter = either("tree")(_pick)(lambda t, p, w: _by_power(t.emitters, w))
# The same of an emitter that a ray from the point has met (t, item, triangle, point).
emitter_share = either("tree")(_share)(lambda t, item, triangle, p: 1 / t.emitters.total)
