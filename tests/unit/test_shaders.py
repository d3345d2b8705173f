"""The GLSL module on lavapipe: against the numpy twin, against the fixtures, and its octahedral map against float64."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bake_core import irradiance, light_field
from bake_core.bundle import VolumeData
from bake_core.octahedral import dir_to_oct, oct_to_dir
from bake_core.probe_textures import probe_module, probe_textures
from bake_core.shader_compiler import compile_glsl, shader_text
from bake_core.vulkan import Bindings, Device, compute_pipeline, storage
from tests import compile_shaders
from tests.conformance import rooms, synthetic
from tests.conformance.rooms import Room

HEADER = """#version 450
layout(local_size_x = 64) in;
layout(set = 0, binding = 0) readonly buffer Inputs { vec4 inputs[]; };
layout(set = 0, binding = 1) writeonly buffer Outputs { vec4 outputs[]; };
layout(push_constant) uniform Push { int count; };
"""
QUERY = """
void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i < count) {
        vec3 position = inputs[3 * i].xyz;
        vec3 normal = inputs[3 * i + 1].xyz;
        vec3 wo = inputs[3 * i + 2].xyz;
        int v = obSelectVolume(position);
        outputs[2 * i] = vec4(obIrradiance(position, normal, wo), float(v));
        outputs[2 * i + 1] = vec4(obIrradianceToward(position, normal, wo, -wo), 0.0);
    }
}
"""
TRACE = """
void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i < count) {
        ObTrace seen = obTraceRadiance(inputs[3 * i].xyz, inputs[3 * i + 1].xyz, inputs[3 * i + 2].x);
        outputs[3 * i] = vec4(seen.radiance, seen.distance);
        outputs[3 * i + 1] = vec4(seen.normal, float(seen.verdict));
        outputs[3 * i + 2] = vec4(vec3(seen.probe), float(seen.volume));
    }
}
"""
OCTAHEDRAL = """
void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i < count) {
        vec2 p = obDirToOct(inputs[i].xyz);
        outputs[2 * i] = vec4(p, 0.0, 0.0);
        outputs[2 * i + 1] = vec4(obOctToDir(p), 0.0);
    }
}
"""


def run(source: str, inputs: Sequence[NDArray[np.float64]], rows: int, volumes: Sequence[VolumeData] = ()) -> NDArray[np.float32]:
    """Run a compute shader over n items of several vec4 each; (n, rows, 4)."""
    n = len(inputs[0])
    packed = np.zeros((n, len(inputs), 4), np.float32)
    packed[..., :3] = np.stack(inputs, 1)
    with Device() as device:
        source_buffer, result = storage(device, packed), storage(device, n * rows * 16)
        probes = probe_textures(device, volumes) if volumes else []
        bindings = Bindings(device, [source_buffer, result, *probes])
        pipeline = compute_pipeline(device, compile_glsl(source, "comp", "test"), bindings)
        device.run(lambda commands: commands.dispatch(pipeline, (n + 63) // 64, np.int32(n).tobytes()))
        return result.read(np.float32, (n, rows, 4))


def query(volumes: Sequence[VolumeData], *points: NDArray[np.float64]) -> NDArray[np.float32]:
    """(n, 2, 4): irradiance and volume; irradiance toward where the viewer does not stand."""
    return run(HEADER + probe_module(volumes, 2) + QUERY, points, 2, volumes)


def test_the_irradiance_query_agrees_with_its_numpy_twin() -> None:
    volumes = synthetic.volumes()
    points = synthetic.points(20000)
    found, toward = query(volumes, *points).swapaxes(0, 1)
    expected = irradiance.sample(volumes, *points)
    behind = irradiance.sample(volumes, *points, toward=-points[2]).irradiance
    # Volumes meet no point of the set at their borders but exactly, where both sides decide alike.
    np.testing.assert_array_equal(found[:, 3], expected.volume)
    difference = np.maximum(np.abs(found[:, :3] - expected.irradiance), np.abs(toward[:, :3] - behind)).max(-1)
    brightest = max(float(v.atlases["irradiance"].texels.max()) for v in volumes)
    assert np.isfinite(found).all()
    assert difference.max() < 5e-6 * brightest, f"worst at {points[0][difference.argmax()]}"


def test_the_irradiance_query_agrees_with_the_fixtures() -> None:
    data = json.loads((Path(__file__).parents[1] / "conformance" / "irradiance.json").read_text(encoding="utf-8"))
    columns = {k: np.array([row[k] for row in data["queries"]]) for k in ("position", "normal", "wo", "irradiance", "volume")}
    found = query(synthetic.volumes(), columns["position"], columns["normal"], columns["wo"])[:, 0]
    np.testing.assert_array_equal(found[:, 3], columns["volume"])
    np.testing.assert_allclose(found[:, :3], columns["irradiance"], atol=4e-5)


@pytest.mark.parametrize(("n", "normals", "light"), [(64, 64, 16), (18, 12, 8)])
def test_tracing_agrees_with_its_numpy_twin(n: int, normals: int, light: int) -> None:
    """Two volumes, probes off their lattice and inside boxes, maps of different resolutions, a roof that is open."""
    room = Room(solids=(((-1.2, 0.0, -1.0), (-0.3, 1.7, -0.2)), ((0.4, 0.0, 0.3), (1.1, 0.8, 1.3))), open_top=True)
    fine = rooms.volume(room, (-0.2, 0.3, -1.4), (0.5, 0.5, 0.5), (3, 5, 6), n=n, normals=normals, light=light, moved=0.3)
    coarse = rooms.volume(room, (-1.5, 0.5, -1.5), (1.0, 1.0, 1.0), (4, 3, 4), n=n, normals=normals, light=light, moved=0.2, name="coarse")
    volumes = (fine, coarse)
    o, d = rooms.rays(room, 20000, seed=3)
    expected = light_field.trace(light_field.light_field(volumes), o, d)
    for roughness in (0.0, 0.35, 0.9):
        found = run(HEADER + probe_module(volumes, 2) + TRACE, [o, d, np.full_like(o, roughness)], 3, volumes)
        same = found[:, 1, 3] == expected.verdict
        # A ray along an edge goes to one side of it in float32 and to the other in float64.
        assert same.mean() > 0.9995
        assert (found[:, 2, 3] == expected.volume).mean() > 0.998
        hit = same & (expected.verdict == light_field.HIT) & np.isclose(found[:, 0, 3], expected.distance, rtol=0, atol=1e-4)
        assert hit.sum() > 0.9995 * (same & (expected.verdict == light_field.HIT)).sum()
        np.testing.assert_allclose(found[hit, 1, :3], expected.normal[hit], atol=1e-6)
        light_there = light_field.arriving(volumes, expected, o, d, roughness)
        counts = np.array([v.counts for v in volumes])[found[:, 2, 3].astype(int)]
        probe = (found[:, 2, :3] * np.stack([np.ones(len(o)), counts[:, 0], counts[:, 0] * counts[:, 1]], -1)).sum(-1)
        alike = (hit | (same & (expected.verdict == light_field.MISS))) & (probe == expected.probe)
        assert alike.mean() > 0.9
        np.testing.assert_allclose(found[alike, 0, :3], light_there[alike], atol=2e-3)
        assert np.isfinite(found[:, 0, :3]).all()


def test_one_volume_is_enough() -> None:
    volume = synthetic.volume("alone", (0, 0, 0), (1, 1, 1), (1, 1, 1), seed=9)
    _, normals, wo = synthetic.points(50)
    found = query((volume,), normals * 0.3, normals, wo)[:, 0]
    expected = irradiance.sample((volume,), normals * 0.3, normals, wo)
    np.testing.assert_allclose(found[:, :3], expected.irradiance, atol=4e-5)


def test_as_many_volumes_as_a_spec_may_have() -> None:
    """Sixty-four, of different sizes, in a row."""
    volumes = tuple(synthetic.volume(f"v{i}", (2.0 * i, 0, 0), (1, 1, 1), (2, 2 + i % 3, 1 + i % 2), seed=i) for i in range(64))
    position = np.stack([np.arange(64) * 2 + 0.4, np.full(64, 0.3), np.full(64, 0.2)], -1)
    normal = np.tile([0.0, 0.6, 0.8], (64, 1))
    found = query(volumes, position, normal, normal)[:, 0]
    expected = irradiance.sample(volumes, position, normal)
    np.testing.assert_array_equal(found[:, 3], np.arange(64))
    np.testing.assert_allclose(found[:, :3], expected.irradiance, atol=4e-5)


def test_the_octahedral_map_keeps_directions_to_half_a_millionth() -> None:
    """A million directions, and the hard ones: axes, fold lines, zeros of both signs, a hair beside them."""
    z = 1 - 2 * (np.arange(1_000_000) + 0.5) / 1_000_000
    angle = np.arange(1_000_000) * np.pi * (3 - np.sqrt(5))
    spiral = np.stack([np.cos(angle) * np.sqrt(1 - z * z), np.sin(angle) * np.sqrt(1 - z * z), z], -1)
    zeros = np.array([0.0, -0.0, 1e-7, -1e-7, 1e-30, -1e-30])
    hairs = np.array([(x, y, s) for x in zeros for y in zeros for s in (1.0, -1.0)])
    hard = np.concatenate([synthetic.DIRECTIONS, hairs, hairs[:, [0, 2, 1]], hairs[:, [2, 0, 1]]])
    directions = np.concatenate([spiral, hard / np.linalg.norm(hard, axis=-1, keepdims=True)]).astype(np.float32).astype(np.float64)
    found = run(HEADER + shader_text("octahedral.glsl") + OCTAHEDRAL, [directions], 2).astype(np.float64)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    decoded = found[:, 1, :3] / np.linalg.norm(found[:, 1, :3], axis=-1, keepdims=True)
    # The cross product, not the scalar one: an arc cosine near 1 cannot tell 1e-7 from 0.
    assert np.linalg.norm(np.cross(unit, decoded), axis=-1).max() < 5e-7
    assert ((unit * decoded).sum(-1) > 0).all()
    encoded = found[:, 0, :2]
    # On the square's edge a point and its mirror image are one direction, so compare what they decode to.
    np.testing.assert_allclose(oct_to_dir(encoded), oct_to_dir(dir_to_oct(unit)), atol=5e-7)
    assert np.abs(encoded).max() <= 1


def test_the_module_compiles_for_both_targets() -> None:
    assert compile_shaders.main() == 0


def test_a_broken_shader_is_an_error_that_says_where() -> None:
    from bake_core.errors import BakeError

    with pytest.raises(BakeError, match="undeclared") as caught:
        compile_glsl("#version 450\nvoid main() {\n    missing = 1;\n}\n", "frag", "broken.frag")
    assert caught.value.slug == "shaders.invalid"
    assert caught.value.message.startswith("3:")
    assert caught.value.where == "broken.frag"
