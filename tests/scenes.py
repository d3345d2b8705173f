"""Small scenes and cameras for tests of transport: made by our own writer, read by our own reader."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.environment import no_images, read_environment
from bake_core.gltf.reader import load_scene
from bake_core.gltf.writer import GlbWriter, Part, look_at
from bake_core.scene import Camera, Scene
from bake_core.spec import parse_spec
from bake_core.stability.scenes import polygon_vector
from bake_core.tracer import Tracer

Array = NDArray[Any]

QUAD = np.array([[0, 1, 2], [0, 2, 3]])
# A unit square in the plane y = 0 about zero, facing up.
SQUARE = np.array([[-0.5, 0, -0.5], [-0.5, 0, 0.5], [0.5, 0, 0.5], [0.5, 0, -0.5]])
ONE_PROBE = {"name": "one", "origin": [0.0, 0.0, 0.0], "spacing": [1.0, 1.0, 1.0], "counts": [1, 1, 1]}


def load_example(glb: bytes) -> Scene:
    """What the reader makes of it, in no folder of the test's."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.glb"
        path.write_bytes(glb)
        return load_scene(path)


def load(writer: GlbWriter) -> Scene:
    """What the reader makes of what the writer wrote."""
    return load_example(writer.to_glb())


def build(scene: Scene | GlbWriter, **spec: Any) -> Tracer:
    """A tracer, with some of the spec's keys given."""
    scene = load(scene) if isinstance(scene, GlbWriter) else scene
    parsed = parse_spec({"volumes": [ONE_PROBE], **spec})
    return Tracer.build(scene, parsed, read_environment(parsed.environment, no_images)[0])


def sky(radiance: float = 1.0) -> dict[str, Any]:
    return {"kind": "constant", "radiance": [radiance] * 3}


def add_square(
    writer: GlbWriter,
    name: str = "square",
    color: Sequence[float] = (0.5, 0.5, 0.5),
    *,
    matrix: ArrayLike | None = None,
    vertex_colors: ArrayLike | None = None,
    **material: Any,
) -> int:
    """A unit square in the plane y = 0, facing up; keywords are the material's."""
    part = Part(SQUARE, QUAD, colors=vertex_colors, material=writer.material(name, color, **material))
    return writer.node(name, mesh=writer.mesh(name, [part]), matrix=matrix)


def square_scene(**material: Any) -> Scene:
    w = GlbWriter()
    add_square(w, **material)
    return load(w)


def icosphere(subdivisions: int) -> tuple[Array, Array]:
    """Vertices on the unit sphere and triangles that face outwards."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)


def camera_at(eye: Sequence[float], target: Sequence[float], *, width: float) -> Camera:
    """A camera whose square picture spans `width` metres at the target."""
    distance = math.dist(eye, target)
    return Camera("test", look_at(eye, target), 2 * math.atan(width / 2 / distance))


def polygon_irradiance(corners: ArrayLike, point: ArrayLike, normal: ArrayLike) -> float:
    """Irradiance at a point from a polygon of radiance 1 that lies wholly above its horizon; positive whichever way the corners run."""
    return abs(float(polygon_vector(corners, point) @ np.asarray(normal, np.float64)))
