"""What a bake keeps and what it leaves out, with the reasons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake_core.occlusion import nothing_occludes
from bake_core.placement import Volume
from bake_core.reach import reach_box, triangles_meeting
from bake_core.scene import NO_TEXTURE, Scene
from bake_core.spec import OUTPUTS, SMALLEST_RESOLUTION, OutputName, Resolution, Spec

F64 = NDArray[np.float64]

# The capture map's side where radiance itself is looked at by nobody but the irradiance filter, and where glossy receivers look at it.
_CAPTURE_DIFFUSE, _CAPTURE_GLOSSY = 16, 64
# Tried where the spec leaves visibility's resolution open.
_VISIBILITY_SIDES = (32, 16, 8)
# Of a texel as it is usually stored: halves of three colours, floats of two moments and half a float of the walls, one float, halves of a
# vector.
_TEXEL_BYTES: dict[OutputName, int] = {"irradiance": 6, "visibility": 10, "radiance": 6, "distance": 4, "normal": 6}


@dataclass(frozen=True)
class LeftOut:
    """One thing that a bake does without.

    Attributes
    ----------
    bytes : int or None
        What that saves before compression; None where it saves no bytes but time.
    """

    what: str
    why: str
    bytes: int | None = None

    def entry(self) -> dict[str, Any]:
        """As the manifest has it."""
        return {"what": self.what, "why": self.why} | ({} if self.bytes is None else {"bytes": self.bytes})


@dataclass(frozen=True)
class Selection:
    """Outputs and resolutions of one bake.

    Attributes
    ----------
    outputs : tuple of str
        What the bundle holds, in DESIGN's order.
    seen : tuple of bool
        By volume: whether its probes see all that they light, so that it has no visibility maps.
    left_out : tuple of LeftOut
        Outputs, with what they would have taken.
    capture : int
        Texels along the radiance (capture) map's side, stored or not.
    irradiance, visibility, distance, normal : int
        Texels along each map's side.
    coarser : tuple of int
        Along the sides that visibility maps may end up with instead, in falling order: none where the spec says how many.
    miss_distance : float
        What the distance map holds where a ray meets nothing: finite, and longer than any hit can be.
    """

    outputs: tuple[OutputName, ...]
    seen: tuple[bool, ...]
    left_out: tuple[LeftOut, ...]
    capture: int
    irradiance: int
    visibility: int
    distance: int
    normal: int
    miss_distance: float
    coarser: tuple[int, ...] = ()

    def keeps(self, output: OutputName) -> bool:
        return output in self.outputs

    def of(self, volume: int) -> tuple[OutputName, ...]:
        """What one volume has of them."""
        return tuple(o for o in self.outputs if o != "visibility" or not self.seen[volume])

    def map_bytes(self, output: OutputName) -> int:
        """What one probe's map takes before compression, border included."""
        sides = {"radiance": self.capture, "irradiance": self.irradiance, "visibility": self.visibility}
        side = sides.get(output, self.distance if output == "distance" else self.normal)
        return (side + 2) ** 2 * _TEXEL_BYTES[output]


def select(scene: Scene, spec: Spec, volumes: Sequence[Volume], probes: Sequence[F64]) -> Selection:
    """Choose outputs: what the spec demands, or what the scene can make use of.

    Parameters
    ----------
    volumes : sequence of Volume
        The spec's, placed.
    probes : sequence of (n, 3) float64
        Where each volume's probes stand, or the corners of a box that holds them; local frame.
    """
    m = scene.materials
    # A metal of roughness 1 reflects as broadly as a matt surface does: its light is looked up in irradiance maps, too.
    shiny = (m.roughness < 1) | (m.metallic_roughness_texture != NO_TEXTURE)
    glossy = bool(shiny[np.unique(scene.triangle_material)].any())
    reflects = glossy and any(_holds(scene, volume, shiny) for volume in volumes)
    auto = spec.outputs == "auto"
    seen = tuple(auto and nothing_occludes(scene, volume, stand) for volume, stand in zip(volumes, probes, strict=True))
    if auto:
        kept = tuple(o for o in OUTPUTS if o == "irradiance" or (not all(seen) if o == "visibility" else reflects))
    else:
        kept = tuple(o for o in OUTPUTS if o in spec.outputs)
    size = scene.bounds[1] - scene.bounds[0]
    # A power of two above four diagonals, so that the value says of itself that it is no measurement.
    miss = 2.0 ** math.ceil(math.log2(4 * max(float(np.linalg.norm(size)), 1e-6)))
    r = spec.resolution
    sides = visibility_sides(r)
    chosen = Selection(
        outputs=kept,
        seen=seen,
        left_out=(),
        capture=r.radiance or (_CAPTURE_GLOSSY if reflects else _CAPTURE_DIFFUSE),
        irradiance=r.irradiance,
        visibility=sides[0],
        distance=r.distance,
        normal=r.normal,
        miss_distance=miss,
        coarser=sides[1:],
    )
    return replace(chosen, left_out=tuple(_left_out(chosen, volumes, auto, glossy)))


def visibility_sides(resolution: Resolution) -> tuple[int, ...]:
    """What visibility maps may have along their sides, in falling order: one, or where it is left open all that the distance map bears."""
    if resolution.visibility is not None:
        return (resolution.visibility,)
    return tuple(side for side in _VISIBILITY_SIDES if side <= resolution.distance) or (SMALLEST_RESOLUTION,)


def _holds(scene: Scene, volume: Volume, materials: NDArray[np.bool_]) -> bool:
    """Whether any triangle of some materials may lie within a volume's reach."""
    return any(True for _ in triangles_meeting(scene, reach_box(scene, volume), materials))


def _left_out(chosen: Selection, volumes: Sequence[Volume], auto: bool, glossy: bool) -> Iterator[LeftOut]:
    """Outputs that are not kept, why, and what they would have taken."""
    probes = [v.probe_count for v in volumes]
    directions = "no material is glossy (roughness below 1), so nothing reflects single directions"
    if glossy:
        directions = "no surface within the volumes' reach is glossy (roughness below 1), so nothing there reflects single directions"
    for output in OUTPUTS:
        size = chosen.map_bytes(output)
        if output == "visibility" and auto:
            why = "nothing can stand between a probe and a surface: every triangle in reach has all of both on one side"
            if all(chosen.seen):
                yield LeftOut(output, why, sum(probes) * size)
            else:
                for volume, count, seen in zip(volumes, probes, chosen.seen, strict=True):
                    if seen:
                        yield LeftOut(f"{volume.name}: {output}", why, count * size)
        elif output not in chosen.outputs:
            yield LeftOut(output, directions if auto else "not in the spec's outputs", sum(probes) * size)
