"""Run by an interpreter that has Mitsuba 3, and nothing of ours: renders the radiance of probes' texels. Usage: mitsuba_peer.py WORK.npz.

Speaks with :mod:`bake_core.bench.peers`, one JSON document a line: first what it is, then an answer to each ``{"samples", "seed", "out"}``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

# Paths in one wavefront: their state takes some hundred bytes each.
_WAVEFRONT = 1 << 25


class ProbeAtlas(mi.Sensor):  # type: ignore[misc, unused-ignore]
    """A camera whose picture is probes' octahedral tiles beside each other."""

    positions: Any
    side: int
    across: int
    count: int

    def __init__(self, properties: Any) -> None:
        super().__init__(properties)
        size = self.film().size()
        self.width, self.height = int(size.x), int(size.y)

    def sample_ray(self, when: Any, wavelength: Any, place: Any, aperture: Any, active: Any = True) -> Any:
        px, py = place.x * self.width, place.y * self.height
        column, row = mi.UInt32(dr.floor(px / self.side)), mi.UInt32(dr.floor(py / self.side))
        origin = dr.gather(mi.Point3f, self.positions, dr.minimum(row * self.across + column, self.count - 1), active)
        # Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit Vectors": the square folded onto the sphere.
        x, y = 2 * (px / self.side - mi.Float(column)) - 1, 2 * (py / self.side - mi.Float(row)) - 1
        z = 1 - dr.abs(x) - dr.abs(y)
        fold = dr.maximum(-z, 0)
        x += dr.select(x >= 0, -fold, fold)
        y += dr.select(y >= 0, -fold, fold)
        return mi.Ray3f(origin, dr.normalize(mi.Vector3f(x, y, z)), when), mi.Color3f(1)

    def sample_ray_differential(self, when: Any, wavelength: Any, place: Any, aperture: Any, active: Any = True) -> Any:
        ray, weight = self.sample_ray(when, wavelength, place, aperture, active)
        return mi.RayDifferential3f(ray), weight

    def bbox(self) -> Any:
        return mi.BoundingBox3f()


def mesh(name: str, work: Any) -> Any:
    """One material's triangles; its shape's front is its corners' counter-clockwise side, as in glTF."""
    color = work[name + ".color"]
    reflectance: dict[str, Any] = {"type": "rgb", "value": work[name + ".albedo"].tolist()}
    if len(color):
        reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": reflectance}
    if work[name + ".double_sided"]:
        bsdf = {"type": "twosided", "inner": bsdf}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    properties["face_normals"] = True
    if work[name + ".emission"].any():
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": work[name + ".emission"].tolist()}})
    points, triangles = work[name + ".points"], work[name + ".triangles"]
    out = mi.Mesh(name, len(points), len(triangles), props=properties, has_vertex_normals=False, has_vertex_texcoords=False)
    if len(color):
        out.add_attribute("vertex_color", 3, color.ravel())
    parameters = mi.traverse(out)
    parameters["vertex_positions"] = points.ravel()
    parameters["faces"] = triangles.ravel()
    parameters.update()
    return out


def main(path: str) -> None:
    began = time.perf_counter()
    work = np.load(path)
    dr.set_thread_count(int(work["threads"]))
    scene: dict[str, Any] = {"type": "scene", **{str(n): mesh(str(n), work) for n in work["names"]}}
    if work["sky"].any():
        scene["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": work["sky"].tolist()}}
    for i, (direction, irradiance) in enumerate(zip(work["sun_direction"].tolist(), work["sun_irradiance"].tolist(), strict=True)):
        scene[f"sun{i}"] = {"type": "directional", "direction": direction, "irradiance": {"type": "rgb", "value": irradiance}}
    loaded = mi.load_dict(scene)
    positions, side = work["positions"], int(work["side"])
    count = len(positions)
    across = 1 << max(0, int(np.ceil(np.log2(np.sqrt(count)))))
    down = -(-count // across)
    ProbeAtlas.positions = mi.Point3f(*(mi.Float(np.ascontiguousarray(positions[:, k])) for k in range(3)))
    ProbeAtlas.side, ProbeAtlas.across, ProbeAtlas.count = side, across, count
    mi.register_sensor("octobake_probes", ProbeAtlas)
    film = {"type": "hdrfilm", "width": across * side, "height": down * side, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "octobake_probes", "film": {**film, "component_format": "float32"}, "sampler": {"type": "multijitter"}})
    bounces = int(work["max_bounces"])
    # Roulette, unbiased, only where nothing else ends a path.
    integrator = mi.load_dict(
        {"type": "path", "max_depth": bounces + 1 if bounces >= 0 else -1, "rr_depth": 1 << 20 if bounces >= 0 else 5}
    )
    at_once = max(1, _WAVEFRONT // (across * down * side * side))

    def render(samples: int, seed: int) -> Any:
        total: Any = 0
        for i, first in enumerate(range(0, samples, at_once)):
            some = min(at_once, samples - first)
            # Runs of one seed must not share points with those of the next.
            picture = mi.render(loaded, sensor=sensor, integrator=integrator, spp=some, seed=seed + 7919 * i)
            total = total + some * np.array(picture, np.float64)
        tiles = (total / samples).reshape(down, side, across, side, 3).transpose(0, 2, 1, 3, 4)
        return tiles.reshape(across * down, side, side, 3)[:count]

    read = time.perf_counter()
    render(1, 0)
    version = mi.__version__
    tell(name=f"Mitsuba {version}", load=read - began, compile=time.perf_counter() - read)
    for line in sys.stdin:
        wanted = json.loads(line)
        started = time.perf_counter()
        tiles = render(wanted["samples"], wanted["seed"])
        seconds = time.perf_counter() - started
        np.save(wanted["out"], tiles.astype(np.float32))
        tell(seconds=seconds)


# Libraries may write to stdout: answers go where it led at first.
_ANSWERS = os.fdopen(os.dup(1), "w")


def tell(**document: Any) -> None:
    _ANSWERS.write(json.dumps(document) + "\n")
    _ANSWERS.flush()


if __name__ == "__main__":
    os.dup2(2, 1)
    main(sys.argv[1])
