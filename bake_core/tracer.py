"""A scene as kernels read it: tables beside Embree's acceleration structure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bake_core import embree
from bake_core.environment import Environment, Sky
from bake_core.ggx_albedo import AlbedoTable, albedo_table
from bake_core.light_cache import LightCache
from bake_core.light_tree import FEWEST_EMITTERS, LightTree, light_tree
from bake_core.lights import EmitterTable, LightTable, emitter_table, light_table, merge_lights
from bake_core.materials import MaterialTable, gloss_table, material_table
from bake_core.ray_log import RayLog
from bake_core.scene import Lights, Scene
from bake_core.spec import Spec
from bake_core.texture_tables import TextureTable, texture_table
from bake_core.textures import emits_unevenly, mean_emission


class Tables(NamedTuple):
    """All that kernels read of a scene. Items are mesh 0 and then the instances.

    A triangle's corners stand together, because a hit at the end of an incoherent ray is a cache miss for every place it has to look:
    with vertices behind indices, fetching took a fifth of a path's time in the atrium.

    Attributes
    ----------
    corners : (t, 10) float32
        By triangle: the corners' nine coordinates, then the material's index as the bits of a uint32.
    corner_bits : (t, 10) uint32
        The same memory.
    normals, colors : (t, 3, 3) float32
        By triangle, corner and axis or channel; (0, 3, 3) where no mesh has any.
    item_first_triangle : (1 + i,) int64
    item_transform, item_normal : (1 + i, 3, 4) and (1 + i, 3, 3) float64
        Of points, and of normals up to a positive factor.
    tree : LightTree, optional
        Over the emitters, where they are many.
    cache : LightCache, optional
        Where paths end that it knows the rest of.
    log : RayLog, optional
        Where every query is written down. Kernels for tables with one are compiled apart, so that it costs the others nothing.
    """

    handle: np.uint64
    corners: NDArray[np.float32]
    corner_bits: NDArray[np.uint32]
    normals: NDArray[np.float32]
    colors: NDArray[np.float32]
    item_first_triangle: NDArray[np.int64]
    item_transform: NDArray[np.float64]
    item_normal: NDArray[np.float64]
    materials: MaterialTable
    gloss: AlbedoTable | None
    textures: TextureTable | None
    emitters: EmitterTable
    lights: LightTable
    environment: NDArray[np.float64]
    sky: Sky | None
    max_bounces: np.int64
    tree: LightTree | None = None
    cache: LightCache | None = None
    log: RayLog | None = None


@dataclass(frozen=True)
class Tracer:
    """A scene ready to be traced; rays are given in the scene's local frame (world minus `origin`)."""

    origin: NDArray[np.float64]
    lights: Lights
    tables: Tables
    geometry: embree.Geometry
    triangle_count: int

    @classmethod
    def build(cls, scene: Scene, spec: Spec, environment: Environment) -> Tracer:
        """Build the acceleration structure and the kernels' tables.

        Parameters
        ----------
        environment : Environment
            What :func:`bake_core.environment.read_environment` makes of the spec's.
        """
        geometry = embree.Geometry(scene)
        corners = np.empty((len(scene.indices), 10), np.float32)
        corners[:, :9] = scene.positions[scene.indices].reshape(-1, 9)
        corners[:, 9] = scene.triangle_material.view(np.float32)
        lights = merge_lights(scene, spec)
        emitters, emitting = emitter_table(scene)
        transforms = np.concatenate([np.eye(3, 4)[None], scene.instance_transform.reshape(-1, 3, 4)])
        tables = Tables(
            handle=np.uint64(geometry.handle),
            corners=corners,
            corner_bits=corners.view(np.uint32),
            normals=scene.normals[scene.indices] if len(scene.normals) else np.zeros((0, 3, 3), np.float32),
            colors=scene.colors[scene.indices, :3] if len(scene.colors) else np.zeros((0, 3, 3), np.float32),
            item_first_triangle=np.concatenate([scene.mesh_first_triangle[:1], scene.mesh_first_triangle[scene.instance_mesh]]),
            item_transform=transforms,
            item_normal=_normal_matrices(transforms[:, :, :3]),
            materials=material_table(scene),
            gloss=gloss_table(scene),
            textures=texture_table(scene),
            emitters=emitters,
            lights=light_table(lights, scene.bounds - scene.origin),
            environment=environment.constant,
            sky=environment.sky,
            max_bounces=np.int64(np.iinfo(np.int32).max if spec.max_bounces is None else spec.max_bounces),
        )
        if emits_unevenly(scene):
            emitters, emitting = emitter_table(scene, mean_emission(tables, scene))
            tables = tables._replace(emitters=emitters)
        if len(emitters.cdf) >= FEWEST_EMITTERS:
            emitters, tree = light_tree(scene, emitters, emitting)
            tables = tables._replace(emitters=emitters, tree=tree)
        return cls(scene.origin, lights, tables, geometry, scene.triangle_count)

    def without_environment(self) -> Tracer:
        """The same scene in the dark: for those who are sealed off from it (:mod:`bake_core.sealed`)."""
        return replace(self, tables=self.tables._replace(environment=np.zeros(3), sky=None))

    def general(self, scene: Scene) -> Tracer:
        """The same scene for kernels that know textures, holes and gloss, whether it has any or not: the same light, more slowly."""
        tables = self.tables._replace(
            gloss=self.tables.gloss or albedo_table(), textures=self.tables.textures or texture_table(scene, always=True)
        )
        return replace(self, tables=tables)


def _normal_matrices(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse transposes, up to a positive factor: the cofactor matrix times the determinant's sign, defined for singular ones too."""
    a, b, c = linear[:, 0], linear[:, 1], linear[:, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)
    sign = np.where((a * cofactors[:, 0]).sum(1) < 0, -1.0, 1.0)
    out: NDArray[np.float64] = cofactors * sign[:, None, None]
    return out
