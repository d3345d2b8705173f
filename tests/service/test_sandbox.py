"""Hostile files against the reader's child process: it ends, the service does not, and whoever sent the file is told why."""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import signal
import struct
import subprocess
import threading
import zlib
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from bake_core.errors import OctobakeError, SceneError
from service.parts import Service
from service.sandbox import _Answer
from service.scenes import Outlines
from tests.service.running import BOX, InProcess, wait_for


def _forker(service: Service) -> subprocess.Popen[bytes]:
    """The process that forks readers; started where it has not been needed yet."""
    service.sandbox._child().close()
    assert service.sandbox._forker is not None
    return service.sandbox._forker[0]


def children(service: Service) -> list[psutil.Process]:
    assert service.sandbox._forker is not None
    found: list[psutil.Process] = psutil.Process(service.sandbox._forker[0].pid).children()
    return [p for p in found if p.status() != psutil.STATUS_ZOMBIE]


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    """A file whose reading never ends."""
    path = tmp_path / "scene.glb"
    os.mkfifo(path)
    return path


def test_a_file_that_never_ends_is_refused_in_time(service: Service, pipe: Path) -> None:
    service.sandbox._seconds = 1
    with pytest.raises(SceneError) as caught:
        service.outlines.read("scene.glb", {"scene.glb": pipe})
    assert (caught.value.slug, caught.value.where) == ("scene.reader_timeout", "scene.glb")
    assert wait_for(lambda: not children(service), 5)


def test_a_reader_that_crashes_fails_its_own_file_only(service: Service, pipe: Path, box: Path) -> None:
    raised: list[OctobakeError] = []

    def read() -> None:
        try:
            service.outlines.read("scene.glb", {"scene.glb": pipe})
        except OctobakeError as e:
            raised.append(e)

    reading = threading.Thread(target=read)
    reading.start()
    wait_for(lambda: service.sandbox._forker, 20)
    [child] = wait_for(lambda: children(service), 20)
    child.send_signal(signal.SIGSEGV)
    reading.join(20)
    assert [e.slug for e in raised] == ["scene.reader_crashed"]
    assert service.outlines.read("box.glb", {"box.glb": box})[1]["triangles"] == 12


def test_the_process_that_forks_is_started_again(service: Service, box: Path) -> None:
    first = _forker(service)
    first.kill()
    first.wait()
    assert service.outlines.read("box.glb", {"box.glb": box})[1]["triangles"] == 12
    assert _forker(service).pid != first.pid


def test_memory_is_bounded(service: Service, tmp_path: Path) -> None:
    service.sandbox._memory = 1 << 28
    path = tmp_path / "scene.glb"
    with open(path, "wb") as f:
        f.write(BOX[:12])
        f.truncate(1 << 30)
    with pytest.raises(SceneError) as caught:
        service.outlines.read("scene.glb", {"scene.glb": path})
    assert caught.value.slug == "scene.reader_memory"


def test_a_picture_that_swells_is_refused(http: InProcess) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    side = 13000
    # Of 1-bit pixels, so that 21 MB unpack from some 20 KB; as RGBA they would be 676 MB.
    rows = b"".join(packer.compress(bytes(1 + side // 8)) for _ in range(side)) + packer.flush()
    png = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
        + chunk(b"IDAT", rows)
        + chunk(b"IEND", b"")
    )
    assert len(png) < 30_000
    uri = "data:image/png;base64," + base64.b64encode(png).decode()
    document = {
        "asset": {"version": "2.0"},
        "images": [{"uri": uri}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    glb = struct.pack("<III", 0x46546C67, 2, 20 + len(text)) + struct.pack("<II", len(text), 0x4E4F534A) + text
    answer = http.post("/v1/scenes", content=glb, headers={"Content-Type": "model/gltf-binary"})
    assert answer.status_code == 422, answer.text
    assert answer.json()["slug"].split(".")[0] in ("gltf", "scene")


def test_an_answer_that_is_no_outline_calls_nothing() -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.system, ("true",)

    with pytest.raises(SceneError, match="no outline"):
        _Answer(io.BytesIO(pickle.dumps(("done", Evil())))).load()


def test_scenes_of_many_nodes_are_not_kept_by_the_dozen(service: Service) -> None:
    """450 bytes a node: 64 scenes of a million would be 29 GB. One that alone is too large is read each time."""
    asked: list[str] = []

    def call(_: str, root: str, *__: object, **___: object) -> tuple[SimpleNamespace, dict[str, object]]:
        asked.append(root)
        return SimpleNamespace(digest=root, nodes=range(int(root.split("-")[0]) * 1000)), {}

    outlines = Outlines(service.blobs, SimpleNamespace(call=call))  # type: ignore[arg-type]
    for _ in range(2):
        for root in ("40-a", "40-b", "40-c", "1000-d"):
            outlines.get(root, {"root": root, "files": {}})
    outlines.get("1-e", {"root": "1-e", "files": {}})
    outlines.get("1-e", {"root": "1-e", "files": {}})
    assert asked == ["40-a", "40-b", "40-c", "1000-d"] * 2 + ["1-e"]
