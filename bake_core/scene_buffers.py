"""A scene as buffers and textures on a Vulkan device: what shaders/verification reads, in the order of its bindings."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bake_core.ggx_albedo import albedo_table
from bake_core.lights import cone_ramps
from bake_core.scene import Lights, Scene
from bake_core.shadow_views import Batch
from bake_core.texture_tables import TextureTable
from bake_core.vulkan import Buffer, Device, Draw, Image, storage, texture

F32 = NDArray[np.float32]

# Side of a layer of texels: every device has images as large.
_SHEET = 4096


def mesh_buffers(device: Device, scene: Scene) -> tuple[list[Buffer | Image], list[Draw]]:
    """Bindings 0 to 5 of scene.glsl, and one draw a mesh."""
    draws, transforms = _draws(scene)
    arrays = (scene.positions, scene.normals, scene.colors, scene.indices, _triangles(scene), transforms)
    return [storage(device, array) for array in arrays], draws


def material_buffers(device: Device, scene: Scene, textures: TextureTable | None) -> list[Buffer | Image]:
    """Bindings 6 of scene.glsl, 7 to 10 of textures.glsl and 11 of gloss.glsl."""
    table = albedo_table()
    albedo = np.concatenate([table.values.reshape(-1, 2), table.averages])
    if textures is None:
        uvs = rows = levels = np.zeros(0, np.float32)
        texels: NDArray[np.uint16] = np.zeros((0, 4), np.uint16)
    else:
        uvs, rows, texels = textures.uvs, _textures(textures), textures.texels
        levels = np.pad(textures.levels, ((0, 0), (0, 1))).astype(np.int32)
    sheet = texture(device, _sheet(texels), linear=False)
    return [storage(device, _materials(scene)), *(storage(device, a) for a in (uvs, rows, levels)), sheet, storage(device, albedo)]


def light_buffer(device: Device, lights: Lights, groups: Sequence[Batch]) -> Buffer:
    """Binding 12 of lights.glsl."""
    rows = np.zeros((len(lights.kind), 4, 4), np.float32)
    rows[:, 0, :3], rows[:, 0, 3] = lights.position, lights.kind
    rows[:, 1, :3], rows[:, 1, 3] = lights.direction, lights.range
    rows[:, 2, :3] = lights.value
    rows[:, 3, :2] = cone_ramps(lights)
    for batch in groups:
        rows[batch.first : batch.last, 2, 3] = batch.first_view
        rows[batch.first : batch.last, 3, 2] = batch.view_count
    return storage(device, rows)


def _draws(scene: Scene) -> tuple[list[Draw], F32]:
    """One draw a mesh, and the transforms of all instances in the draws' order, (n, 3, 4)."""
    first = scene.mesh_first_triangle
    draws, transforms = [], [np.eye(3, 4)[None]]
    if first[1] > first[0]:
        draws.append(Draw(3 * int(first[1] - first[0]), 1, 3 * int(first[0]), 0))
    used = 1
    for mesh in range(1, len(first) - 1):
        of_mesh = np.flatnonzero(scene.instance_mesh == mesh)
        if of_mesh.size and first[mesh + 1] > first[mesh]:
            draws.append(Draw(3 * int(first[mesh + 1] - first[mesh]), len(of_mesh), 3 * int(first[mesh]), used))
            transforms.append(scene.instance_transform[of_mesh])
            used += len(of_mesh)
    return draws, np.concatenate(transforms).astype(np.float32)


def _triangles(scene: Scene) -> F32:
    """Front normal in the mesh's own space (zero where a triangle has no area) and material index, (t, 4)."""
    v = scene.positions[scene.indices].astype(np.float64)
    normal = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    return np.concatenate([normal, scene.triangle_material[:, None]], 1).astype(np.float32)


def _materials(scene: Scene) -> F32:
    """Rows of scene.glsl's materials, (m, 4, 4)."""
    m = scene.materials
    rows = (
        np.column_stack([m.base_color, m.double_sided]),
        np.column_stack([m.emission, m.unlit]),
        np.column_stack([m.metallic, m.roughness, m.alpha, m.alpha_cutoff]),
        np.column_stack([m.base_color_texture, m.metallic_roughness_texture, m.emissive_texture, m.alpha_mode]),
    )
    return np.stack(rows, 1).astype(np.float32)


def _textures(textures: TextureTable) -> F32:
    """Rows of textures.glsl's textures, (k, 4, 4)."""
    count = len(textures.sampling)
    rows = np.zeros((count, 4, 4), np.float32)
    rows[:, 0], rows[:, 1, :2] = textures.sampling[:, :4], textures.sampling[:, 4:]
    rows[:, 1, 2], rows[:, 1, 3] = textures.srgb, textures.uvs.shape[2] // 2
    rows[:, 2:, :3] = textures.transform
    return rows


def _sheet(texels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Texels one after another in layers, (layers, height, width, 4): an image may be larger than a buffer that shaders read."""
    width = min(_SHEET, max(1, math.isqrt(len(texels))))
    height = min(_SHEET, max(1, -(-len(texels) // width)))
    layers = max(1, -(-len(texels) // (width * height)))
    return np.pad(texels, ((0, layers * height * width - len(texels)), (0, 0))).reshape(layers, height, width, 4)
