"""Light and lengths of very different size: emission, suns, skies, scenes scaled and moved."""

from __future__ import annotations

import math

import numpy as np

from bake_core.errors import InputError
from bake_core.examples import closed_box, cornell, quads_part
from bake_core.gltf.writer import GlbWriter
from bake_core.images import write_exr
from bake_core.octahedral import texel_directions
from bake_core.stability.case import (
    FLOAT_ROUNDING,
    HALF_ROUNDING,
    SIGMAS,
    Baker,
    Case,
    Result,
    at_most,
    maps,
    near,
    one_probe,
    samples,
    sky,
)
from bake_core.stability.closed_rooms import furnace_sigma
from bake_core.stability.scenes import box, box_with_hole, polygon_vector, scene, under_root

_TEXELS = 256


def dim_beside_bright(baker: Baker) -> Result:
    """Two sealed rooms in one scene, of 1e-6 and of 1e9; lights are chosen by power, so that the dim room's are never drawn."""
    count = 64
    w = GlbWriter()
    for x, emission in ((-3.0, 1e-6), (3.0, 1e9)):
        material = w.material(f"{emission}", (0.5,) * 3, emission=(emission,) * 3)
        w.node(mesh=w.mesh(f"{emission}", [quads_part(list(box(1.0, (x, 0, 0))), material)]))
    volumes = [{"origin": [-3.1, 0.2, -0.3], "spacing": [6.0, 1.0, 1.0], "counts": [2, 1, 1]}]
    mean = maps(baker((w.to_glb(), {"volumes": volumes}), stop=samples(count))).mean((1, 2, 3))
    paths = _TEXELS * count
    tolerance = SIGMAS * furnace_sigma(0.5) / math.sqrt(paths)
    return near(1.0, mean / (2 * math.pi * np.array([1e-6, 1e9])), tolerance, f"either room's irradiance over 2π Le; 4σ of {paths} paths")


def keyhole(baker: Baker) -> Result:
    """A sun of 1e5 straight down through a hole of 1e-4 of the room's 24 m², one bounce: the patch on the floor, seen from ¼ m."""
    half, count, at = 0.025, 65536, (0.1, -0.75, 0.0)
    sun = {"kind": "directional", "direction": [0, -1, 0], "irradiance": [1e5] * 3}
    example = scene(box_with_hole(half), 0.5), {"volumes": one_probe(at), "lights": [sun], "max_bounces": 1}
    irradiance = maps(baker(example, stop=samples(count)))[0, :, :, 0]
    patch = np.array([[-half, -1, -half], [-half, -1, half], [half, -1, half], [half, -1, -half]])
    vector = np.abs(polygon_vector(patch, at)) * np.sign(np.array([0.0, -1.0, 0.0]) - at) * 0.5 * 1e5 / math.pi
    facing = texel_directions(8) @ vector / np.linalg.norm(vector)
    # Receivers that see all of the patch, which is 0.2 rad wide.
    whole = facing > 0.2
    expected = float((facing[whole] * np.linalg.norm(vector)).mean())
    # Capture rays find the patch by chance: as many as fall into its solid angle (dω = dA/|v|³ on the octahedron).
    to = np.array([0.0, -1.0, 0.0]) - at
    distance = float(np.linalg.norm(to))
    hits = _TEXELS * count / 4 / (np.abs(to).sum() / distance) ** 3 * (2 * half) ** 2 * (-to[1] / distance) / distance**2
    tolerance = SIGMAS / math.sqrt(hits) + HALF_ROUNDING
    note = (
        "mean over receivers that see the whole patch, a E/π times Lambert's polygon; "
        f"4σ of the {hits:.0f} rays in {_TEXELS * count} that find it: nothing draws light through a keyhole, so it costs samples"
    )
    return near(expected, irradiance[whole].mean(), tolerance, note)


def tiny_emitter(baker: Baker) -> Result:
    """1 mm × 1 mm of 1e6, 1 m above a probe."""
    half = 0.0005
    square = np.array([[-half, 1, -half], [half, 1, -half], [half, 1, half], [-half, 1, half]])
    bundle = baker((scene([square], 0.0, 1e6), {"volumes": one_probe((0.0, 0.0, 0.0))}), stop=samples(64))
    vector = 1e6 * np.abs(polygon_vector(square, (0, 0, 0))) * [0, 1, 0]
    normals = texel_directions(8)
    above = normals[..., 1] > 0.01
    ratio = maps(bundle)[0, above, 0] / (normals[above] @ vector)
    return near(
        1.0, ratio, HALF_ROUNDING + 1e-5, "every texel above the horizon over Lambert's polygon; half floats, and an emitter 1e-3 rad wide"
    )


def _placed(name: str, *, scale: float = 1.0, translation: float = 0.0) -> Case:
    def run(baker: Baker) -> Result:
        glb, _ = cornell()
        at = np.array([-0.8, 0.25, -0.8])
        grid = [{"origin": at.tolist(), "spacing": [0.5] * 3, "counts": [4, 4, 4]}]
        moved = [{"origin": (at * scale + translation).tolist(), "spacing": [0.5 * scale] * 3, "counts": [4, 4, 4]}]
        plain = baker((glb, {"volumes": grid}), stop=samples(16))
        truth, noise = maps(plain), plain.manifest["error"]["value"]
        bundle = baker((under_root(glb, scale=scale, translation=translation), {"volumes": moved}), stop=samples(16))
        found, other = maps(bundle), bundle.manifest["error"]["value"]
        square = (truth**2).sum(-1)
        difference = math.sqrt((((found - truth) ** 2).sum(-1) / (square + (0.05 * np.sqrt(square).mean()) ** 2)).mean())
        return at_most(
            math.hypot(noise, other), difference, "√mean(|ΔE|²/(E² + (0.05 Ē)²)) against the plain Cornell box; both bakes' own errors"
        )

    return Case(name, run)


def _furnace_at(name: str, *, scale: float = 1.0, translation: float = 0.0) -> Case:
    def run(baker: Baker) -> Result:
        glb, _ = closed_box(0.5, 1.0)
        count = 32
        at = [translation + scale * c for c in (-0.3, 0.2, -0.4)]
        bundle = baker(
            (under_root(glb, scale=scale, translation=translation), {"volumes": one_probe((at[0], at[1], at[2]), scale)}),
            stop=samples(count),
        )
        tolerance = SIGMAS * furnace_sigma(0.5) / math.sqrt(_TEXELS * count) + HALF_ROUNDING
        return near(
            2 * math.pi,
            maps(bundle).mean(),
            tolerance,
            "mean irradiance, 2π Le: a path that slips out, or meets its own wall again, would show; 4σ",
        )

    return Case(name, run)


def white_sky_of_1e7(baker: Baker) -> Result:
    glb = scene([[[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]], 1.0, double_sided=True)
    bundle = baker((glb, {"volumes": one_probe((-0.7, 0.3, -0.6), 1.0, (2, 1, 2)), "environment": sky(1e7)}), stop=samples(16))
    return near(
        math.pi * 1e7, maps(bundle), FLOAT_ROUNDING, "every texel: π L; sums of float32, stored in full because half floats end at 65504"
    )


def nan_in_the_sky(baker: Baker) -> Result:
    texels = np.ones((8, 16, 3), np.float32)
    texels[3, 5, 1] = np.nan
    write_exr(baker.folder / "sky.exr", texels, ("R", "G", "B"))
    glb, spec = closed_box(0.5, 1.0)
    try:
        baker((glb, {**spec, "environment": {"kind": "equirect", "image": "sky.exr"}}), stop=samples(4))
    except InputError as e:
        return Result("spec.image_not_finite", e.slug, 0.0, f"refused, and the texel named: {e.where}")
    return Result("spec.image_not_finite", "baked", 0.0, "a NaN was read")


def denormal_light(baker: Baker) -> Result:
    """A furnace of 1e-40, which float32 holds to 1.4e-45 only, and of a channel of 0."""
    count = 64
    bundle = baker(closed_box(0.5, 1e-40), stop=samples(count))
    expected = 2 * math.pi * float(np.float32(1e-40))
    # Each of a texel's samples and blocks is rounded to a multiple of the smallest denormal.
    quantum = 2.0**-149 * count * _TEXELS / expected
    tolerance = SIGMAS * furnace_sigma(0.5) / math.sqrt(8 * _TEXELS * count) + min(quantum, 1.0)
    return near(expected, maps(bundle).mean(), tolerance, "mean irradiance, 2π Le; sums of denormals keep no digits, and at worst are 0")


def no_light(baker: Baker) -> Result:
    bundle = baker((scene(box_with_hole(0.4), 0.9), {"volumes": one_probe((-0.5, -0.5, -0.5), 1.0, (2, 2, 2))}), stop=samples(16))
    return Result(
        0.0, float(maps(bundle).max() + bundle.manifest["error"]["value"]), 0.0, "largest irradiance, and the error figure: exact"
    )


def no_geometry(baker: Baker) -> Result:
    w = GlbWriter()
    w.node("empty")
    bundle = baker((w.to_glb(), {"volumes": one_probe((0, 0, 0), 1.0, (2, 1, 2)), "environment": sky(2.0)}), stop=samples(16))
    return near(2 * math.pi, maps(bundle), HALF_ROUNDING, "every texel: π L; half floats")


CASES = (
    Case("radiance 1e-6 beside 1e9", dim_beside_bright),
    Case("a sun of 1e5 through a keyhole of 1e-4", keyhole, slow=True),
    Case("an emitter of 1e-6 m²", tiny_emitter),
    _placed("the Cornell box scaled by 1e-4", scale=1e-4),
    _placed("the Cornell box scaled by 1e6", scale=1e6),
    _placed("the Cornell box moved by 1e6 m", translation=1e6),
    _furnace_at("a furnace scaled by 1e-4", scale=1e-4),
    _furnace_at("a furnace scaled by 1e6", scale=1e6),
    _furnace_at("a furnace moved by 1e6 m", translation=1e6),
    Case("a white sky of 1e7", white_sky_of_1e7),
    Case("a NaN texel in the sky", nan_in_the_sky),
    Case("denormal light", denormal_light),
    Case("no light", no_light),
    Case("no geometry", no_geometry),
)
