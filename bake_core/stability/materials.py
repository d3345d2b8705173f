"""Materials at the ends of their range."""

from __future__ import annotations

import math

from bake_core.gltf.writer import GlbWriter, Part
from bake_core.stability.case import HALF_ROUNDING, SIGMAS, Baker, Case, Result, maps, near, one_probe, samples, sky
from bake_core.stability.scenes import sphere

# Capture texels where radiance is demanded at this side.
_SIDE, _COUNT = 16, 64


def white_sphere(metallic: float, roughness: float, segments: int = 24) -> tuple[bytes, dict[str, object]]:
    """A white sphere with smooth normals, far from its faces', under a sky of 1: irradiance is π everywhere."""
    w = GlbWriter()
    points, triangles = sphere(segments)
    material = w.material("white", (1, 1, 1), metallic=metallic, roughness=roughness)
    w.node("sphere", mesh=w.mesh("sphere", [Part(points, triangles, normals=points, material=material)]))
    return w.to_glb(), {
        "volumes": one_probe((-1.2, -1.2, -1.2), 2.4, (2, 2, 2)),
        "environment": sky(1.0),
        "outputs": ["irradiance", "radiance"],
        "resolution": {"radiance": _SIDE},
        "stop": samples(256),
    }


def _white(metallic: float, roughness: float) -> Case:
    def run(baker: Baker) -> Result:
        found = maps(baker(white_sphere(metallic, roughness), stop=samples(_COUNT))).mean()
        paths = 8 * _SIDE**2 * _COUNT
        # A direction is drawn from half visible normals, half a matt surface's, of which none weighs more than 3 (docs/method.md): with a
        # mean of 1, Bhatia and Davis 2000 limit the variance to (3 - 1)(1 - 0).
        tolerance = SIGMAS * math.sqrt(2 / paths) + HALF_ROUNDING
        return near(
            math.pi, found, tolerance, f"mean irradiance about a sphere that reflects all, π L; 4σ of {paths} paths of weight 0 to 3"
        )

    return Case(f"white, metallic {metallic:g}, roughness {roughness:g}", run)


CASES = (_white(1, 0), _white(1, 1e-4), _white(1, 1), _white(0, 0), _white(0, 1e-4))
