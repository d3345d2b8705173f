"""Bad scenes made by our own code, each with the slug and the place that its refusal must name.

`corpus()` is what the reader's, the command line's and the service's tests run through.
"""

from __future__ import annotations

import base64
import copy
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from bake_core.gltf.writer import GlbWriter, Part, pack_glb
from tests.faults.fault import FLOAT32_HUGE, FLOAT32_INF, FLOAT32_NAN, GLB, GLTF, REMOVE, Fault, Json, changed, dump, put, sound
from tests.faults.other_files import mesh_faults, zip_faults
from tests.pictures import png, png_header


def corpus() -> list[Fault]:
    """Every fault, in a fixed order."""
    gltf = [*_containers(), *_json_faults(), *_uri_faults(), *_field_faults(), *_data_faults(), *_texture_faults(), *_unsupported()]
    return [*gltf, *zip_faults(), *mesh_faults()]


def _glb(name: str, slug: str, where: str, data: bytes) -> Fault:
    return Fault(name, f"gltf.{slug}", where, {GLB: data})


def _edit(name: str, slug: str, where: str, *edits: tuple[str, Any]) -> Fault:
    return _glb(name, slug, where, changed(*edits))


def _containers() -> Iterator[Fault]:
    sound_glb = changed()
    document, binary = sound()
    text = dump(document)
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)

    def chunks(*parts: tuple[int, bytes]) -> bytes:
        body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in parts)
        return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body

    json_kind, bin_kind = 0x4E4F534A, 0x004E4942
    yield _glb("empty file", "bad_magic", GLB, b"")
    yield _glb("wrong magic", "bad_magic", GLB, b"glTX" + sound_glb[4:])
    yield _glb("JSON named .glb", "bad_magic", GLB, text)
    yield _glb("a PNG", "bad_magic", GLB, b"\x89PNG\r\n\x1a\n" + bytes(64))
    yield _glb("truncated header", "truncated", GLB, sound_glb[:11])
    yield _glb("nothing after the header", "truncated", GLB, b"glTF" + struct.pack("<II", 2, 12))
    yield _glb("GLB version 1", "bad_version", GLB, b"glTF" + struct.pack("<I", 1) + sound_glb[8:])
    yield _glb("truncated file", "truncated", GLB, sound_glb[:-7])
    yield _glb("length larger than the file", "truncated", GLB, sound_glb[:8] + struct.pack("<I", 2**32 - 1) + sound_glb[12:])
    yield _glb("bytes after the end", "bad_length", GLB, sound_glb + bytes(4))
    longer = bytearray(sound_glb)
    longer[12:16] = struct.pack("<I", 0x7FFFFFFC)
    yield _glb("JSON chunk longer than the file", "truncated", f"{GLB}: chunk 0", bytes(longer))
    cut = chunks((json_kind, text), (bin_kind, binary))
    at = 20 + len(text)
    yield _glb("BIN chunk longer than the file", "truncated", f"{GLB}: chunk 1", cut[:at] + struct.pack("<I", 1 << 20) + cut[at + 4 :])
    partial = cut[: at + 4]
    yield _glb("cut in a chunk's header", "truncated", f"{GLB}: chunk 1", partial[:8] + struct.pack("<I", len(partial)) + partial[12:])
    yield _glb("BIN chunk first", "bad_chunk", f"{GLB}: chunk 0", chunks((bin_kind, binary), (json_kind, text)))
    yield _glb("two JSON chunks", "bad_chunk", f"{GLB}: chunk 1", chunks((json_kind, text), (json_kind, text)))
    yield _glb("two BIN chunks", "bad_chunk", f"{GLB}: chunk 2", chunks((json_kind, text), (bin_kind, binary), (bin_kind, binary)))
    yield _glb("BIN chunk third", "bad_chunk", f"{GLB}: chunk 2", chunks((json_kind, text), (0x58585858, b""), (bin_kind, binary)))
    yield _glb("chunk length not a multiple of 4", "bad_chunk", f"{GLB}: chunk 0", chunks((json_kind, text + b" "), (bin_kind, binary)))
    yield _glb("no BIN chunk", "missing_bin", "buffers[0]", chunks((json_kind, text)))
    yield _glb("BIN chunk too short", "buffer_too_short", "buffers[0].byteLength", chunks((json_kind, text), (bin_kind, binary[:-8])))


def _json_faults() -> Iterator[Fault]:
    def of(name: str, slug: str, where: str, text: bytes) -> Fault:
        return _glb(name, slug, where, pack_glb(text))

    version = b'"asset":{"version":"2.0"}'
    yield of("JSON cut off", "bad_json", GLB, b'{"asset":{"version":"2.0"')
    yield of("JSON with a trailing comma", "bad_json", GLB, b"{" + version + b",}")
    yield of("JSON that is not UTF-8", "bad_json", GLB, b'{"asset":{"version":"2.0","generator":"\xff"}}')
    yield of("empty JSON", "bad_json", GLB, b"    ")
    yield of("a number of 5000 digits", "bad_json", GLB, b"{" + version + b',"scene":' + b"9" * 5000 + b"}")
    yield of("lists 200,000 deep", "json_too_deep", GLB, b"[" * 200_000)
    yield of("objects 200,000 deep", "json_too_deep", GLB, b'{"a":' * 200_000)
    yield of("duplicate key", "duplicate_key", GLB, b"{" + version + b"," + version + b"}")
    yield of("duplicate key deep inside", "duplicate_key", GLB, b"{" + version + b',"nodes":[{"name":"a","name":"b"}]}')
    yield of("NaN literal", "not_finite", GLB, b"{" + version + b',"nodes":[{"translation":[NaN,0,0]}]}')
    yield of("Infinity literal", "not_finite", GLB, b"{" + version + b',"nodes":[{"translation":[-Infinity,0,0]}]}')
    yield of("root is a list", "wrong_type", GLB, b"[]")
    yield of("root is null", "wrong_type", GLB, b"null")
    yield Fault("a .gltf that is no JSON", "gltf.bad_json", GLTF, {GLTF: b"hello"}, GLTF)
    yield Fault("an empty .gltf", "gltf.bad_json", GLTF, {GLTF: b""}, GLTF)
    yield _edit("half a surrogate pair in a name", "bad_json", "nodes[0].name", ("nodes/0/name", "\ud800"))
    yield _edit("no asset", "missing_key", "asset", ("asset", REMOVE))
    yield _edit("no version", "missing_key", "asset.version", ("asset/version", REMOVE))
    yield _edit("version is a number", "wrong_type", "asset.version", ("asset/version", 2.0))
    yield _edit("glTF 1", "bad_version", "asset.version", ("asset/version", "1.0"))
    yield _edit("glTF 3", "bad_version", "asset.version", ("asset/version", "3.0"))
    yield _edit("version is a word", "bad_version", "asset.version", ("asset/version", "two"))
    yield _edit("needs a newer reader", "bad_version", "asset.minVersion", ("asset/minVersion", "2.1"))


def _uri_faults() -> Iterator[Fault]:
    document, binary = sound()

    def of(name: str, slug: str, uri: Any, *, unused: bool = False, **more: Any) -> Fault:
        gltf = copy.deepcopy(document)
        gltf["buffers"][0]["uri"] = "scene.bin"
        if unused:
            gltf["buffers"].append({"byteLength": 4, "uri": uri})
        else:
            gltf["buffers"][0]["uri"] = uri
        where = f"buffers[{int(unused)}].uri"
        return Fault(name, f"gltf.{slug}", where, {GLTF: dump(gltf), "scene.bin": binary}, GLTF, **more)

    for unused in (False, True):
        kind = " in an unused buffer" if unused else ""
        for uri in ("../scene.bin", "a/../../scene.bin", "/etc/passwd", "//host/share.bin", "http://localhost/scene.bin"):
            yield of(f"URI {uri}{kind}", "unsafe_uri", uri, unused=unused)
    for uri in (
        "..",
        ".",
        "",
        "a/..",
        "https://localhost/x.bin",
        "file:///etc/passwd",
        "FILE:scene.bin",
        "ftp:x",
        "C:scene.bin",
        "c:/scene.bin",
        "..\\scene.bin",
        "a\\scene.bin",
        "\\\\host\\share.bin",
        "%2e%2e/scene.bin",
        "%2E%2E%2Fscene.bin",
        "%2fetc%2fpasswd",
        "..%5cscene.bin",
        "http%3A//localhost/x.bin",
        "scene.bin%00.png",
        "scene\n.bin",
        "%ff.bin",
    ):
        yield of(f"URI {uri!r}", "unsafe_uri", uri)
    yield of("percent-encoded twice", "missing_file", "%252e%252e/scene.bin")
    yield of("missing file", "missing_file", "nowhere.bin")
    yield of("missing file of an unused buffer", "missing_file", "nowhere.bin", unused=True)
    yield of("a name too long for any file", "missing_file", "x" * 5000)
    yield of("URI is a number", "wrong_type", 7)
    yield of("data: URI that is not base64", "bad_data_uri", "data:text/plain,hello")
    yield of("data: URI with bad base64", "bad_data_uri", "data:application/octet-stream;base64,A!!!")
    yield of("data: URI with cut base64", "bad_data_uri", "data:application/octet-stream;base64,QUJ")
    yield of("data: URI with characters that are not ASCII", "bad_data_uri", "data:;base64,ä")
    yield of("data: URI without a comma", "bad_data_uri", "data:application/octet-stream;base64")
    yield of("a folder in a file's place", "missing_file", "folder", folders=("folder",))
    yield of("a link out of the folder", "unsafe_uri", "link.bin", links={"link.bin": "/etc/hostname"})
    yield of("a link to a folder above", "unsafe_uri", "up/scene.bin", links={"up": ".."})
    yield of("a link to itself", "missing_file", "loop.bin", links={"loop.bin": "loop.bin"})
    yield of("a device", "unsafe_uri", "zero.bin", links={"zero.bin": "/dev/zero"})

    short = "data:;base64," + base64.b64encode(bytes(8)).decode()
    yield Fault(
        "data: URI shorter than byteLength",
        "gltf.buffer_too_short",
        "buffers[1].byteLength",
        {GLB: changed(("buffers", lambda old: [*old, {"byteLength": 9, "uri": short}]))},
    )
    yield _edit("a second buffer without a URI", "missing_key", "buffers[1].uri", ("buffers", lambda old: [*old, {"byteLength": 4}]))
    yield _edit("http in an unused image", "unsafe_uri", "images[0].uri", ("images", [{"uri": "http://localhost/x.png"}]))
    yield _edit("../ in an unused image", "unsafe_uri", "images[0].uri", ("images", [{"uri": "../x.png"}]))


def _field_faults() -> Iterator[Fault]:
    """Indices, types and ranges of JSON fields."""
    light = "extensions/KHR_lights_punctual/lights/0"
    spot = "extensions.KHR_lights_punctual.lights[0].spot"
    indices = (
        ("scene", "scene"),
        ("scenes/0/nodes/0", "scenes[0].nodes[0]"),
        ("nodes/0/mesh", "nodes[0].mesh"),
        ("nodes/2/children/0", "nodes[2].children[0]"),
        ("nodes/3/camera", "nodes[3].camera"),
        ("nodes/1/extensions/KHR_lights_punctual/light", "nodes[1].extensions.KHR_lights_punctual.light"),
        ("meshes/0/primitives/0/attributes/POSITION", "meshes[0].primitives[0].attributes.POSITION"),
        ("meshes/0/primitives/0/attributes/NORMAL", "meshes[0].primitives[0].attributes.NORMAL"),
        ("meshes/0/primitives/0/indices", "meshes[0].primitives[0].indices"),
        ("meshes/0/primitives/0/material", "meshes[0].primitives[0].material"),
        ("accessors/0/bufferView", "accessors[0].bufferView"),
        ("bufferViews/0/buffer", "bufferViews[0].buffer"),
    )
    for path, where in indices:
        yield _edit(f"{where} out of range", "index_out_of_range", where, (path, 99))
        yield _edit(f"{where} is -1", "index_out_of_range", where, (path, -1))
    value: Any
    for value, kind in ((True, "true"), (0.0, "a float"), ("0", "a string"), (None, "null"), ([0], "a list")):
        yield _edit(f"a mesh index that is {kind}", "wrong_type", "nodes[0].mesh", ("nodes/0/mesh", value))
    yield _edit("an index of 300 digits", "index_out_of_range", "nodes[0].mesh", ("nodes/0/mesh", 10**300))
    yield _edit("skin out of range", "index_out_of_range", "nodes[0].skin", ("nodes/0/skin", 0))
    texture = "materials[0].pbrMetallicRoughness.baseColorTexture.index"
    yield _edit("texture out of range", "index_out_of_range", texture, ("materials/0/pbrMetallicRoughness/baseColorTexture", {"index": 0}))

    for name, path, where, value in (
        ("count of 1e9", "accessors/0/count", "accessors[0].count", 10**9),
        ("count of 1e18", "accessors/0/count", "accessors[0].count", 10**18),
        ("index count of 1e9", "accessors/3/count", "accessors[3].count", 999_999_999),
        ("one element too many", "accessors/0/count", "accessors[0].count", 5),
        ("byteOffset past the view", "accessors/0/byteOffset", "accessors[0].count", 4),
        ("accessor byteOffset of 1e18", "accessors/0/byteOffset", "accessors[0].count", 10**18),
    ):
        yield _edit(name, "accessor_out_of_view", where, (path, value))
    for name, path, where, value in (
        ("view longer than its buffer", "bufferViews/0/byteLength", "bufferViews[0].byteLength", 10**6),
        ("view of 1e18 bytes", "bufferViews/0/byteLength", "bufferViews[0].byteLength", 10**18),
        ("view beyond its buffer", "bufferViews/0/byteOffset", "bufferViews[0].byteLength", 10**6),
    ):
        yield _edit(name, "view_out_of_buffer", where, (path, value))
    yield _edit("buffer of 1e12 bytes", "buffer_too_short", "buffers[0].byteLength", ("buffers/0/byteLength", 10**12))
    for name, path, where, value in (
        ("negative accessor byteOffset", "accessors/0/byteOffset", "accessors[0].byteOffset", -4),
        ("negative view byteOffset", "bufferViews/0/byteOffset", "bufferViews[0].byteOffset", -4),
        ("negative view byteLength", "bufferViews/0/byteLength", "bufferViews[0].byteLength", -1),
        ("view of 0 bytes", "bufferViews/0/byteLength", "bufferViews[0].byteLength", 0),
        ("negative buffer byteLength", "buffers/0/byteLength", "buffers[0].byteLength", -1),
        ("negative count", "accessors/0/count", "accessors[0].count", -1),
        ("count of 0", "accessors/0/count", "accessors[0].count", 0),
        ("count beyond 64 bits", "accessors/0/count", "accessors[0].count", 2**64),
        ("unknown componentType", "accessors/0/componentType", "accessors[0].componentType", 5124),
        ("unknown accessor type", "accessors/0/type", "accessors[0].type", "VEC5"),
        ("unknown mode", "meshes/0/primitives/0/mode", "meshes[0].primitives[0].mode", 7),
        ("base colour above 1", "materials/0/pbrMetallicRoughness/baseColorFactor", _base_color(0), [1.5, 0, 0, 1]),
        ("negative base colour", "materials/0/pbrMetallicRoughness/baseColorFactor", _base_color(2), [0, 0, -0.1, 1]),
        ("metallic above 1", "materials/0/pbrMetallicRoughness/metallicFactor", "materials[0].pbrMetallicRoughness.metallicFactor", 1.01),
        ("negative roughness", "materials/0/pbrMetallicRoughness/roughnessFactor", _ROUGHNESS, -0.5),
        ("emissiveFactor above 1", "materials/0/emissiveFactor", "materials[0].emissiveFactor[1]", [0, 2, 0]),
        ("negative emission strength", f"materials/0/extensions/{_STRENGTH}/emissiveStrength", _STRENGTH_PLACE, -1),
        ("unknown alphaMode", "materials/0/alphaMode", "materials[0].alphaMode", "GLASS"),
        ("negative alphaCutoff", "materials/0/alphaCutoff", "materials[0].alphaCutoff", -1),
        ("light colour above 1", f"{light}/color", "extensions.KHR_lights_punctual.lights[0].color[0]", [2, 1, 1]),
        ("negative light intensity", f"{light}/intensity", "extensions.KHR_lights_punctual.lights[0].intensity", -1),
        ("light range of 0", f"{light}/range", "extensions.KHR_lights_punctual.lights[0].range", 0),
        ("negative inner angle", f"{light}/spot/innerConeAngle", f"{spot}.innerConeAngle", -0.1),
        ("camera aspect of 0", "cameras/0/perspective/aspectRatio", "cameras[0].perspective.aspectRatio", 0),
    ):
        yield _edit(name, "out_of_range", where, (path, value))
    for name, path, where, value in (
        ("count with a fraction", "accessors/0/count", "accessors[0].count", 4.5),
        ("count is 4.0", "accessors/0/count", "accessors[0].count", 4.0),
        ("count is true", "accessors/0/count", "accessors[0].count", True),
        ("accessors is an object", "accessors", "accessors", {}),
        ("a node is a number", "nodes/0", "nodes[0]", 5),
        ("attributes is a list", "meshes/0/primitives/0/attributes", "meshes[0].primitives[0].attributes", []),
        ("normalized is 1", "accessors/0/normalized", "accessors[0].normalized", 1),
        ("doubleSided is a string", "materials/0/doubleSided", "materials[0].doubleSided", "yes"),
        ("translation of 2 numbers", "nodes/0/translation", "nodes[0].translation", [0, 0]),
        ("rotation of 3 numbers", "nodes/0/rotation", "nodes[0].rotation", [0, 0, 0]),
        ("scale is a number", "nodes/0/scale", "nodes[0].scale", 2),
        ("scale holds a string", "nodes/0/scale", "nodes[0].scale[1]", [1, "1", 1]),
        ("matrix of 15 numbers", "nodes/0/matrix", "nodes[0].matrix", [0] * 15),
        ("children is an object", "nodes/0/children", "nodes[0].children", {"0": 1}),
        ("base colour of 3 numbers", "materials/0/pbrMetallicRoughness/baseColorFactor", _base_color(None), [1, 1, 1]),
        ("extensions is a list", "materials/0/extensions", "materials[0].extensions", []),
        ("extensionsRequired holds a number", "extensionsRequired", "extensionsRequired[0]", [1]),
        ("a name that is a number", "nodes/0/name", "nodes[0].name", 3),
    ):
        yield _edit(name, "wrong_type", where, (path, value))
    for name, path, where, value in (
        ("translation of 1e999", "nodes/0/translation", "nodes[0].translation[0]", [_Raw("1e999"), 0, 0]),
        ("translation of 400 digits", "nodes/0/translation", "nodes[0].translation[0]", [10**399, 0, 0]),
        ("intensity of 1e999", f"{light}/intensity", "extensions.KHR_lights_punctual.lights[0].intensity", _Raw("1e999")),
    ):
        yield _glb(name, "not_finite", where, _raw_changed(path, value))
    for path, where in (
        ("accessors/0/count", "accessors[0].count"),
        ("accessors/0/type", "accessors[0].type"),
        ("accessors/0/componentType", "accessors[0].componentType"),
        ("bufferViews/0/buffer", "bufferViews[0].buffer"),
        ("bufferViews/0/byteLength", "bufferViews[0].byteLength"),
        ("buffers/0/byteLength", "buffers[0].byteLength"),
        ("meshes/0/primitives", "meshes[0].primitives"),
        ("meshes/0/primitives/0/attributes/POSITION", "meshes[0].primitives[0].attributes.POSITION"),
        (f"{light}/type", "extensions.KHR_lights_punctual.lights[0].type"),
        (f"{light}/spot", spot),
        ("nodes/1/extensions/KHR_lights_punctual/light", "nodes[1].extensions.KHR_lights_punctual.light"),
        ("cameras/0/type", "cameras[0].type"),
        ("cameras/0/perspective", "cameras[0].perspective"),
        ("cameras/0/perspective/yfov", "cameras[0].perspective.yfov"),
    ):
        yield _edit(f"no {where}", "missing_key", where, (path, REMOVE))

    yield _edit("no scenes", "no_scene", "scenes", ("scenes", REMOVE), ("scene", REMOVE))
    yield _edit("a node that is its own child", "node_cycle", "nodes[4]", ("nodes", lambda old: [*old, {"children": [4]}]))
    cycle = [{"children": [5]}, {"children": [4], "name": "b"}]
    yield _edit("two nodes that are each other's child", "node_cycle", "nodes[4]", ("nodes", lambda old: old + cycle))
    yield _edit(
        "a cycle below the scene's root",
        "two_parents",
        "nodes[2].children[0]",
        ("nodes/1/children", [2]),
        ("nodes/2/children", [1]),
        ("nodes/0/children", [1]),
    )
    yield _edit("a node with two parents", "two_parents", "nodes[2].children[0]", ("nodes/0/children", [1]))
    yield _edit("a child listed twice", "two_parents", "nodes[2].children[1]", ("nodes/2/children", [1, 1]))
    yield _edit("a scene that lists a child", "not_a_root", "scenes[0].nodes[1]", ("scenes/0/nodes", [0, 1]))
    yield _edit("a scene that lists a node twice", "duplicate_node", "scenes[0].nodes", ("scenes/0/nodes", [0, 0]))
    identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    yield _edit("matrix beside TRS", "bad_transform", "nodes[2].matrix", ("nodes/2/matrix", identity))
    yield _edit("matrix with a last row", "bad_transform", "nodes[0].matrix", ("nodes/0/matrix", [*identity[:3], 0.5, *identity[4:]]))
    yield _edit("matrix whose corner is 0", "bad_transform", "nodes[0].matrix", ("nodes/0/matrix", [*identity[:15], 0]))
    yield _edit("zero quaternion", "bad_transform", "nodes[2].rotation", ("nodes/2/rotation", [0, 0, 0, 0]))
    yield _edit("quaternion of length 2", "bad_transform", "nodes[2].rotation", ("nodes/2/rotation", [0, 0, 0, 2]))
    yield _edit("quaternion of length 1e200", "bad_transform", "nodes[2].rotation", ("nodes/2/rotation", [1e200, 0, 0, 0]))
    yield _edit("a spot light on a node of scale 0", "bad_transform", "node 'lamp' (nodes[1])", ("nodes/1/scale", [1, 1, 0]))
    yield _edit("a camera on a node of scale 0", "bad_transform", "node 'eye' (nodes[3])", ("nodes/3/scale", [0, 0, 0]))
    yield _edit("a node at 1e300 m", "overflow", "node 'floor' (nodes[0])", ("nodes/0/translation", [1e300, 0, 0]))
    yield _edit("a mesh scaled by 1e30", "overflow", "node 'floor' (nodes[0])", ("nodes/0/scale", [1e30, 1, 1]))
    yield _edit(
        "scales whose product is beyond float64",
        "overflow",
        "node 'lamp' (nodes[1])",
        ("nodes/2/scale", [1e200, 1, 1]),
        ("nodes/1/scale", [1e200, 1, 1]),
    )
    yield _edit("emission beyond float32", "overflow", _STRENGTH_PLACE, (f"materials/0/extensions/{_STRENGTH}/emissiveStrength", 1e39))
    yield _edit("intensity beyond float32", "overflow", "extensions.KHR_lights_punctual.lights[0].intensity", (f"{light}/intensity", 1e39))
    yield _edit("unknown light type", "bad_light", "extensions.KHR_lights_punctual.lights[0].type", (f"{light}/type", "area"))
    for inner, outer in ((0.6, 0.5), (0.5, 0.5), (0.1, 2.0), (0.0, 0.0)):
        cone = {"innerConeAngle": inner, "outerConeAngle": outer}
        yield _edit(f"spot angles {inner} and {outer}", "bad_light", spot, (f"{light}/spot", cone))
    for yfov in (0, -1, 3.2):
        yield _edit(f"yfov of {yfov}", "bad_camera", "cameras[0].perspective.yfov", ("cameras/0/perspective/yfov", yfov))
    yield _edit("znear of 0", "bad_camera", "cameras[0].perspective.znear", ("cameras/0/perspective/znear", 0))
    yield _edit("zfar before znear", "bad_camera", "cameras[0].perspective.zfar", ("cameras/0/perspective/zfar", 0.001))
    yield _edit("unknown camera type", "bad_camera", "cameras[0].type", ("cameras/0/type", "fisheye"))


_STRENGTH = "KHR_materials_emissive_strength"
_STRENGTH_PLACE = f"materials[0].extensions.{_STRENGTH}.emissiveStrength"
_ROUGHNESS = "materials[0].pbrMetallicRoughness.roughnessFactor"


def _base_color(component: int | None) -> str:
    return "materials[0].pbrMetallicRoughness.baseColorFactor" + ("" if component is None else f"[{component}]")


class _Raw(str):
    """A JSON literal that Python's writer cannot write."""


def _raw_changed(path: str, value: Any) -> bytes:
    document, binary = sound()
    literals = [v for v in (value if isinstance(value, list) else [value]) if isinstance(v, _Raw)]
    put(document, path, value)
    text = dump(document)
    for literal in literals:
        text = text.replace(f'"{literal}"'.encode(), literal.encode())
    return pack_glb(text, binary)


def _data_faults() -> Iterator[Fault]:
    """Accessors that do not suit their use, and what is wrong with the bytes themselves."""
    attributes = "meshes[0].primitives[0].attributes"
    document, binary = sound()
    offset = [v["byteOffset"] for v in document["bufferViews"]]

    def patched(at: int, data: bytes, *edits: tuple[str, Any]) -> bytes:
        gltf = copy.deepcopy(document)
        for path, value in edits:
            put(gltf, path, value)
        return pack_glb(dump(gltf), binary[:at] + data + binary[at + len(data) :])

    yield _glb("NaN position", "not_finite", "accessors[0]", patched(offset[0] + 16, FLOAT32_NAN))
    yield _glb("infinite position", "not_finite", "accessors[0]", patched(offset[0], FLOAT32_INF))
    yield _glb("NaN normal", "not_finite", "accessors[1]", patched(offset[1], FLOAT32_NAN))
    yield _glb("NaN colour", "not_finite", "accessors[2]", patched(offset[2], FLOAT32_NAN))
    yield _glb("a position of 3e38", "overflow", "meshes[0]", patched(offset[0], FLOAT32_HUGE))
    yield _glb(
        "a position of 3e38 in a mesh used once",
        "overflow",
        "node 'floor' (nodes[0])",
        patched(offset[0], FLOAT32_HUGE, ("nodes/2/mesh", REMOVE)),
    )
    place = "meshes[0].primitives[0].indices"
    yield _glb("vertex index out of range", "index_out_of_range", place, patched(offset[3] + 5, b"\x04"))
    yield _glb("primitive restart", "primitive_restart", place, patched(offset[3] + 5, b"\xff"))
    for component, dtype in ((5123, "<H"), (5125, "<I")):
        largest = struct.pack(dtype, 256 ** struct.calcsize(dtype) - 1) * 3
        end = len(binary) + -len(binary) % 4
        view = {"buffer": 0, "byteOffset": end, "byteLength": len(largest)}
        edits = (
            ("bufferViews/3", view),
            ("buffers/0/byteLength", end + len(largest)),
            ("accessors/3/componentType", component),
            ("accessors/3/count", 3),
        )
        data = patched(len(binary), bytes(end - len(binary)) + largest, *edits)
        yield _glb(f"primitive restart in {len(largest) // 3} bytes", "primitive_restart", place, data)
    yield _edit("indices not a multiple of 3", "bad_count", place, ("accessors/3/count", 5))
    yield _edit("vertices not a multiple of 3", "bad_count", "meshes[0].primitives[0]", ("meshes/0/primitives/0/indices", REMOVE))
    yield _edit("a strip of 2", "bad_count", place, ("accessors/3/count", 2), ("meshes/0/primitives/0/mode", 5))
    yield _edit("fewer normals than positions", "count_mismatch", f"{attributes}.NORMAL", ("accessors/1/count", 3))
    yield _edit("fewer colours than positions", "count_mismatch", f"{attributes}.COLOR_0", ("accessors/2/count", 3))
    custom = ("meshes/0/primitives/0/attributes/_CUSTOM", 3)
    yield _edit("a custom attribute of another count", "count_mismatch", f"{attributes}.'_CUSTOM'", custom)
    wrong: tuple[tuple[str, Any], ...]
    for name, accessor, wrong in (
        ("positions of VEC2", "POSITION", (("accessors/0/type", "VEC2"),)),
        ("positions of ushort", "POSITION", (("accessors/0/componentType", 5123),)),
        ("normals of VEC4", "NORMAL", (("accessors/1/type", "VEC4"), ("accessors/1/count", 3), ("accessors/0/count", 3))),
        ("normals of short", "NORMAL", (("accessors/1/componentType", 5122), ("accessors/1/normalized", True))),
        ("colours of ubyte that are not normalised", "COLOR_0", (("accessors/2/componentType", 5121),)),
        ("colours of short", "COLOR_0", (("accessors/2/componentType", 5122), ("accessors/2/normalized", True))),
        ("colours of VEC2", "COLOR_0", (("accessors/2/type", "VEC2"),)),
        ("colours of uint", "COLOR_0", (("accessors/2/componentType", 5125),)),
        ("texture coordinates of VEC3", "TEXCOORD_0", (("meshes/0/primitives/0/attributes/TEXCOORD_0", 1),)),
        ("no data for positions", "POSITION", (("accessors/0/bufferView", REMOVE),)),
    ):
        yield _edit(name, "bad_accessor", f"{attributes}.{accessor}", *wrong)
    floats = (("accessors/3/componentType", 5126), ("accessors/3/count", 1))
    yield _edit("indices of byte", "bad_accessor", place, ("accessors/3/componentType", 5120))
    yield _edit("indices of float", "accessor_out_of_view", "accessors[3].count", ("accessors/3/componentType", 5126))
    yield _edit("indices of one float", "bad_accessor", place, *floats)
    yield _edit("indices of VEC2", "bad_accessor", place, ("accessors/3/type", "VEC2"), ("accessors/3/count", 3))
    yield _edit("normalised indices", "bad_accessor", place, ("accessors/3/normalized", True))
    yield _edit("normalised floats", "bad_accessor", "accessors[0].normalized", ("accessors/0/normalized", True))
    without = (("accessors/0/bufferView", REMOVE), ("accessors/0/byteOffset", 4))
    yield _edit("an offset into no view", "bad_accessor", "accessors[0].byteOffset", *without)
    for stride in (0, 2, 10, 256, 1 << 40):
        where = "bufferViews[0].byteStride"
        yield _edit(f"byteStride of {stride}", "bad_stride", where, ("bufferViews/0/byteStride", stride))
    yield _edit("negative byteStride", "out_of_range", "bufferViews[0].byteStride", ("bufferViews/0/byteStride", -12))
    yield _edit("byteStride less than an element", "bad_stride", "accessors[0]", ("bufferViews/0/byteStride", 8))
    yield _edit("byteStride that runs over", "accessor_out_of_view", "accessors[0].count", ("bufferViews/0/byteStride", 16))
    yield _edit("byteStride on indices", "bad_stride", place, ("bufferViews/3/byteStride", 4), ("accessors/3/count", 1))
    yield _edit("misaligned accessor", "misaligned", "accessors[0].byteOffset", ("accessors/0/byteOffset", 2), ("accessors/0/count", 3))
    yield _edit("misaligned view", "misaligned", "accessors[1].byteOffset", ("bufferViews/1/byteOffset", lambda old: old - 2))

    sparse: Json = {
        "count": 2,
        "indices": {"bufferView": 3, "componentType": 5121, "byteOffset": 1},
        "values": {"bufferView": 0},
    }

    def sparse_fault(name: str, slug: str, where: str, *edits: tuple[str, Any]) -> Fault:
        return _edit(f"sparse: {name}", slug, where, ("accessors/0/sparse", copy.deepcopy(sparse)), *edits)

    inside = "accessors/0/sparse"
    yield sparse_fault("count of 1e9", "out_of_range", "accessors[0].sparse.count", (f"{inside}/count", 10**9))
    yield sparse_fault("no values", "missing_key", "accessors[0].sparse.values.bufferView", (f"{inside}/values", REMOVE))
    yield sparse_fault(
        "view out of range", "index_out_of_range", "accessors[0].sparse.indices.bufferView", (f"{inside}/indices/bufferView", 9)
    )
    yield sparse_fault(
        "indices of float", "out_of_range", "accessors[0].sparse.indices.componentType", (f"{inside}/indices/componentType", 5126)
    )
    yield sparse_fault("indices overrun", "accessor_out_of_view", "accessors[0].sparse.indices.count", (f"{inside}/indices/byteOffset", 5))
    yield sparse_fault("values overrun", "accessor_out_of_view", "accessors[0].sparse.values.count", (f"{inside}/values/byteOffset", 40))
    yield sparse_fault("indices fall", "bad_accessor", "accessors[0].sparse.indices", (f"{inside}/indices/byteOffset", 2))
    yield sparse_fault(
        "indices past the end",
        "bad_accessor",
        "accessors[0].sparse.indices",
        ("accessors/0/count", 2),
        *((f"accessors/{i}/count", 2) for i in (1, 2)),
    )
    yield sparse_fault(
        "a million zeros and more", "too_large", "accessors[0].count", ("accessors/0/bufferView", REMOVE), ("accessors/0/count", 10**9)
    )
    primitives: Callable[[list[Any]], list[Any]] = lambda old: old * 2_000  # noqa: E731
    w = GlbWriter()
    w.node(mesh=w.mesh("m", [Part([[0, 0, 0]] * 3, [0] * 600_000)]))
    many = w.document()
    put(many, "meshes/0/primitives", primitives)
    yield _glb("one index list 2,000 times", "too_large", "meshes", pack_glb(dump(many), bytes(w._binary)))


def _texture_faults() -> Iterator[Fault]:
    """Textures, samplers, images, alpha and texture coordinates."""
    base = "materials[0].pbrMetallicRoughness.baseColorTexture"
    picture = png(np.full((2, 2, 4), 128, np.uint8))

    def of(
        name: str, slug: str, where: str, *edits: tuple[str, Any], image: bytes = picture, files: Mapping[str, bytes] | None = None
    ) -> Fault:
        """A textured square; its fields as in :func:`changed`."""
        w = GlbWriter()
        info = w.transformed(w.texture(image), offset=[0.5, 0])
        part = Part([[0, 0, 0], [1, 0, 0], [1, 1, 0]], material=w.material("m", base_color_texture=info), uvs=[[[0, 0], [1, 0], [1, 1]]])
        w.node(mesh=w.mesh("m", [part]))
        document = w.document()
        for path, value in edits:
            put(document, path, value)
        glb = pack_glb(dump(document), bytes(w._binary))
        return Fault(name, f"gltf.{slug}", where, {GLB: glb, **(files or {})})

    texture = "materials/0/pbrMetallicRoughness/baseColorTexture"
    transform = f"{texture}/extensions/KHR_texture_transform"
    for path, where in (
        (f"{texture}/index", f"{base}.index"),
        ("textures/0/source", "textures[0].source"),
        ("textures/0/sampler", "textures[0].sampler"),
        ("images/0/bufferView", "images[0].bufferView"),
    ):
        yield of(f"{where} out of range", "index_out_of_range", where, (path, 7))
    value: Any
    for path, where, value in (
        (f"{texture}/texCoord", f"{base}.texCoord", -1),
        ("samplers/0/wrapS", "samplers[0].wrapS", 10496),
        ("samplers/0/wrapT", "samplers[0].wrapT", 0),
        ("samplers/0/magFilter", "samplers[0].magFilter", 9987),
        ("samplers/0/minFilter", "samplers[0].minFilter", 1),
        (f"{transform}/texCoord", f"{base}.extensions.KHR_texture_transform.texCoord", -1),
        (f"{transform}/scale", f"{base}.extensions.KHR_texture_transform.scale[1]", [1, 1e300]),
        ("materials/0/pbrMetallicRoughness/baseColorFactor", "materials[0].pbrMetallicRoughness.baseColorFactor[3]", [1, 1, 1, 1.5]),
    ):
        yield of(f"{where} is {value}", "out_of_range", where, (path, value))
    for path, where, value in (
        (texture, base, 0),
        (f"{texture}/index", f"{base}.index", "0"),
        (f"{texture}/texCoord", f"{base}.texCoord", 0.5),
        (f"{transform}/offset", f"{base}.extensions.KHR_texture_transform.offset", [1]),
        (f"{transform}/rotation", f"{base}.extensions.KHR_texture_transform.rotation", "90°"),
        ("images/0/mimeType", "images[0].mimeType", 1),
        ("materials/0/alphaMode", "materials[0].alphaMode", 1),
    ):
        yield of(f"{where} is {value!r}", "wrong_type", where, (path, value))
    yield of("a texture without an index", "missing_key", f"{base}.index", (texture, {}))
    yield of("an image in a bufferView without a mimeType", "missing_key", "images[0].mimeType", ("images/0/mimeType", REMOVE))
    yield of("an image with neither uri nor bufferView", "bad_texture", "images[0]", ("images/0", {}))
    yield of("an image with uri and bufferView", "bad_texture", "images[0]", ("images/0/uri", "a.png"))
    yield of("a texture without a source", "unsupported_image", "textures[0]", ("textures/0/source", REMOVE))
    basisu = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    yield of("a texture of KTX2 alone", "unsupported_image", "textures[0]", ("textures/0", basisu))
    yield of("an image of another type", "unsupported_image", "images[0].mimeType", ("images/0/mimeType", "image/webp"))
    yield of("a set of coordinates that is not there", "missing_texcoord", "meshes[0].primitives[0]", (f"{texture}/texCoord", 1))
    override = (f"{transform}/texCoord", 3)
    yield of("a set that only KHR_texture_transform names", "missing_texcoord", "meshes[0].primitives[0]", override)
    uv = "meshes/0/primitives/0/attributes/TEXCOORD_0"
    yield of("a textured mesh without coordinates", "missing_texcoord", "meshes[0].primitives[0]", (uv, REMOVE))
    for name, data in (
        ("an empty image", b"\0"),
        ("a GIF", b"GIF89a" + bytes(64)),
        ("a PNG of its signature alone", picture[:8]),
        ("a PNG cut in its header", picture[:20]),
        ("a PNG cut in its data", picture[:-20]),
        ("a PNG with a wrong CRC", picture[:45] + bytes([picture[45] ^ 255]) + picture[46:]),
        ("a PNG of 2^30 × 2^30 texels", png_header(1 << 30, 1 << 30) + picture[33:]),
        ("a PNG of no size", png_header(0, 0) + picture[33:]),
        ("a PNG of 3 bits", png_header(2, 2, 3) + picture[33:]),
        ("a PNG of a palette that it lacks", png_header(2, 2, 8, 3) + picture[33:]),
        ("a PNG of 2^26 texels, nearly all of them missing", png_header(1 << 13, 1 << 13) + picture[33:]),
        ("a JPEG of its signature alone", b"\xff\xd8\xff\xe0" + bytes(16)),
    ):
        yield of(name, "bad_image", "images[0]", image=data)
    large = png_header(1 << 13, (1 << 13) + 1) + picture[33:]
    yield of("a PNG of more than 2^26 texels", "images_too_large", "images[0]", image=large)
    quarter = png_header(1 << 13, 1 << 13) + picture[33:]
    w = GlbWriter()
    triangle = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    materials = [w.material(f"m{i}", base_color_texture=w.texture(quarter)) for i in range(5)]
    w.node(mesh=w.mesh("m", [Part(triangle, material=m, uvs=[[[0, 0], [1, 0], [1, 1]]]) for m in materials]))
    yield _glb("images of more than 2^28 texels together", "images_too_large", "images[4]", w.to_glb())
    yield of("an image file that is not there", "missing_file", "images[0].uri", ("images/0", {"uri": "a.png"}))
    from_file = ("images/0", {"uri": "a.png"})
    yield of("an image file that is no image", "bad_image", "image 'a.png' (images[0])", from_file, files={"a.png": b"no"})
    yield of("a data: URI that is no image", "bad_image", "images[0]", ("images/0", {"uri": "data:image/png;base64,QUJD"}))
    quantized = ("accessors/0/componentType", 5120), ("accessors/0/count", 3)
    yield of("bytes for positions without KHR_mesh_quantization", "bad_accessor", "meshes[0].primitives[0].attributes.POSITION", *quantized)


def _unsupported() -> Iterator[Fault]:
    """What is sound glTF, but not read yet: refused by name."""
    for name in ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu", "VENDOR_secret"):
        required = (("extensionsRequired", [name]), ("extensionsUsed", [name]))
        yield _edit(f"requires {name}", "unsupported_extension", "extensionsRequired[0]", *required)
    for where, path in (
        (
            "meshes[0].primitives[0].extensions.KHR_draco_mesh_compression",
            "meshes/0/primitives/0/extensions/KHR_draco_mesh_compression",
        ),
        ("bufferViews[0].extensions.EXT_meshopt_compression", "bufferViews/0/extensions/EXT_meshopt_compression"),
        ("nodes[0].extensions.EXT_mesh_gpu_instancing", "nodes/0/extensions/EXT_mesh_gpu_instancing"),
    ):
        yield _edit(f"uses {path.rpartition('/')[2]}", "unsupported_extension", where, (path, {}))
    yield _edit("a skin", "unsupported_skin", "nodes[0].skin", ("nodes/0/skin", 0), ("skins", [{"joints": [1]}]))
    targets = ("meshes/0/primitives/0/targets", [{"POSITION": 0}])
    yield _edit("morph targets", "unsupported_morph_targets", "meshes[0].primitives[0].targets", targets)
    yield _edit("morph weights of a mesh", "unsupported_morph_targets", "meshes[0].weights", ("meshes/0/weights", [0.5]))
    yield _edit("morph weights of a node", "unsupported_morph_targets", "nodes[0].weights", ("nodes/0/weights", [0.5]))
