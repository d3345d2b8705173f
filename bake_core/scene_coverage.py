"""What is read, ignored and refused, as the code itself says it: ``python -m bake_core.scene_coverage`` updates docs/scenes.md.

Tables of the reader are shown as they stand; notes and refusals are found in its syntax tree, so none can be forgotten.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

from bake_core import mesh_files, zip_files
from bake_core.gltf import accessors, extensions, materials, meshes, textures
from bake_core.scene import WRAP_CLAMP, WRAP_MIRRORED, WRAP_REPEAT

BEGIN, END = "<!-- begin generated: python -m bake_core.scene_coverage -->", "<!-- end generated -->"
_WRAPS = {WRAP_REPEAT: "repeat", WRAP_MIRRORED: "mirrored repeat", WRAP_CLAMP: "clamp to edge"}
_USED = ("POSITION", "NORMAL", "COLOR", "TEXCOORD")
_ALPHA = {
    "OPAQUE": "alpha does not matter",
    "MASK": "a hole where alpha < `alphaCutoff`, for every ray",
    "BLEND": "there with probability alpha, for every ray",
}


def render() -> str:
    """The generated part of docs/scenes.md."""
    parts = ["## Read", _table(("what", "how"), _read()), "## Ignored, and listed", _IGNORED, _list(_notes())]
    return "\n\n".join([*parts, "## Refused by name", _REFUSED, _table(("what", "slug", "instead"), _refused())])


def insert(page: str) -> str:
    """A page with its generated part replaced."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{render()}\n\n{END}{rest.partition(END)[2]}"


_IGNORED = "`octobake info` and the manifest list these, each with its first place and how often it occurs; … is a name or a number."
_REFUSED = "Sound glTF that is not read yet. Only what the chosen scene uses is refused for these reasons."


def _read() -> Iterator[tuple[str, str]]:
    yield "scene files", f"`.glb`, `.gltf`, a zip of a folder with one of them, {', '.join(f'`{s}`' for s in mesh_files.SUFFIXES)}"
    limits = f"at most {zip_files.MAX_ENTRIES} files, {zip_files.MAX_BYTES >> 30} GiB unpacked, {zip_files.MAX_RATIO} times the zip's size"
    yield "zip", f"stored or deflated; {limits}"
    yield "OBJ, PLY, STL", f"triangles alone, in metres, +Y up: Lambert of albedo {mesh_files.NEUTRAL_ALBEDO}, double-sided"
    yield "primitives", ", ".join(meshes.MODES[meshes.TRIANGLES :])
    yield "indices", str(accessors.INDICES)
    for semantic in _USED:
        name = {"COLOR": "COLOR_0", "TEXCOORD": "TEXCOORD_n"}.get(semantic, semantic)
        plain, quantized = accessors.ATTRIBUTES[semantic], accessors.QUANTIZED[semantic]
        more = "" if plain == quantized else f"; with KHR_mesh_quantization: {quantized}"
        yield f"`{name}`", f"{plain}{more}"
    for mode in materials.ALPHA_MODES:
        yield f"`alphaMode` {mode}", _ALPHA[mode]
    yield "textures", "baseColorTexture and emissiveTexture (sRGB), metallicRoughnessTexture (linear), each with its own set of coordinates"
    yield "sampler wrap", ", ".join(f"{_WRAPS[w]} ({code})" for code, w in textures.WRAPS.items())
    yield "sampler magFilter", f"nearest ({textures.NEAREST}), linear ({textures.LINEAR}, and where there is none)"
    limit = f"at most 2^{textures.MAX_IMAGE_TEXELS.bit_length() - 1} texels each, 2^{textures.MAX_TEXELS.bit_length() - 1} together"
    yield "images", f"{', '.join(f'`{t}`' for t in textures.TYPES)}, in files, `data:` URIs and bufferViews; 8 and 16 bits; {limit}"
    for name, what in extensions.READ.items():
        yield f"`{name}`", what


def _notes() -> Iterator[str]:
    """The first argument of every ``notes.add`` of the reader."""
    for call in _calls():
        if isinstance(call.func, ast.Attribute) and call.func.attr == "add" and "notes" in ast.unparse(call.func.value):
            text = _text(call.args[0])
            if text.startswith("… (…)"):
                yield from (f"`{name}` ({why})" for name, why in materials.IGNORED_TEXTURES.items())
            elif text.startswith("…, which have no area"):
                yield f"{', '.join(meshes.MODES[: meshes.TRIANGLES])}: they have no area"
            else:
                yield text


def _refused() -> Iterator[tuple[str, str, str]]:
    for name, instead in extensions.REFUSED.items():
        yield f"`{name}` on anything in use, required or not", "`gltf.unsupported_extension`", instead
    yield "any other extension in `extensionsRequired`", "`gltf.unsupported_extension`", ""
    for call in _tuples_and_calls():
        slug = call[0]
        name = _text(slug)
        if name.startswith("unsupported_") and name != "unsupported_extension":
            what, _, instead = _text(call[1]).partition("; ")
            yield what, f"`gltf.{name}`", instead


def _calls() -> Iterator[ast.Call]:
    for tree in _trees():
        yield from (n for n in ast.walk(tree) if isinstance(n, ast.Call) and n.args)


def _tuples_and_calls() -> Iterator[list[ast.expr]]:
    seen = set()
    for tree in _trees():
        for n in ast.walk(tree):
            found = n.elts if isinstance(n, ast.Tuple) else n.args if isinstance(n, ast.Call) else []
            if len(found) == 3 and (key := ast.unparse(found[1])) not in seen:
                seen.add(key)
                yield found


def _trees() -> list[ast.Module]:
    folder = Path(meshes.__file__).parent
    return [ast.parse(p.read_text(encoding="utf-8")) for p in sorted(folder.glob("*.py"))]


def _text(node: ast.expr) -> str:
    """A string's text, with … for what an f-string fills in."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values)
    return str(node.value) if isinstance(node, ast.Constant) else "…"


def _table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows))


def _list(items: Iterator[str]) -> str:
    return "\n".join(f"- {item}" for item in sorted(set(items), key=str.lower))


if __name__ == "__main__":
    page = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/scenes.md")
    page.write_text(insert(page.read_text(encoding="utf-8")), encoding="utf-8")
