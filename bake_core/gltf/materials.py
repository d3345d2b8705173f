"""Materials: metallic-roughness factors, emission and sides, for the materials that something visible uses."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from bake_core.gltf import extensions
from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.scene import Materials

DEFAULT_NAME = "(default)"
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


def read_materials(root: Fields, used: Collection[int | None], notes: Notes) -> tuple[Materials, dict[int | None, int]]:
    """The materials in `used`, in the file's order; None stands for glTF's default material, and comes last.

    Returns
    -------
    materials : Materials
    row : dict
        Index in the file, or None, to row.

    Raises
    ------
    SceneError
        For wrong values in any material, and ``gltf.unsupported_texture``, ``gltf.unsupported_alpha_mode`` and
        ``gltf.unsupported_extension`` in a used one.
    """
    rows: list[Row] = []
    row_of: dict[int | None, int] = {}
    textures = root.count("textures")
    for i, fields in enumerate(root.children("materials")):
        row, unsupported = _read(fields, textures, notes if i in used else Notes())
        if i in used:
            if unsupported is not None:
                fail(*unsupported)
            extensions.of(fields)
            row_of[i] = len(rows)
            rows.append(row)
        elif unsupported is not None:
            notes.add("a material that nothing uses", fields.where)
    if None in used:
        row_of[None] = len(rows)
        rows.append(Row())
    return _columns(rows), row_of


def _read(f: Fields, textures: int, notes: Notes) -> tuple[Row, tuple[str, str, str] | None]:
    """A material's row, and the arguments of :func:`fail` if it has what is not read yet."""
    unsupported: tuple[str, str, str] | None = None

    def texture(owner: Fields, key: str) -> None:
        nonlocal unsupported
        if key not in owner:
            return
        info = owner.child(key)
        info.required_index("index", textures, "textures")
        if key == "occlusionTexture":
            notes.add("occlusionTexture (a path tracer finds occlusion itself)", info.where)
        else:
            unsupported = unsupported or ("unsupported_texture", "textures are not read yet; bake factors instead", info.where)

    pbr = f.child("pbrMetallicRoughness")
    base = pbr.numbers("baseColorFactor", (1.0, 1.0, 1.0, 1.0), low=0, high=1)
    metallic = pbr.number("metallicFactor", default=1.0, low=0, high=1)
    roughness = pbr.number("roughnessFactor", default=1.0, low=0, high=1)
    factor = f.numbers("emissiveFactor", (0.0, 0.0, 0.0), low=0, high=1)
    strength_fields = f.child("extensions").child("KHR_materials_emissive_strength")
    strength = strength_fields.number("emissiveStrength", default=1.0, low=0)
    if strength > _MAX_RADIANCE:
        fail("overflow", f"{strength:g} is beyond float32", strength_fields.place("emissiveStrength"))
    texture(pbr, "baseColorTexture")
    texture(pbr, "metallicRoughnessTexture")
    for key in ("normalTexture", "emissiveTexture", "occlusionTexture"):
        texture(f, key)
    mode = f.text("alphaMode", "OPAQUE")
    if mode not in ("OPAQUE", "MASK", "BLEND"):
        fail("out_of_range", f"is {quoted(mode)}, must be OPAQUE, MASK or BLEND", f.place("alphaMode"))
    f.number("alphaCutoff", default=0.5, low=0)
    if mode != "OPAQUE":
        unsupported = unsupported or ("unsupported_alpha_mode", f"{mode} is not read yet; use OPAQUE", f.place("alphaMode"))
    emission = tuple(c * strength for c in factor)
    name = f.text("name", "") or f.where
    return Row(name, base[:3], metallic, roughness, emission, f.boolean("doubleSided")), unsupported


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
    )
