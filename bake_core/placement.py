"""Where probes stand: a spec's volumes, resolved against a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake_core.errors import SpecError
from bake_core.scene import Scene
from bake_core.spec import MAX_PROBES, Spec
from bake_core.spec import Volume as VolumeSpec

F64 = NDArray[np.float64]

# How far "fit": "scene" grows the bounds on each side, relative to their size: so that walls lie inside cells.
_GROWTH = 0.01
# A node's axis may be this far (sine of the angle) from a world axis and still count as a turn by 90°.
_TURNED = 1e-4
# Distances are clamped to this many cell diagonals: beyond it a probe says nothing about visibility inside its cells.
DISTANCE_LIMIT_DIAGONALS = 1.5


def cover(spacing: F64) -> float:
    """How far beyond its outermost probes a volume answers for points, metres.

    Half of its longest spacing: along that side, its cells answer for points as far from their probes.
    """
    return float(spacing.max()) / 2


@dataclass(frozen=True)
class Volume:
    """A grid of probes: probe (i, j, k) stands at origin + (i, j, k) * spacing, flat index i + nx * (j + ny * k).

    Attributes
    ----------
    name : str
    origin, spacing : (3,) float64
        Metres, world.
    counts : (int, int, int)
    """

    name: str
    origin: F64
    spacing: F64
    counts: tuple[int, int, int]

    @property
    def probe_count(self) -> int:
        return math.prod(self.counts)

    @property
    def distance_limit(self) -> float:
        """1.5 × the cell's diagonal, metres."""
        return DISTANCE_LIMIT_DIAGONALS * float(np.linalg.norm(self.spacing))

    @property
    def reach(self) -> tuple[F64, F64]:
        """Lowest and highest corner, (3,) float64 each, world, of the box for whose points the volume answers as well as it can."""
        grown = cover(self.spacing)
        return self.origin - grown, self.origin + (np.asarray(self.counts) - 1) * self.spacing + grown

    def positions(self) -> F64:
        """(n, 3) float64, world, in flat order."""
        nx, ny, nz = self.counts
        k, j, i = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
        out: F64 = self.origin + np.stack([i, j, k], -1).reshape(-1, 3) * self.spacing
        return out


def place(scene: Scene, spec: Spec) -> tuple[Volume, ...]:
    """Resolve every volume of a spec.

    Raises
    ------
    SpecError
        ``spec.no_geometry``, ``spec.unknown_node``, ``spec.node_not_aligned``, ``spec.too_many_probes``.
    """
    volumes = tuple(_place(scene, v, v.name or f"v{i}", f"volumes[{i}]") for i, v in enumerate(spec.volumes))
    total = sum(v.probe_count for v in volumes)
    if total > MAX_PROBES:
        raise SpecError("spec.too_many_probes", f"{total} probes are more than {MAX_PROBES} (2^24); use fewer or wider cells", "volumes")
    return volumes


def _place(scene: Scene, volume: VolumeSpec, name: str, where: str) -> Volume:
    if volume.fit == "scene":
        return _fit_scene(scene, volume, name, where)
    if volume.fit == "node":
        return _fit_node(scene, volume, name, where)
    assert volume.origin is not None and volume.spacing is not None and volume.counts is not None  # the spec's validator saw to it
    return Volume(name, np.asarray(volume.origin, np.float64), np.asarray(volume.spacing, np.float64), volume.counts)


def _fit_scene(scene: Scene, volume: VolumeSpec, name: str, where: str) -> Volume:
    """The scene's bounds grown by 1 % a side; with spacing, as many probes as cover it, centred."""
    if scene.triangle_count == 0:
        raise SpecError("spec.no_geometry", 'the scene has no triangles to fit to; give "origin", "spacing" and "counts"', where)
    size = (scene.bounds[1] - scene.bounds[0]) * (1 + 2 * _GROWTH)
    centre = (scene.bounds[0] + scene.bounds[1]) / 2
    if volume.spacing is not None:
        spacing = np.asarray(volume.spacing, np.float64)
        cells = [math.ceil(s) for s in size / spacing]
        counts = (cells[0] + 1, cells[1] + 1, cells[2] + 1)
    else:
        assert volume.counts is not None
        counts = volume.counts
        # A flat scene, or a single probe along an axis, still needs a cell size: as good as any is the scene's own.
        extent = np.where(size > 0, size, max(size.max(), 1e-6))
        spacing = extent / np.maximum(np.asarray(counts) - 1, 1)
    return Volume(name, centre - (np.asarray(counts) - 1) * spacing / 2, spacing, counts)


def _fit_node(scene: Scene, volume: VolumeSpec, name: str, where: str) -> Volume:
    """A node's local cube [-½, ½]³, first and last probes on its faces. Turns by 90° are followed, in the world's axis order."""
    found = [n for n in scene.nodes if n.name == volume.node]
    if not found:
        known = ", ".join(repr(n.name) for n in scene.nodes[:8] if n.name)
        raise SpecError("spec.unknown_node", f"the scene has no node {volume.node!r}; it has {known or 'no named nodes'}", f"{where}.node")
    if len(found) > 1:
        raise SpecError("spec.unknown_node", f"{len(found)} nodes are named {volume.node!r}; rename one", f"{where}.node")
    linear, centre = found[0].matrix[:3, :3], found[0].matrix[:3, 3]
    lengths = np.linalg.norm(linear, axis=0)
    world_axis = np.abs(linear).argmax(axis=0)
    aligned = np.abs(linear[world_axis, range(3)])
    off_axis = np.sqrt(np.maximum(lengths**2 - aligned**2, 0))
    if sorted(world_axis) != [0, 1, 2] or (lengths <= 0).any() or (off_axis > _TURNED * lengths).any():
        raise SpecError(
            "spec.node_not_aligned",
            f"node {volume.node!r} is turned by other than 90° about an axis, sheared, or has no size",
            f"{where}.node",
        )
    assert volume.counts is not None
    counts, size = np.empty(3, int), np.empty(3)
    counts[world_axis], size[world_axis] = volume.counts, aligned
    spacing = size / np.maximum(counts - 1, 1)
    origin = np.where(counts > 1, centre - size / 2, centre)
    return Volume(name, origin, spacing, (int(counts[0]), int(counts[1]), int(counts[2])))
