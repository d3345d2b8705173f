"""Small pictures for tests: rasterised with a volume of even light, and path-traced."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bake_core.bundle import VolumeData
from bake_core.cameras import looking
from bake_core.environment import Environment, no_images, read_environment
from bake_core.gltf.reader import load_scene
from bake_core.gltf.writer import GlbWriter
from bake_core.lights import merge_lights
from bake_core.picture import Picture, path_trace_picture
from bake_core.raster import PIXEL_SAMPLES, Rasterizer
from bake_core.scene import Camera, Scene
from bake_core.spec import Spec, parse_spec
from bake_core.texture_tables import texture_table
from bake_core.tracer import Tracer
from bake_core.vulkan import Device
from tests.baking import THREADS
from tests.conformance import synthetic

QUAD = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float64)  # faces +y


def scene_of(folder: Path, writer: GlbWriter | bytes) -> Scene:
    path = folder / "scene.glb"
    path.write_bytes(writer if isinstance(writer, bytes) else writer.to_glb())
    return load_scene(path)


def spec_of(lights: Sequence[dict[str, Any]] = (), environment: Sequence[float] = (0, 0, 0)) -> Spec:
    volume = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}
    return parse_spec({"volumes": [volume], "lights": list(lights), "environment": {"kind": "constant", "radiance": list(environment)}})


def surroundings(spec: Spec) -> Environment:
    return read_environment(spec.environment, no_images)[0]


def constant_volume(irradiance: Sequence[float]) -> VolumeData:
    volume = synthetic.volume("all", (0, 0, 0), (1, 1, 1), (1, 1, 1), walls=False)
    whole = np.broadcast_to(np.asarray(irradiance, np.float64), (1, 4, 4, 3))
    volume.atlases["irradiance"] = synthetic.atlas("irradiance", whole, (1, 1, 1))
    return volume


def raster(
    scene: Scene, spec: Spec, camera: Camera, volume: VolumeData, width: int = 96, height: int = 54, frames: int = PIXEL_SAMPLES
) -> Picture:
    with Device() as device:
        rasterizer = Rasterizer(device, scene, merge_lights(scene, spec), surroundings(spec).constant, [volume], texture_table(scene))
        return rasterizer.render(camera, width, height, samples=frames)


def eye(position: Sequence[float], target: Sequence[float], yfov: float = 0.9) -> Camera:
    return Camera("eye", looking(position, target), yfov)


def both(scene: Scene, spec: Spec, camera: Camera, samples: int = 256, frames: int = PIXEL_SAMPLES) -> tuple[Picture, Picture]:
    tracer = Tracer.build(scene, spec, surroundings(spec))
    traced = path_trace_picture(tracer, camera, 96, 54, samples=samples, seed=3, max_bounces=1, threads=THREADS)
    return raster(scene, spec, camera, constant_volume((0, 0, 0)), frames=frames), traced
