"""What is done with an uploaded file inside the reader's child process: strangers' bytes meet native code there, and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bake_core.environment import read_environment
from bake_core.scene import Scene
from bake_core.scene_files import load_scene_files
from bake_core.spec import ConstantEnvironment, EquirectEnvironment


def read_outline(root: str, files: Mapping[str, Path]) -> tuple[Scene, dict[str, Any]]:
    """Read a scene whole and strictly; answers it without its geometry and images, and what is in it.

    Raises
    ------
    SceneError
    """
    scene = load_scene_files(root, files)
    contents = {
        "triangles": scene.triangle_count,
        "instances": len(scene.instance_mesh),
        "materials": list(scene.materials.name),
        "lights": len(scene.lights.kind),
        "cameras": [camera.name for camera in scene.cameras],
        "nodes": len(scene.nodes),
        "bounds": scene.bounds.tolist(),
        "ignored": list(scene.ignored),
    }
    # Copies, for a slice would keep the whole array alive.
    arrays = ("positions", "normals", "colors", "uvs", "indices", "triangle_material")
    return replace(scene, **{name: getattr(scene, name)[:0].copy() for name in arrays}, images=()), contents


def read_sky(environment: ConstantEnvironment | EquirectEnvironment, image: Path) -> None:
    """Read a spec's environment, whose image lies at `image`, as a worker will.

    Raises
    ------
    SpecError
        ``spec.image_*``.
    """
    read_environment(environment, lambda _: image)
