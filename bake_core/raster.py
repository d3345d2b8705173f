"""The verification's picture: the scene rasterised with Vulkan, lit by shadow maps and by the reference GLSL module.

What a renderer that uses a bundle would do, only with more samples a pixel: a picture is the mean of many, each moved by a fraction of
a pixel, so that it is box-filtered as the path tracer's is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bake_core.bundle import VolumeData
from bake_core.picture import Picture
from bake_core.probe_textures import probe_module, probe_textures
from bake_core.scene import Camera, Lights, Scene
from bake_core.scene_buffers import light_buffer, material_buffers, mesh_buffers
from bake_core.shader_compiler import compile_glsl, shader_text
from bake_core.shadow_views import NEAR, Batch, batches, corners, view_matrices
from bake_core.texture_tables import TextureTable
from bake_core.volume_chains import traceable
from bake_core.vulkan import Bindings, Buffer, Commands, Device, Image, color_target, depth_target, graphics_pipeline, storage

F64 = NDArray[np.float64]

# Bindings of shaders/verification; the volumes' textures follow.
_FIRST_PROBE_BINDING = 15
# Samples a pixel: silhouettes and shadows then err by a sixteenth of a pixel, about what the path tracer's noise leaves of them.
PIXEL_SAMPLES = 16


class Rasterizer:
    """A scene and a bundle's volumes on a device, ready for pictures.

    Parameters
    ----------
    device : Device
    scene : Scene
    lights : Lights
        All that shine, the spec's included, in the scene's local frame.
    environment : (3,) float
        Radiance of the background.
    volumes : sequence of VolumeData
        Each with an irradiance atlas.
    textures : TextureTable or None
        The scene's, as :func:`bake_core.textures.texture_table` makes it.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        lights: Lights,
        environment: ArrayLike,
        volumes: Sequence[VolumeData],
        textures: TextureTable | None,
    ) -> None:
        self._device = device
        self._origin = scene.origin
        self._bounds = scene.bounds - scene.origin
        self._diagonal = float(np.linalg.norm(self._bounds[1] - self._bounds[0])) or 1.0
        self._lights = lights
        self._environment = np.asarray(environment, np.float64)
        self._flags = float((len(scene.normals) > 0) + 2 * (len(scene.colors) > 0))
        self._batches, size = batches(lights)
        layers = max((b.views for b in self._batches), default=1)
        self._shadows = depth_target(device, size, size, layers, sampled=True)
        self._views = storage(device, layers * 128)
        meshes, self._draws = mesh_buffers(device, scene)
        resources: list[Buffer | Image] = [
            *meshes,
            *material_buffers(device, scene, textures),
            light_buffer(device, lights, self._batches),
            self._views,
            self._shadows,
        ]
        assert len(resources) == _FIRST_PROBE_BINDING
        bindings = Bindings(device, [*resources, *probe_textures(device, volumes)])
        holes = textures is not None and len(textures.alpha_mode) > 0
        vertex_head = "#version 450\n" + shader_text("verification/scene.glsl")
        shadow = compile_glsl(vertex_head + shader_text("verification/shadow.vert"), "vert", "shadow.vert")
        cut = compile_glsl(_fragment_shader("shadow.frag", "textures.glsl"), "frag", "shadow.frag") if holes else None
        vertex = compile_glsl(vertex_head + shader_text("verification/picture.vert"), "vert", "picture.vert")
        fragment = compile_glsl(picture_fragment_shader(volumes, scene.origin, holes=holes), "frag", "picture.frag")
        self._shadow_program = graphics_pipeline(device, shadow, cut, bindings, 0)
        self._program = graphics_pipeline(device, vertex, fragment, bindings, 3)
        self._targets: dict[tuple[int, int], _Targets] = {}

    def render(self, camera: Camera, width: int, height: int, *, samples: int = PIXEL_SAMPLES) -> Picture:
        """What a camera (in world space) sees. Back faces of single-sided surfaces are culled.

        Returns
        -------
        Picture
            As :func:`bake_core.picture.path_trace_picture` gives.
        """
        if not self._draws:
            return _empty(self._environment, width, height)
        targets = self._targets_of(width, height)
        lens = _Lens.make(camera, self._origin, NEAR * self._diagonal, width, height)
        sums = np.zeros((3, height, width, 4))
        receivers = self._visible(lens, targets)
        for n, batch in enumerate(self._batches or [Batch(0, 0, 0)]):
            self._draw_shadows(batch, receivers)
            for i in range(samples):
                shift = ((i + 0.5) / samples - 0.5, _radical_inverse(i) + 0.5 / samples - 0.5)
                self._draw(lens, targets, shift, (batch.first, batch.last, i))
                # Later batches add direct light only: the rest is the same each time.
                for k in range(3 if n == 0 else 1):
                    sums[k] += targets.download[k].read(np.float32, (height, width, 4))
        mean = (sums / samples).astype(np.float32)
        return Picture(direct=mean[0, ..., :3], indirect=mean[1, ..., :3], emission=mean[2, ..., :3], hit=mean[2, ..., 3])

    def glimpse(self, camera: Camera, width: int, height: int) -> tuple[Picture, F64]:
        """A quick look through pixel centres.

        Returns
        -------
        picture : Picture
            Without direct light.
        points : (height, width, 3) float64
            What is seen, world, metres; NaN where nothing is.
        """
        if not self._draws:
            return _empty(self._environment, width, height), np.full((height, width, 3), np.nan)
        targets = self._targets_of(width, height)
        lens = _Lens.make(camera, self._origin, NEAR * self._diagonal, width, height)
        self._draw(lens, targets, (0.0, 0.0), (0, 0, 0))
        direct, indirect, emission = (b.read(np.float32, (height, width, 4)) for b in targets.download)
        picture = Picture(direct[..., :3], indirect[..., :3], emission[..., :3], emission[..., 3])
        return picture, self._points(lens, targets, 0.0) + self._origin

    def _targets_of(self, width: int, height: int) -> _Targets:
        if (width, height) not in self._targets:
            self._targets[width, height] = _Targets.make(self._device, width, height)
        return self._targets[width, height]

    def _points(self, lens: _Lens, targets: _Targets, shift: float) -> F64:
        """Points of the local frame that were last drawn, (height, width, 3), NaN where none was; `shift` as it was drawn."""
        height, width = targets.depth.height, targets.depth.width
        self._device.run(lambda commands: commands.download(targets.depth, targets.download[0]))
        depth = targets.download[0].read(np.float32, (height, width)).astype(np.float64)
        distance = np.divide(lens.near, depth, out=np.full_like(depth, np.nan), where=depth > 0)
        x, y = np.meshgrid(np.arange(width) + 0.5 + shift, np.arange(height) + 0.5 + shift)
        return lens.points(x, y, distance)

    def _visible(self, lens: _Lens, targets: _Targets) -> F64:
        """Points on what the picture shows, for shadow maps to be fitted to; the scene's corners where it shows nothing."""
        found = []
        # Opposite corners of the pixels: towards a horizon, half a pixel is a long way.
        for shift in (-0.5, 0.5):
            self._draw(lens, targets, (shift, shift), (0, 0, 0))
            points = self._points(lens, targets, shift)
            found.append(points[np.isfinite(points[..., 0])])
        seen = np.concatenate(found)
        return seen if len(seen) else corners(self._bounds)

    def _draw_shadows(self, batch: Batch, receivers: F64) -> None:
        if not batch.views:
            return
        matrices = view_matrices(self._lights, batch, self._bounds, receivers, self._shadows.width)
        pairs = np.stack([matrices, np.linalg.inv(matrices)], 1)
        self._views.write(pairs.swapaxes(-1, -2).astype(np.float32))  # GLSL's matrices are stored by columns

        def record(commands: Commands) -> None:
            for layer, matrix in enumerate(matrices):
                push = _push(matrix, [0, 0, 0, self._flags])
                commands.draw(self._shadow_program, self._draws, push, depth=self._shadows, layer=layer)

        self._device.run(record)

    def _draw(self, lens: _Lens, targets: _Targets, shift: tuple[float, float], numbers: tuple[int, int, int]) -> None:
        """One frame, with the lights [first, last); its number is the third."""
        push = _push(lens.projection(*shift), [*lens.eye, self._flags], numbers, 2 * lens.tangents[1] / lens.height)
        r, g, b = (float(x) for x in self._environment)

        def record(commands: Commands) -> None:
            clear = [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (r, g, b, 0.0)]
            commands.draw(self._program, self._draws, push, colors=targets.colors, depth=targets.depth, clear=clear)
            for image, buffer in zip(targets.colors, targets.download, strict=True):
                commands.download(image, buffer)

        self._device.run(record)


def picture_fragment_shader(volumes: Sequence[VolumeData], frame: ArrayLike, *, holes: bool) -> str:
    """The verification's fragment shader for a bundle: scene, probes, the reference module, and what uses them.

    Parameters
    ----------
    volumes : sequence of VolumeData
    frame : (3,) float
        World position of the zero of the shader's frame, metres.
    holes : bool
        Whether any surface is cut out or blended: to ask costs every scene's hidden surfaces their early depth test.
    """
    glossy = ("glossy_diffuse.glsl", "glossy_traced.glsl" if traceable(volumes) else "glossy_untraced.glsl")
    probes = probe_module(volumes, _FIRST_PROBE_BINDING, frame) + "\n".join(shader_text(f"verification/{part}") for part in glossy)
    head = "#define HOLES\n" if holes else ""
    return _fragment_shader("picture.frag", "textures.glsl", "gloss.glsl", "lights.glsl", before=head, after=probes)


def _fragment_shader(name: str, *parts: str, before: str = "", after: str = "") -> str:
    pieces = [shader_text(f"verification/{part}") for part in ("scene.glsl", *parts)]
    return "\n".join(("#version 450", before, *pieces, after, shader_text(f"verification/{name}")))


@dataclass(frozen=True)
class _Targets:
    """What one size of picture is drawn into, and where it is read from."""

    colors: list[Image]
    depth: Image
    download: list[Buffer]

    @classmethod
    def make(cls, device: Device, width: int, height: int) -> _Targets:
        colors = [color_target(device, width, height) for _ in range(3)]
        return cls(colors, depth_target(device, width, height), [storage(device, c.bytes) for c in colors])


@dataclass(frozen=True)
class _Lens:
    """A camera in the local frame: `axes` are right, up and back as rows, `tangents` half the picture's width and height at distance 1."""

    eye: F64
    axes: F64
    tangents: tuple[float, float]
    near: float
    width: int
    height: int

    @classmethod
    def make(cls, camera: Camera, origin: F64, near: float, width: int, height: int) -> _Lens:
        axes = camera.matrix[:3, :3].T / np.linalg.norm(camera.matrix[:3, :3], axis=0)[:, None]
        half = math.tan(camera.yfov / 2)
        return cls(camera.matrix[:3, 3] - origin, axes, (half * width / height, half), near, width, height)

    def projection(self, x: float, y: float) -> F64:
        """Local frame to reversed clip space, the sampled point moved by (x, y) pixels to the right and down. (4, 4)."""
        right, up, back = self.axes
        matrix = np.zeros((4, 4))
        matrix[3, :3] = -back
        matrix[3, 3] = back @ self.eye
        matrix[0, :3], matrix[0, 3] = right / self.tangents[0], -right @ self.eye / self.tangents[0]
        matrix[1, :3], matrix[1, 3] = -up / self.tangents[1], up @ self.eye / self.tangents[1]
        matrix[2, 3] = self.near
        matrix[:2] -= np.array([[2 * x / self.width], [2 * y / self.height]]) * matrix[3]
        return matrix

    def points(self, x: NDArray[np.floating], y: NDArray[np.floating], distance: F64) -> F64:
        """Points of the local frame seen at pixels (x, y), so far along the camera's axis."""
        right, up, back = self.axes
        across = (2 * x / self.width - 1) * self.tangents[0] * distance
        down = (2 * y / self.height - 1) * self.tangents[1] * distance
        out: F64 = self.eye + across[..., None] * right - down[..., None] * up - distance[..., None] * back
        return out


def _empty(environment: F64, width: int, height: int) -> Picture:
    nothing = np.zeros((height, width, 3), np.float32)
    return Picture(nothing, nothing, np.broadcast_to(environment.astype(np.float32), nothing.shape).copy(), nothing[..., 0])


def _push(matrix: F64, camera: Sequence[float], numbers: tuple[int, int, int] = (0, 0, 0), pixel: float = 0.0) -> bytes:
    """scene.glsl's ``Push``."""
    floats, integers = np.array([*camera, pixel, 0, 0, 0], np.float32), np.array([*numbers, 0], np.int32)
    return matrix.T.astype(np.float32).tobytes() + floats[:4].tobytes() + integers.tobytes() + floats[4:].tobytes()


def _radical_inverse(i: int) -> float:
    """Van der Corput's sequence in base 2: with i/n, points that are spread evenly in both directions."""
    return int(f"{i:032b}"[::-1], 2) / 2**32
