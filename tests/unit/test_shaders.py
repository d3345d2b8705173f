"""The GLSL module on each host: against the numpy twin, and its octahedral map against float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bake_core import irradiance, light_field
from bake_core.octahedral import dir_to_oct, oct_to_dir
from bake_core.parameters import PARAMETERS
from bake_core.shader_compiler import compile_glsl
from tests import compile_shaders
from tests.conformance import rooms, synthetic
from tests.conformance.rooms import Room
from tests.glsl import Host, on_webgl2

QUERY = """
void answer(vec4 given[3], out vec4 found[2]) {
    vec3 position = given[0].xyz, normal = given[1].xyz, wo = given[2].xyz;
    found[0] = vec4(obIrradiance(position, normal, wo), float(obSelectVolume(position)));
    found[1] = vec4(obIrradianceToward(position, normal, wo, -wo), 0.0);
}
"""
TRACE = """
void answer(vec4 given[3], out vec4 found[3]) {
    ObTrace seen = obTraceRadiance(given[0].xyz, given[1].xyz, given[2].x);
    found[0] = vec4(seen.radiance, seen.distance);
    found[1] = vec4(seen.normal, float(seen.verdict));
    found[2] = vec4(vec3(seen.probe), float(seen.volume));
}
"""
OCTAHEDRAL = """
void answer(vec4 given[1], out vec4 found[2]) {
    vec2 p = obDirToOct(given[0].xyz);
    found[0] = vec4(p, 0.0, 0.0);
    found[1] = vec4(obOctToDir(p), 0.0);
}
"""


def test_the_irradiance_query_agrees_with_its_numpy_twin(host: Host) -> None:
    volumes = synthetic.volumes()
    points = synthetic.points(20000)
    found, toward = host(QUERY, points, 2, volumes).swapaxes(0, 1)
    expected = irradiance.sample(volumes, *points)
    behind = irradiance.sample(volumes, *points, toward=-points[2]).irradiance
    # Volumes meet no point of the set at their borders but exactly, where both sides decide alike.
    np.testing.assert_array_equal(found[:, 3], expected.volume)
    difference = np.maximum(np.abs(found[:, :3] - expected.irradiance), np.abs(toward[:, :3] - behind)).max(-1)
    brightest = max(float(v.atlases["irradiance"].texels.max()) for v in volumes)
    assert np.isfinite(found).all()
    assert difference.max() < 5e-6 * brightest, f"worst at {points[0][difference.argmax()]}"


def test_the_irradiance_query_agrees_with_its_numpy_twin_in_shadows_as_sharp_as_a_bakes(host: Host) -> None:
    """There, rounding moves a point through a hundred-thousandth of a shadow's width: few points are so near to an edge that it shows."""
    volumes = [replace(volume, parameters=dict(PARAMETERS)) for volume in synthetic.volumes()]
    rng = np.random.default_rng(1)
    positions = (rng.uniform(size=(50000, 3)) * [16, 9, 9] - [6, 4, 4.5]).astype(np.float32).astype(np.float64)
    normals, wo = rng.normal(size=(2, 50000, 3))
    wo *= np.sign((normals * wo).sum(-1, keepdims=True))
    normals, wo = (d / np.linalg.norm(d, axis=-1, keepdims=True) for d in (normals, wo))
    found = host(QUERY, [positions, normals, wo], 2, volumes)[:, 0, :3]
    difference = np.abs(found - irradiance.sample(volumes, positions, normals, wo).irradiance).max(-1)
    brightest = max(float(v.atlases["irradiance"].texels.max()) for v in volumes)
    assert np.quantile(difference, 0.999) < 5e-6 * brightest
    assert difference.max() < 1e-3 * brightest, f"worst at {positions[difference.argmax()]}"


@pytest.mark.parametrize(("n", "normals", "light"), [(64, 64, 16), (18, 12, 8)])
def test_tracing_agrees_with_its_numpy_twin(host: Host, n: int, normals: int, light: int) -> None:
    """Two volumes, probes off their lattice and inside boxes, maps of different resolutions, a roof that is open."""
    room = Room(solids=(((-1.2, 0.0, -1.0), (-0.3, 1.7, -0.2)), ((0.4, 0.0, 0.3), (1.1, 0.8, 1.3))), open_top=True)
    fine = rooms.volume(room, (-0.2, 0.3, -1.4), (0.5, 0.5, 0.5), (3, 5, 6), n=n, normals=normals, light=light, moved=0.3)
    coarse = rooms.volume(room, (-1.5, 0.5, -1.5), (1.0, 1.0, 1.0), (4, 3, 4), n=n, normals=normals, light=light, moved=0.2, name="coarse")
    volumes = (fine, coarse)
    o, d = rooms.rays(room, 20000, seed=3)
    expected = light_field.trace(light_field.light_field(volumes), o, d)
    all_roughness = (0.0, 0.35, 0.9)
    given = [np.tile(o, (3, 1)), np.tile(d, (3, 1)), np.repeat(all_roughness, len(o))[:, None] * np.ones(3)]
    for roughness, found in zip(all_roughness, host(TRACE, given, 3, volumes).reshape(3, len(o), 3, 4), strict=True):
        same = found[:, 1, 3] == expected.verdict
        # A ray along an edge goes to one side of it in float32 and to the other in float64.
        assert same.mean() > 0.9994
        hit = same & (expected.verdict == light_field.HIT) & np.isclose(found[:, 0, 3], expected.distance, rtol=0, atol=1e-4)
        assert hit.sum() > 0.9995 * (same & (expected.verdict == light_field.HIT)).sum()
        np.testing.assert_allclose(found[hit, 1, :3], expected.normal[hit], atol=1e-6)
        light_there = light_field.arriving(volumes, expected, o, d, roughness)
        counts = np.array([v.counts for v in volumes])[found[:, 2, 3].astype(int)]
        probe = (found[:, 2, :3] * np.stack([np.ones(len(o)), counts[:, 0], counts[:, 0] * counts[:, 1]], -1)).sum(-1)
        alike = (probe == expected.probe) & (found[:, 2, 3] == expected.volume)
        assert alike.mean() > 0.997
        alike &= hit | (same & (expected.verdict != light_field.HIT))
        np.testing.assert_allclose(found[alike, 0, :3], light_there[alike], atol=2e-4)
        assert np.isfinite(found[:, 0, :3]).all()


def test_one_volume_is_enough(host: Host) -> None:
    volume = synthetic.volume("alone", (0, 0, 0), (1, 1, 1), (1, 1, 1), seed=9)
    _, normals, wo = synthetic.points(50)
    found = host(QUERY, [normals * 0.3, normals, wo], 2, (volume,))[:, 0]
    expected = irradiance.sample((volume,), normals * 0.3, normals, wo)
    np.testing.assert_allclose(found[:, :3], expected.irradiance, atol=4e-5)


def test_a_volume_with_no_probe_about_a_point_leaves_it_to_the_next(host: Host) -> None:
    coarse = synthetic.volume("coarse", (0, 0, 0), (1, 1, 1), (4, 4, 4), seed=1)
    dead = synthetic.volume("dead", (1, 1, 1), (0.5, 0.5, 0.5), (3, 3, 3), seed=2, inactive=tuple(range(18)))
    positions = np.stack([synthetic.sequence(1000, k * 1000) for k in range(3)], -1) * 3
    normals = np.tile([0.36, 0.48, 0.8], (1000, 1))
    found = host(QUERY, [positions, normals, normals], 2, (coarse, dead))[:, 0, :3]
    expected = irradiance.sample((coarse, dead), positions, normals)
    assert np.abs(found - expected.irradiance).max() < 5e-6 * float(coarse.atlases["irradiance"].texels.max())
    without = irradiance.sample((coarse,), positions, normals).irradiance
    left = (expected.shares[1] == 0) & ((positions > 1) & (positions < 1.5)).all(-1)
    assert left.any()
    np.testing.assert_allclose(expected.irradiance[left], without[left], rtol=1e-14)


def test_as_many_volumes_as_a_spec_may_have(host: Host) -> None:
    """Sixty-four, of different sizes, in a row."""
    volumes = tuple(synthetic.volume(f"v{i}", (2.0 * i, 0, 0), (1, 1, 1), (2, 2 + i % 3, 1 + i % 2), seed=i) for i in range(64))
    position = np.stack([np.arange(64) * 2 + 0.4, np.full(64, 0.3), np.full(64, 0.2)], -1)
    normal = np.tile([0.0, 0.6, 0.8], (64, 1))
    found = host(QUERY, [position, normal, normal], 2, volumes)[:, 0]
    expected = irradiance.sample(volumes, position, normal)
    np.testing.assert_array_equal(found[:, 3], np.arange(64))
    np.testing.assert_allclose(found[:, :3], expected.irradiance, atol=4e-5)


def test_the_octahedral_map_keeps_directions_to_half_a_millionth(host: Host) -> None:
    """A million directions, and the hard ones: axes, fold lines, zeros of both signs, a hair beside them."""
    # A browser takes half a minute to hand over a million.
    count = 100_000 if host is on_webgl2 else 1_000_000
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    spiral = np.stack([np.cos(angle) * np.sqrt(1 - z * z), np.sin(angle) * np.sqrt(1 - z * z), z], -1)
    zeros = np.array([0.0, -0.0, 1e-7, -1e-7, 1e-30, -1e-30])
    hairs = np.array([(x, y, s) for x in zeros for y in zeros for s in (1.0, -1.0)])
    hard = np.concatenate([synthetic.DIRECTIONS, hairs, hairs[:, [0, 2, 1]], hairs[:, [2, 0, 1]]])
    directions = np.concatenate([spiral, hard / np.linalg.norm(hard, axis=-1, keepdims=True)]).astype(np.float32).astype(np.float64)
    found = host(OCTAHEDRAL, [directions], 2, ()).astype(np.float64)
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
