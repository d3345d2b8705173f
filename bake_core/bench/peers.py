"""Other renderers on the same work: what they are given of a scene, and the processes that they run in.

Each has an interpreter of its own, because their Python packages do not live together; neither knows anything of ours.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.errors import BakeError
from bake_core.prepared import Prepared
from bake_core.scene import ALPHA_OPAQUE, LIGHT_DIRECTIONAL, Scene

F32 = NDArray[np.float32]
# Name, the module that shows that it is installed, what is run, and the folder of its environment below `--peers`.
_PEERS = (("Mitsuba", "mitsuba", "mitsuba_peer.py", "mitsuba"), ("Cycles", "bpy", "cycles_peer.py", "cycles"))


@dataclass(frozen=True)
class Found:
    """An installed peer: its interpreter and the program that speaks with us."""

    name: str
    python: Path
    program: Path


def find_peers(folder: Path | None) -> list[Found]:
    """What is installed.

    Parameters
    ----------
    folder : Path or None
        With an environment for each, ``mitsuba`` and ``cycles``; where None, only this interpreter's own packages are looked at.
    """
    found = []
    for name, module, program, environment in _PEERS:
        python = Path(sys.executable) if folder is None else folder / environment / "bin" / "python"
        if (
            python.is_file()
            and subprocess.run([python, "-c", f"import importlib.util as u; exit(not u.find_spec('{module}'))"]).returncode == 0
        ):
            found.append(Found(name, python, Path(__file__).with_name(program)))
    return found


def cannot_render(prepared: Prepared, name: str) -> str | None:
    """Why a peer would render something else than we do; None where it does not.

    Lambert surfaces, emitters, a constant sky and suns mean the same everywhere. Glossy models, filters and shading normals differ.
    """
    scene, lights = prepared.scene, prepared.tracer.lights
    used = np.unique(scene.triangle_material)
    m = scene.materials
    emits = m.emission[used].any(1)
    reasons = (
        (not m.lambert[used].all(), "its glossy materials are other models"),
        (bool(scene.textures), "it has textures, which are filtered in other ways"),
        (bool((m.alpha_mode[used] != ALPHA_OPAQUE).any()), "parts of it are cut out"),
        (bool((m.unlit[used] & (len(scene.colors) > 0)).any()), "it has unlit materials with vertex colours"),
        (bool(scene.normals.any()), "its interpolated normals are treated in other ways"),
        (prepared.tracer.tables.sky is not None, "its sky is a picture"),
        (bool((lights.kind != LIGHT_DIRECTIONAL).any()), "it has point or spot lights"),
        (name == "Mitsuba" and bool((emits & m.double_sided[used]).any()), "it has emitters that shine from both sides"),
    )
    return next((why for holds, why in reasons if holds), None)


def work(prepared: Prepared, threads: int) -> dict[str, Any]:
    """A scene and its probes as plain arrays, all in the scene's local frame.

    Returns
    -------
    dict of str to array
        ``names`` of groups, one a material, and of each ``.points`` (v, 3) and ``.color`` (v, 3 or empty: albedo at each) float32,
        ``.triangles`` (t, 3) uint32, ``.albedo`` and ``.emission`` (3,), ``.double_sided``; ``sky`` (3,); ``sun_direction`` and
        ``sun_irradiance`` (n, 3); ``positions`` (p, 3) of probes, and as grids ``origin``, ``spacing``, ``counts`` (g, 3); ``side`` in
        texels; ``max_bounces``, -1 for no limit; ``threads``.
    """
    scene, m = prepared.scene, prepared.scene.materials
    points, triangles, vertex = _flattened(scene)
    corner_material = np.concatenate([scene.triangle_material[slice(*r)] for r in _ranges(scene)] or [np.zeros(0, np.uint32)])
    out: dict[str, Any] = {"names": []}
    for i in np.unique(corner_material):
        name = f"material{i}"
        chosen, renumbered = np.unique(triangles[corner_material == i], return_inverse=True)
        color = np.zeros((0, 3), np.float32)
        if len(scene.colors):
            color = scene.colors[vertex[chosen], :3] * m.base_color[i]
        out["names"].append(name)
        out |= {
            f"{name}.points": points[chosen].astype(np.float32),
            f"{name}.triangles": renumbered.reshape(-1, 3).astype(np.uint32),
            f"{name}.color": np.ascontiguousarray(color, np.float32),
            f"{name}.albedo": m.base_color[i].astype(np.float64),
            f"{name}.emission": m.emission[i].astype(np.float64),
            f"{name}.double_sided": m.double_sided[i],
        }
    lights = prepared.tracer.lights
    shines = lights.value.any(1)
    return out | {
        "sky": prepared.tracer.tables.environment.astype(np.float64),
        "sun_direction": lights.direction[shines].astype(np.float64),
        "sun_irradiance": lights.value[shines].astype(np.float64),
        "positions": prepared.positions.astype(np.float32),
        "origin": np.array([v.origin - scene.origin for v in prepared.volumes], np.float64),
        "spacing": np.array([v.spacing for v in prepared.volumes], np.float64),
        "counts": np.array([v.counts for v in prepared.volumes], np.int64),
        "side": prepared.selection.capture,
        "max_bounces": -1 if prepared.spec.max_bounces is None else prepared.spec.max_bounces,
        "threads": threads,
    }


def _ranges(scene: Scene) -> list[tuple[int, int]]:
    """Triangles of mesh 0, then of each instance's prototype."""
    first = scene.mesh_first_triangle
    return [(int(first[k]), int(first[k + 1])) for k in (0, *scene.instance_mesh.tolist()) if first[k + 1] > first[k]]


def _flattened(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Every instance a mesh of its own: points, triangles, and which of the scene's vertices each point is."""
    first = scene.mesh_first_triangle
    identity = np.eye(3, 4)
    items = [(0, identity), *((int(k), t) for k, t in zip(scene.instance_mesh, scene.instance_transform, strict=True))]
    points, triangles, vertices, total = [], [], [], 0
    for k, transform in items:
        corners = scene.indices[first[k] : first[k + 1]]
        if not len(corners):
            continue
        used, renumbered = np.unique(corners, return_inverse=True)
        points.append(scene.positions[used] @ transform[:, :3].T + transform[:, 3])
        turned = renumbered.reshape(-1, 3) + total
        # A mirror turns corners round; the front stays where it was.
        triangles.append(turned[:, ::-1] if np.linalg.det(transform[:, :3]) < 0 else turned)
        vertices.append(used.astype(np.int64))
        total += len(used)
    if not points:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    return np.concatenate(points), np.concatenate(triangles), np.concatenate(vertices)


class Peer:
    """A running peer. `name` says its version; `load` and `compile` are the seconds that it took to be ready."""

    def __init__(self, process: subprocess.Popen[str], folder: Path, label: str) -> None:
        self._process, self._folder, self._label = process, folder, label
        hello = self._hear()
        self.name, self.load, self.compile = str(hello["name"]), float(hello["load"]), float(hello["compile"])

    def render(self, samples: int, seed: int) -> tuple[F32, float]:
        """Radiance of every probe's texels, (p, side, side, 3), and the seconds that rendering took.

        Raises
        ------
        BakeError
            ``bench.peer_failed``.
        """
        out = self._folder / "tiles.npy"
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"samples": samples, "seed": seed, "out": str(out)}) + "\n")
            self._process.stdin.flush()
        except OSError:
            pass  # it is gone: reading its answer says why
        seconds = float(self._hear()["seconds"])
        return np.load(out), seconds

    def _hear(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            said = (self._folder / "stderr").read_text(errors="replace").strip().splitlines()
            # Compilers name their error first and then go on at length; Python names it last.
            told = next((s for s in said if "ERROR" in s), said[-1] if said else f"exit code {self._process.returncode}")
            raise BakeError("bench.peer_failed", f"it ended: {told}", self._label)
        heard: dict[str, Any] = json.loads(line)
        return heard


@contextmanager
def running(found: Found, given: dict[str, Any], folder: Path) -> Iterator[Peer]:
    """Start a peer on some work, in a folder of its own; it ends with the block.

    Raises
    ------
    BakeError
        ``bench.peer_failed``.
    """
    own = folder / found.name
    own.mkdir()
    np.savez(own / "work.npz", **given)
    with (own / "stderr").open("wb") as errors:
        process = subprocess.Popen(
            [found.python, "-W", "ignore", found.program, own / "work.npz"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
    try:
        yield Peer(process, own, found.name)
    finally:
        process.kill()
        process.communicate()
        shutil.rmtree(own, ignore_errors=True)
