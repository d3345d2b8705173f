"""A path-traced picture: the reference that verification compares with."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import uint32, uint64
from numpy.typing import NDArray

from bake_core.embree import new_rayhit
from bake_core.errors import Cancelled
from bake_core.kernels import CANCELLED, DONE, entry_kernel
from bake_core.progress import Progress, ProgressCallback
from bake_core.sampling import mix64, reverse_bits, sobol_pair
from bake_core.scene import Camera
from bake_core.tracer import Tracer
from bake_core.transport import trace_path

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Picture:
    """Radiance towards a camera, split by where it comes from; row 0 is the top.

    Attributes
    ----------
    direct : (h, w, 3) float32
        Reflected at the first surface straight from punctual and directional lights.
    indirect : (h, w, 3) float32
        Reflected at the first surface, all the rest (emitters and environment included).
    emission : (h, w, 3) float32
        Emitters and environment seen directly.
    hit : (h, w) float32
        Fraction of the pixel's rays that met a surface.
    """

    direct: F32
    indirect: F32
    emission: F32
    hit: F32

    @property
    def whole(self) -> F32:
        return self.direct + self.indirect + self.emission


@entry_kernel
def _picture_kernel(t, ray, eye, axes, first_row, samples, seed, cancelled, out):  # type: ignore[no-untyped-def]
    """Box-filtered pixels of some rows: out (rows, width, 10), sums of emission, direct, indirect and hits.

    `axes` holds the directions of one pixel's step right, one pixel's step down, and of the picture's upper left corner.
    """
    ray_bits = ray.view(np.uint32)
    # At distance 1 before the camera.
    pixel = math.sqrt(axes[0, 0] * axes[0, 0] + axes[0, 1] * axes[0, 1] + axes[0, 2] * axes[0, 2])
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            if cancelled[0]:
                return CANCELLED
            key = mix64(mix64(seed) + (uint64(first_row + row) << uint64(32)) + uint64(column))
            for sample in range(samples):
                index = uint32(sample)
                reversed_index = reverse_bits(index)
                u, v = sobol_pair(reversed_index, key)
                x, y = column + float(u), first_row + row + float(v)
                dx = axes[2, 0] + x * axes[0, 0] + y * axes[1, 0]
                dy = axes[2, 1] + x * axes[0, 1] + y * axes[1, 1]
                dz = axes[2, 2] + x * axes[0, 2] + y * axes[1, 2]
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz, spread = dx / length, dy / length, dz / length, pixel / length
                emitted, direct, indirect, hit, _ = trace_path(
                    t, ray, ray_bits, eye[0], eye[1], eye[2], dx, dy, dz, reversed_index, index, key, True, spread, 0
                )
                for c in range(3):
                    out[row, column, c] += emitted[c]
                    out[row, column, 3 + c] += direct[c]
                    out[row, column, 6 + c] += indirect[c]
                if hit:
                    out[row, column, 9] += 1
    return DONE


def path_trace_picture(
    tracer: Tracer,
    camera: Camera,
    width: int,
    height: int,
    *,
    samples: int,
    seed: int,
    max_bounces: int | None = None,
    threads: int = 1,
    progress: ProgressCallback | None = None,
    cancelled: NDArray[np.uint8] | None = None,
) -> Picture:
    """Path-trace what a camera sees. Camera rays pass through back faces of single-sided surfaces, as a rasteriser's do.

    Parameters
    ----------
    camera : Camera
        World space; `yfov` spans the picture's height.
    samples : int
        Paths per pixel, box-filtered over the pixel.
    max_bounces : int or None
        Scatter events after the camera's ray; None is unbounded.
    cancelled : (1,) uint8, optional

    Raises
    ------
    Cancelled
    """
    tables = tracer.tables._replace(max_bounces=np.int64(np.iinfo(np.int32).max if max_bounces is None else max_bounces))
    right, up, back = camera.matrix[:3, 0], camera.matrix[:3, 1], camera.matrix[:3, 2]
    half = math.tan(camera.yfov / 2)
    step = 2 * half / height
    corner = -back - right * (step * width / 2) + up * half
    axes = np.stack([right * step, -up * step, corner])
    eye = np.ascontiguousarray(camera.matrix[:3, 3] - tracer.origin)
    flag = np.zeros(1, np.uint8) if cancelled is None else cancelled
    sums = np.zeros((height, width, 10))
    done = 0

    def render(row: int) -> int:
        status: int = _picture_kernel(tables, new_rayhit(), eye, axes, row, samples, np.uint64(seed), flag, sums[row : row + 1])
        return status

    with ThreadPoolExecutor(threads) as pool:
        for status in pool.map(render, range(height)):
            if status == CANCELLED:
                raise Cancelled
            done += 1
            if progress is not None:
                progress(Progress("tracing", done / height, samples))
    mean = (sums / samples).astype(np.float32)
    return Picture(direct=mean[..., 3:6], indirect=mean[..., 6:9], emission=mean[..., :3], hit=mean[..., 9])
