"""How far GLSL is from numpy on each host, for docs/shaders.md: `python -m tests.conformance.hosts_table`, after `make chromium`."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bake_core import irradiance, light_field
from bake_core.bundle import VolumeData
from bake_core.parameters import PARAMETERS
from tests import glsl
from tests.chromium import SWIFTSHADER
from tests.conformance import rooms, synthetic

F64 = NDArray[np.float64]
COUNT = 50000


def sphere(rng: np.random.Generator) -> F64:
    d = rng.normal(size=(COUNT, 3))
    return np.asarray((d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32), np.float64)


def octahedral(host: glsl.Host) -> float:
    """Largest angle between a direction and what it comes back as, radians."""
    directions = sphere(np.random.default_rng(0))
    answer = "void answer(vec4 given[1], out vec4 found[1]) { found[0].xyz = obOctToDir(obDirToOct(given[0].xyz)); }"
    back = host(answer, [directions], 1, ())[:, 0, :3].astype(np.float64)
    return float(np.linalg.norm(np.cross(directions, back), axis=-1).max())


def query(host: glsl.Host, volumes: list[VolumeData]) -> tuple[float, float]:
    """Difference in irradiance as a part of the brightest texel: 99.9th percentile and largest."""
    rng = np.random.default_rng(1)
    positions = (rng.uniform(size=(COUNT, 3)) * [16, 9, 9] - [6, 4, 4.5]).astype(np.float32).astype(np.float64)
    normals = sphere(rng)
    answer = "void answer(vec4 given[2], out vec4 found[1]) { found[0].xyz = obIrradiance(given[0].xyz, given[1].xyz, given[1].xyz); }"
    found = host(answer, [positions, normals], 1, volumes)[:, 0, :3]
    difference = np.abs(found - irradiance.sample(volumes, positions, normals).irradiance).max(-1)
    difference /= max(float(v.atlases["irradiance"].texels.max()) for v in volumes)
    return float(np.quantile(difference, 0.999)), float(difference.max())


def tracing(host: glsl.Host) -> tuple[int, float]:
    """Rays with another verdict, of COUNT; 99.9th percentile of the difference in distance where both hit, metres."""
    room = rooms.Room(solids=(((-1.2, 0.0, -1.0), (-0.3, 1.7, -0.2)), ((0.4, 0.0, 0.3), (1.1, 0.8, 1.3))), open_top=True)
    volumes = [rooms.volume(room, (-1.5, 0.5, -1.5), (1.0, 1.0, 1.0), (4, 3, 4), n=32, light=8, moved=0.2)]
    o, d = rooms.rays(room, COUNT, seed=3)
    expected = light_field.trace(light_field.light_field(volumes), o, d)
    answer = """
    void answer(vec4 given[2], out vec4 found[1]) {
        ObTrace seen = obTrace(given[0].xyz, given[1].xyz);
        found[0] = vec4(seen.distance, vec3(float(seen.verdict)));
    }
    """
    found = host(answer, [o, d], 1, volumes)[:, 0]
    hit = (found[:, 1] == expected.verdict) & (expected.verdict == light_field.HIT)
    return int((found[:, 1] != expected.verdict).sum()), float(np.quantile(np.abs(found[hit, 0] - expected.distance[hit]), 0.999))


def main() -> None:
    soft = list(synthetic.volumes())
    sharp = [replace(v, parameters=dict(PARAMETERS)) for v in soft]
    print("| host | octahedral map | irradiance, soft shadows | as a bake's | other verdicts | distance |")
    print("|---|---|---|---|---|---|")
    hosts = (("lavapipe", glsl.on_vulkan, None), ("SwiftShader", glsl.on_vulkan, SWIFTSHADER), ("WebGL2", glsl.on_webgl2, None))
    for name, host, driver in hosts:
        os.environ.pop("VK_DRIVER_FILES", None)
        if driver:
            os.environ["VK_DRIVER_FILES"] = str(driver)
        s, b, (others, apart) = query(host, soft), query(host, sharp), tracing(host)
        cells = f"{octahedral(host):.1e} rad | {s[0]:.1e}, {s[1]:.1e} | {b[0]:.1e}, {b[1]:.1e} | {others} of {COUNT} | {apart:.0e} m"
        print(f"| {name} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
