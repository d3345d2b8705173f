"""The strict glTF 2.0 reader: a scene is read whole, or refused with a place and a reason.

1. container: files to JSON and buffers; version and required extensions.
2. accessors, nodes, meshes, materials, lights, cameras: every index and number in the file is checked, used or not.
3. What the chosen scene uses is read; what in it is not supported is refused by name.
4. placement: meshes become mesh 0 (whatever occurs once) and prototypes with instances.

docs/scenes.md says what is read, ignored and refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bake_core.gltf import container, extensions
from bake_core.gltf.accessors import Accessors
from bake_core.gltf.cameras import read_cameras
from bake_core.gltf.container import Document
from bake_core.gltf.fields import Fields, Notes, fail, quoted
from bake_core.gltf.lights import read_lights
from bake_core.gltf.materials import read_materials
from bake_core.gltf.meshes import Outline, Primitive, check_mesh, check_size, read_mesh
from bake_core.gltf.nodes import Nodes, read_nodes
from bake_core.gltf.placement import place_meshes
from bake_core.gltf.textures import Textures
from bake_core.scene import NO_TEXTURE, Materials, Scene, SceneNode


def load_scene(path: str | Path) -> Scene:
    """Read a .glb, or a .gltf with the files beside it.

    Parameters
    ----------
    path : str or Path
        A name that ends in .gltf is JSON, anything else a GLB. URIs resolve only to ``data:`` and to files in the scene's folder or below.

    Returns
    -------
    Scene
        With `digest` as :func:`bake_core.gltf.container.scene_digest` says.

    Raises
    ------
    SceneError
        ``gltf.*``, with the field, node, chunk or file at fault in `where`.
    """
    return _load(container.open_path(Path(path)))


def load_scene_files(root: str, files: Mapping[str, Path]) -> Scene:
    """Read a scene from uploaded files.

    Parameters
    ----------
    root : str
        Name of the .glb or .gltf among `files`.
    files : mapping of str to Path
        Name in the upload to the file that holds its bytes. Names beside `root` are relative to its folder; nothing else is opened.

    Returns
    -------
    Scene
        The same, digest included, as :func:`load_scene` gives for these files in a folder.

    Raises
    ------
    SceneError
        As :func:`load_scene`.
    """
    return _load(container.open_upload(root, files))


def _load(document: Document) -> Scene:
    root, notes = document.root, document.notes
    if root.count("animations"):
        notes.add("animation: the static pose is baked", "animations")
    accessors = Accessors(document)
    nodes = read_nodes(root)
    materials = root.count("materials")
    mesh_notes = [Notes() for _ in range(root.count("meshes"))]
    outlines = [check_mesh(f, accessors, materials, n) for f, n in zip(root.children("meshes"), mesh_notes, strict=True)]
    uses = _uses(root, nodes, outlines)
    used = sorted({mesh for _, mesh in uses})
    for mesh in used:
        notes.extend(mesh_notes[mesh])
    check_size(sum(outlines[m].triangle_count for m in used), "meshes")
    named = {p.material for m in used for p in outlines[m].primitives}
    textures = Textures(document, accessors, notes)
    table, row_of = read_materials(root, named, textures, notes)
    for m in used:
        for p in outlines[m].primitives:
            _check_texcoords(p, table, row_of[p.material], textures)
    sets = textures.sets()
    meshes = {m: read_mesh(outlines[m], accessors, row_of, sets) for m in used if outlines[m].primitives}
    placed = place_meshes(meshes, [(n, m) for n, m in uses if m in meshes], nodes, len(sets))
    lights = read_lights(root, nodes, placed.origin, notes)
    cameras = read_cameras(root, nodes, notes)
    looked_at, images = textures.read()
    return Scene(
        digest=document.resources.digest(),
        origin=placed.origin,
        bounds=placed.bounds,
        positions=placed.positions,
        normals=placed.normals,
        colors=placed.colors,
        uvs=placed.uvs,
        indices=placed.indices,
        triangle_material=placed.triangle_material,
        mesh_first_triangle=placed.mesh_first_triangle,
        instance_mesh=placed.instance_mesh,
        instance_transform=placed.instance_transform,
        materials=table,
        lights=lights,
        cameras=cameras,
        nodes=tuple(SceneNode(nodes.name(i), i, nodes.world[i]) for i in nodes.in_scene.tolist()),
        textures=looked_at,
        images=images,
        ignored=notes.lines(),
    )


def _check_texcoords(p: Primitive, table: Materials, row: int, textures: Textures) -> None:
    """Refuse a primitive that lacks the texture coordinates that its material's textures look at."""
    for texture in {int(c[row]) for c in (table.base_color_texture, table.metallic_roughness_texture, table.emissive_texture)}:
        if texture != NO_TEXTURE and textures.number(texture) not in p.texcoords:
            number, name = textures.number(texture), table.name[row]
            fail("missing_texcoord", f"a texture of its material {quoted(name)} needs TEXCOORD_{number}, which it does not have", p.where)


def _uses(root: Fields, nodes: Nodes, outlines: list[Outline]) -> list[tuple[int, int]]:
    """(node, mesh) for the chosen scene; refuses skins, morph targets and instancing in it."""
    skins = root.count("skins")
    in_scene = set(nodes.in_scene.tolist())
    uses = []
    for i, node in enumerate(nodes.fields):
        mesh = node.index("mesh", len(outlines), "meshes")
        skin = node.index("skin", skins, "skins")
        if i not in in_scene:
            continue
        if "extensions" in node:
            extensions.of(node)
        if skin is not None:
            fail("unsupported_skin", "skins are not read yet; apply the pose first", node.place("skin"))
        if "weights" in node:
            fail("unsupported_morph_targets", "morph targets are not read yet; apply them first", node.place("weights"))
        if mesh is not None:
            unsupported = outlines[mesh].unsupported
            if unsupported is not None:
                fail(*unsupported)
            uses.append((i, mesh))
    return uses
