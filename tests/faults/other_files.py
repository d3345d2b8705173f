"""Bad zips of scenes, and bad scenes in formats that are not glTF."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from collections.abc import Iterator, Mapping

from tests.faults.fault import FLOAT32_NAN, Fault, changed, dump, sound


def make_zip(entries: Mapping[str, bytes] | list[tuple[str | zipfile.ZipInfo, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip of these files, in their order, with fixed dates."""
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", method) as archive:
        # Of names that occur twice, which is what some faults are about.
        warnings.simplefilter("ignore")
        for name, data in entries.items() if isinstance(entries, Mapping) else entries:
            info = name if isinstance(name, zipfile.ZipInfo) else zipfile.ZipInfo(name)
            info.compress_type = method
            archive.writestr(info, data)
    return out.getvalue()


def zip_faults() -> Iterator[Fault]:
    glb = changed()
    name = "scene.zip"

    def of(what: str, slug: str, where: str, data: bytes) -> Fault:
        return Fault(what, slug, where, {name: data}, name)

    sound_zip = make_zip({"room/scene.glb": glb})
    yield of("a zip without a scene", "scene.no_root", name, make_zip({"readme.txt": b"hello"}))
    yield of("a zip with two scenes", "scene.no_root", name, make_zip({"a.glb": glb, "b/b.gltf": b"{}"}))
    yield of("a zip of a Mac's metadata alone", "scene.no_root", name, make_zip({"__MACOSX/._a.glb": glb}))
    yield of("a zip cut off", "scene.bad_zip", name, sound_zip[:-30])
    damaged = bytearray(sound_zip)
    damaged[80] ^= 0xFF
    yield of("a zip with damaged data", "scene.bad_zip", name, bytes(damaged))
    for path in ("", "../a.glb", "/a.glb", "a/../b.glb", "a\\b.glb", "C:/a.glb", "a//b.glb", "./a.glb", "a\n.glb"):
        info = zipfile.ZipInfo("x")
        info.filename = path
        yield of(f"a zip with a file called {path!r}", "scene.unsafe_zip", f"{name}: {path!r}", make_zip([(info, glb)]))
    link = zipfile.ZipInfo("a.glb")
    link.external_attr = 0o120777 << 16
    yield of("a zip with a link", "scene.unsafe_zip", f"{name}: 'a.glb'", make_zip([(link, b"/etc/passwd")]))
    yield of("a zip that holds a name twice", "scene.bad_zip", f"{name}: 'a.glb'", make_zip([("a.glb", glb), ("a.glb", glb)]))
    yield of("a zip packed by another method", "scene.bad_zip", f"{name}: 'a.glb'", make_zip({"a.glb": glb}, zipfile.ZIP_LZMA))
    encrypted = bytearray(make_zip({"a.glb": glb}))
    encrypted[6] |= 1
    encrypted[encrypted.index(b"PK\x01\x02") + 8] |= 1
    yield of("an encrypted zip", "scene.bad_zip", f"{name}: 'a.glb'", bytes(encrypted))
    yield of("a zip bomb", "scene.zip_too_large", name, make_zip({"a.glb": glb, "b.bin": bytes(1 << 24)}))
    huge = bytearray(make_zip({"a.glb": glb, "b.bin": b"x"}))
    at = huge.rindex(b"PK\x01\x02")
    huge[at + 24 : at + 28] = struct.pack("<I", 0xFFFFFFF0)
    yield of("a zip that says it holds 4 GiB", "scene.zip_too_large", name, bytes(huge))
    many = make_zip({"a.glb": glb, **{f"{i}.txt": b"" for i in range(4096)}}, zipfile.ZIP_STORED)
    yield of("a zip of too many files", "scene.zip_too_large", name, many)
    lying = bytearray(make_zip({"a.glb": glb}))
    at = lying.index(b"PK\x01\x02")
    lying[at + 24 : at + 28] = struct.pack("<I", len(glb) - 8)
    yield of("a zip with a file longer than it says", "scene.bad_zip", name, bytes(lying))
    inside = make_zip({"a.glb": changed(("nodes/0/mesh", 99))})
    yield of("a zip of a bad scene", "gltf.index_out_of_range", "nodes[0].mesh", inside)
    gltf, binary = sound()
    gltf["buffers"][0]["uri"] = "../scene.bin"
    outside = make_zip({"room/scene.gltf": dump(gltf), "scene.bin": binary})
    yield of("a zip whose scene looks above its folder", "gltf.unsafe_uri", "buffers[0].uri", outside)
    yield of("a zip in a zip", "scene.no_root", name, make_zip({"scene.zip": sound_zip}))
    yield of("a zip of nothing", "scene.no_root", name, make_zip({}))
    yield of("a zip of folders alone", "scene.no_root", name, make_zip({"room/": b"", "room/textures/": b""}))
    yield of("a zip of a mesh", "scene.no_root", name, make_zip({"a.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"}))
    yield of("no zip at all", "scene.bad_zip", name, b"hello")
    yield of("a zip with a name in no encoding", "scene.bad_zip", name, make_zip({"ä.glb": glb}).replace("ä".encode(), b"\xff\xfe"))
    for what, magic, offset in (("directory", b"PK\x05\x06", 16), ("file", b"PK\x01\x02", 42)):
        astray = bytearray(make_zip({"a.glb": glb}))
        begin = astray.rindex(magic) + offset
        astray[begin : begin + 4] = struct.pack("<I", 0x7FFFFFFF)
        yield of(f"a zip whose {what} is not where it says", "scene.bad_zip", f"{name}: 'a.glb'", bytes(astray))
    overlapping = bytearray(make_zip({"a.glb": glb, "b.bin": b"x" * 100}))
    begin = overlapping.rindex(b"PK\x01\x02") + 42
    overlapping[begin : begin + 4] = struct.pack("<I", 0)
    yield of("a zip of files in one place", "scene.bad_zip", name, bytes(overlapping))


def mesh_faults() -> Iterator[Fault]:
    def of(what: str, name: str, data: bytes, place: str = "") -> Fault:
        return Fault(what, "scene.bad_mesh", name + place, {name: data}, name)

    corners = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    yield of("an empty OBJ", "a.obj", b"")
    yield of("an OBJ of points", "a.obj", b"v 0 0 0\nv 1 0 0\n")
    yield of("an OBJ of lines", "a.obj", corners + b"l 1 2 3\n")
    yield of("an OBJ of NUL bytes", "a.obj", bytes(64))
    yield of("an OBJ with NaN", "a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    yield of("an OBJ beyond 1e18 m", "a.obj", b"v 0 0 1e30\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for face in (
        b"1 2 9",
        b"1 2 4\nv 1 1 1",
        b"0 1 2",
        b"-4 1 2",
        b"1 2 99999999999999999999",
        b"1.5 2 3",
        b"a b c",
        b"1 2",
        b"",
        b"/1 /2 /3",
    ):
        yield of(f"an OBJ with the face {face.decode()!r}", "a.obj", corners + b"f " + face, ": line 4")
    for vertex in (b"0 0", b"x y z", b"", b"1,5 0 0"):
        yield of(f"an OBJ with the vertex {vertex.decode()!r}", "a.obj", b"v " + vertex + b"\n" + corners + b"f 2 3 4", ": line 1")

    facet = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)

    def stl(count: int, data: bytes, head: bytes = b"") -> bytes:
        return head.ljust(80, b"\0") + struct.pack("<I", count) + data

    yield of("an STL of no bytes", "a.stl", b"")
    yield of("an empty STL", "a.stl", b"solid x\nendsolid x\n")
    yield of("an STL of nothing", "a.stl", bytes(90))
    yield of("a binary STL of no triangles", "a.stl", stl(0, b""))
    yield of("a binary STL cut off", "a.stl", stl(2, facet + facet[:20]))
    yield of("a binary STL with bytes after its end", "a.stl", stl(1, facet + b"more"))
    yield of("a binary STL of 2^32 - 1 triangles", "a.stl", stl(2**32 - 1, facet))
    yield of("a binary STL that begins as ASCII does, cut off", "a.stl", stl(2, facet, b"solid x"))
    yield of("a binary STL with NaN", "a.stl", stl(1, facet[:12] + FLOAT32_NAN + facet[16:]))
    loop = b"solid x\nfacet normal 0 0 1\nouter loop\nvertex %s\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid x\n"
    yield of("an ASCII STL cut off", "a.stl", (loop % b"0 0 0")[:70])
    yield of("an ASCII STL of words", "a.stl", loop % b"a b c")
    yield of("a GLB called .stl", "a.stl", changed())

    def ply(vertices: int, faces: int, data: bytes, kind: bytes = b"ascii") -> bytes:
        head = b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\nelement face %d\n"
        return head % (kind, vertices, faces) + b"property list uchar int vertex_indices\nend_header\n" + data

    triangle = b"0 0 0\n1 0 0\n0 1 0\n3 0 1 %d\n"
    binary = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<B3i", 3, 0, 1, 2)
    little = b"binary_little_endian"
    yield of("an empty PLY", "a.ply", b"")
    yield of("a PLY cut in its header", "a.ply", b"ply\nformat ascii 1.0\nelement vertex 3")
    yield of("a PLY of no known format", "a.ply", ply(3, 1, triangle % 2, b"utf8"))
    yield of("a PLY of more vertices than it says", "a.ply", ply(2, 1, triangle % 2))
    yield of("a PLY of fewer vertices than it says", "a.ply", ply(4, 1, triangle % 2))
    yield of("a PLY of fewer faces than it says", "a.ply", ply(3, 5, triangle % 2))
    yield of("a PLY of 1e18 vertices", "a.ply", ply(10**18, 1, triangle % 2))
    yield of("a PLY of no faces", "a.ply", ply(3, 0, (triangle % 2)[:18]))
    yield of("a PLY that names a vertex too many", "a.ply", ply(3, 1, triangle % 3))
    yield of("a PLY that names a vertex -1", "a.ply", ply(3, 1, triangle % -1))
    yield of("a PLY with NaN", "a.ply", ply(3, 1, (triangle % 2).replace(b"0 1 0\n", b"0 nan 0\n", 1)))
    yield of("a binary PLY cut off", "a.ply", ply(3, 1, binary[:-4], little))
    yield of("a binary PLY with bytes after its end", "a.ply", ply(3, 1, binary + b"more", little))
    yield of("a binary PLY with a face of 255 corners", "a.ply", ply(3, 1, binary[:36] + b"\xff" + binary[37:], little))
    yield of("a PLY of 2e9 vertices", "a.ply", ply(2_000_000_000, 1, binary, little))
    yield of("a GLB called .ply", "a.ply", changed())
    yield Fault("a mesh that is not there", "gltf.missing_file", "a.stl", {}, "a.stl", folders=("a.stl",))
    yield Fault("a scene of no known kind", "gltf.bad_magic", "a.fbx", {"a.fbx": b"Kaydara FBX Binary  \0"}, "a.fbx")
