"""Materials: metallic-roughness, emission, alpha and sides, for the materials that something visible uses."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from bake_core.gltf import extensions
from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.gltf.textures import Textures
from bake_core.scene import ALPHA_BLEND, ALPHA_MASK, ALPHA_OPAQUE, NO_TEXTURE, Materials

DEFAULT_NAME = "(default)"
ALPHA_MODES = {"OPAQUE": ALPHA_OPAQUE, "MASK": ALPHA_MASK, "BLEND": ALPHA_BLEND}
# Textures that are read over, and why that is right or what is missing then.
IGNORED_TEXTURES = {
    "normalTexture": "shading follows the vertices' normals",
    "occlusionTexture": "a path tracer finds occlusion itself",
}
_MAX_RADIANCE = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Row:
    """One material; the values of a `Row()` are glTF's own default material."""

    name: str = DEFAULT_NAME
    base_color: tuple[float, ...] = (1.0, 1.0, 1.0)
    metallic: float = 1.0
    roughness: float = 1.0
    emission: tuple[float, ...] = (0.0, 0.0, 0.0)
    double_sided: bool = False
    unlit: bool = False
    alpha_mode: int = ALPHA_OPAQUE
    alpha: float = 1.0
    alpha_cutoff: float = 0.5
    base_color_texture: int = NO_TEXTURE
    metallic_roughness_texture: int = NO_TEXTURE
    emissive_texture: int = NO_TEXTURE


def read_materials(root: Fields, used: Collection[int | None], textures: Textures, notes: Notes) -> tuple[Materials, dict[int | None, int]]:
    """The materials in `used`, in the file's order; None stands for glTF's default material, and comes last.

    Returns
    -------
    materials : Materials
    row : dict
        Index in the file, or None, to row.

    Raises
    ------
    SceneError
        For wrong values in any material, and ``gltf.unsupported_extension`` and what :meth:`Textures.use` raises for a used one.
    """
    rows: list[Row] = []
    row_of: dict[int | None, int] = {}
    for i, fields in enumerate(root.children("materials")):
        row = _read(fields, textures, notes if i in used else None)
        if i in used:
            extensions.of(fields)
            row_of[i] = len(rows)
            rows.append(row)
    if None in used:
        row_of[None] = len(rows)
        rows.append(Row())
    return _columns(rows), row_of


def _read(f: Fields, textures: Textures, notes: Notes | None) -> Row:
    """A material's row; without `notes` it is only checked, and none of its textures is used."""

    def texture(owner: Fields, key: str, *, srgb: bool) -> int:
        if key not in owner:
            return NO_TEXTURE
        info = owner.child(key)
        textures.check(info)
        return textures.use(info, srgb=srgb) if notes is not None else NO_TEXTURE

    pbr = f.child("pbrMetallicRoughness")
    base = pbr.numbers("baseColorFactor", (1.0, 1.0, 1.0, 1.0), low=0, high=1)
    metallic = pbr.number("metallicFactor", default=1.0, low=0, high=1)
    roughness = pbr.number("roughnessFactor", default=1.0, low=0, high=1)
    factor = f.numbers("emissiveFactor", (0.0, 0.0, 0.0), low=0, high=1)
    strength_fields = f.child("extensions").child("KHR_materials_emissive_strength")
    strength = strength_fields.number("emissiveStrength", default=1.0, low=0)
    if strength > _MAX_RADIANCE:
        fail("overflow", f"{strength:g} is beyond float32", strength_fields.place("emissiveStrength"))
    mode = f.text("alphaMode", "OPAQUE")
    if mode not in ALPHA_MODES:
        fail("out_of_range", f"is {quoted(mode)}, must be {', '.join(ALPHA_MODES)}", f.place("alphaMode"))
    cutoff = f.number("alphaCutoff", default=0.5, low=0)
    unlit = "KHR_materials_unlit" in f.child("extensions")
    for key, why in IGNORED_TEXTURES.items():
        if key in f:
            textures.check(f.child(key))
            if notes is not None:
                notes.add(f"{key} ({why})", f.place(key))
    row = Row(
        name=f.text("name", "") or f.where,
        double_sided=f.boolean("doubleSided"),
        alpha_mode=ALPHA_MODES[mode],
        alpha=base[3],
        # Beyond float32 is beyond every alpha.
        alpha_cutoff=min(cutoff, 2.0),
        base_color_texture=texture(pbr, "baseColorTexture", srgb=True),
    )
    if unlit:
        # KHR_materials_unlit: the colour, and nothing of what lighting would need.
        return replace(
            row, base_color=(0.0, 0.0, 0.0), metallic=0.0, unlit=True, emission=base[:3], emissive_texture=row.base_color_texture
        )
    return replace(
        row,
        base_color=base[:3],
        metallic=metallic,
        roughness=roughness,
        emission=tuple(c * strength for c in factor),
        metallic_roughness_texture=texture(pbr, "metallicRoughnessTexture", srgb=False),
        emissive_texture=texture(f, "emissiveTexture", srgb=True) if strength * max(factor) > 0 else NO_TEXTURE,
    )


def _columns(rows: list[Row]) -> Materials:
    def column(values: list[tuple[float, ...]] | list[float], *shape: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return np.array(values, np.float32).reshape(len(rows), *shape)

    return Materials(
        name=tuple(r.name for r in rows),
        base_color=column([r.base_color for r in rows], 3),
        metallic=column([r.metallic for r in rows]),
        roughness=column([r.roughness for r in rows]),
        emission=column([r.emission for r in rows], 3),
        double_sided=np.array([r.double_sided for r in rows], np.bool_),
        unlit=np.array([r.unlit for r in rows], np.bool_),
        alpha_mode=np.array([r.alpha_mode for r in rows], np.uint8),
        alpha=column([r.alpha for r in rows]),
        alpha_cutoff=column([r.alpha_cutoff for r in rows]),
        base_color_texture=np.array([r.base_color_texture for r in rows], np.int32),
        metallic_roughness_texture=np.array([r.metallic_roughness_texture for r in rows], np.int32),
        emissive_texture=np.array([r.emissive_texture for r in rows], np.int32),
    )
