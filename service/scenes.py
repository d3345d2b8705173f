"""Stored scenes, read again: whole for a worker, in outline for whoever only asks where probes would stand."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bake_core.environment import Find
from bake_core.errors import BakeError, SpecError
from bake_core.scene import Scene
from bake_core.scene_files import load_scene_files
from bake_core.spec import ConstantEnvironment, EquirectEnvironment
from service.blobs import DIGEST, Blobs
from service.sandbox import Sandbox

# Outlines hold a scene's nodes, lights and materials but not its geometry: kilobytes each, as a rule. A node takes 450 bytes.
KEPT_OUTLINES, KEPT_NODES = 64, 100_000
# Read one at a time: the largest takes 1 GB for a moment.
_one_sky = threading.Lock()


def load_stored(blobs: Blobs, scene: Mapping[str, Any]) -> Scene:
    """Read a scene from its row's ``root`` and ``files``; the reader checks it again, for a worker takes nobody's word."""
    return load_scene_files(scene["root"], {name: blobs.local_path(digest) for name, digest in scene["files"].items()})


def find_stored(blobs: Blobs) -> Find:
    """Images that a spec names, from the blob store: by digest only, for paths are the sender's."""

    def find(image: str) -> Path:
        if not DIGEST.fullmatch(image):
            raise SpecError(
                "spec.image_not_found", f"{image!r} is not sha256:HEX; put the image as a blob and name it so", "environment.image"
            )
        try:
            return blobs.local_path(image)
        except (BakeError, FileNotFoundError):
            raise SpecError("spec.image_not_found", f"there is no blob {image}; put it with PUT /v1/blobs", "environment.image") from None

    return find


def check_sky(sandbox: Sandbox, blobs: Blobs, environment: ConstantEnvironment | EquirectEnvironment) -> None:
    """Read a spec's environment as a worker will.

    Raises
    ------
    SpecError
        ``spec.image_*``.
    """
    if isinstance(environment, EquirectEnvironment):
        image = find_stored(blobs)(environment.image)
        with _one_sky:
            sandbox.call("read_sky", environment, image, where="environment.image")


class Outlines:
    """The last scenes asked for, of so many nodes together, without their geometry and images."""

    def __init__(self, blobs: Blobs, sandbox: Sandbox) -> None:
        self._blobs = blobs
        self._sandbox = sandbox
        self._kept: OrderedDict[str, Scene] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, digest: str, scene: Mapping[str, Any]) -> Scene:
        """The outline of the scene whose row is `scene`; reads it the first time."""
        with self._lock:
            if digest in self._kept:
                self._kept.move_to_end(digest)
                return self._kept[digest]
        return self.read(scene["root"], {name: self._blobs.local_path(blob) for name, blob in scene["files"].items()})[0]

    def read(self, root: str, files: Mapping[str, Path]) -> tuple[Scene, dict[str, Any]]:
        """Read a scene from files, in a child process; keeps its outline, and answers that and what is in the scene.

        Raises
        ------
        SceneError
        """
        outline, contents = self._sandbox.call("read_outline", root, dict(files), where=root)
        with self._lock:
            self._kept[outline.digest] = outline
            while len(self._kept) > KEPT_OUTLINES or sum(len(kept.nodes) for kept in self._kept.values()) > KEPT_NODES:
                self._kept.popitem(last=False)
        return outline, contents
