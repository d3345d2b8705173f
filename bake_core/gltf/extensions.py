"""Extensions: which are read, which are refused wherever something in use carries them, and that the rest is optional."""

from __future__ import annotations

from bake_core.gltf.fields import Fields, Notes, fail, quoted

READ = {
    "KHR_lights_punctual": "directional, point and spot lights",
    "KHR_materials_emissive_strength": "factor of a material's emission",
    "KHR_materials_unlit": "emits its base colour and reflects nothing",
    "KHR_mesh_quantization": "vertices of integers",
    "KHR_texture_transform": "offset, rotation, scale and set of texture coordinates",
}

# Reading over one of these would change geometry or light, although files may list them as optional.
REFUSED = {
    "EXT_mesh_gpu_instancing": "give each instance a node of its own",
    "EXT_meshopt_compression": "decompress it first (gltf-transform copy)",
    "KHR_draco_mesh_compression": "decompress it first (gltf-transform copy)",
    "KHR_meshopt_compression": "decompress it first (gltf-transform copy)",
}


def check_required(root: Fields, notes: Notes) -> None:
    """Refuse a file that requires what is not read; note what it merely uses.

    Raises
    ------
    SceneError
        ``gltf.unsupported_extension``.
    """
    for i, name in enumerate(root.texts("extensionsRequired")):
        if name not in READ:
            hint = f"; {REFUSED[name]}" if name in REFUSED else ""
            fail("unsupported_extension", f"the file requires {quoted(name)}, which is not read{hint}", f"extensionsRequired[{i}]")
    for i, name in enumerate(root.texts("extensionsUsed")):
        if name not in READ and name not in REFUSED:
            notes.add(f"optional extension {quoted(name)}", f"extensionsUsed[{i}]")


def of(thing: Fields) -> Fields:
    """The extensions on an object that is in use.

    Raises
    ------
    SceneError
        ``gltf.unsupported_extension`` where one of `REFUSED` is among them.
    """
    found = thing.child("extensions")
    for name in found.value:
        if name in REFUSED:
            fail("unsupported_extension", f"is not read; {REFUSED[name]}", found.place(name))
    return found
