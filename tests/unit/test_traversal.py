"""Rays differentially: our kernels' hits against embreex's own queries and against arithmetic."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from bake_core.distances import capture_distance
from bake_core.embree import intersect1, new_rayhit, set_ray
from bake_core.gltf.writer import GlbWriter, Part
from bake_core.octahedral import texel_directions
from bake_core.scene import Scene
from bake_core.surfaces import surface
from tests.scenes import build, load
from tests.unit.gltf_build import face_normals, world_triangles

Array = NDArray[Any]
RESOLUTION = 32
RANDOM_SEED = 7
MISS = 1e9  # metres


def soup(count: int = 1500) -> GlbWriter:
    """Random triangles of very different sizes in a cube of 20 m."""
    random = np.random.default_rng(RANDOM_SEED)
    centre = random.uniform(-10, 10, (count, 1, 3))
    corners = centre + random.normal(size=(count, 3, 3)) * 10 ** random.uniform(-2, 0.5, (count, 1, 1))
    w = GlbWriter()
    material = w.material("paper", (0.5, 0.5, 0.5))
    w.node("soup", mesh=w.mesh("soup", [Part(corners.reshape(-1, 3), np.arange(3 * count), material=material)]))
    return w


def instances() -> GlbWriter:
    """One mesh of two materials, thirty times: turned, stretched, mirrored."""
    random = np.random.default_rng(RANDOM_SEED)
    w = GlbWriter()
    corners = random.normal(size=(20, 3, 3))
    half = np.arange(30)
    parts = [
        Part(corners[:10].reshape(-1, 3), half, material=w.material("one-sided", (0.5,) * 3)),
        Part(corners[10:].reshape(-1, 3), half, material=w.material("two-sided", (0.5,) * 3, double_sided=True)),
    ]
    mesh = w.mesh("shards", parts)
    for _ in range(30):
        matrix = np.eye(4)
        matrix[:3, :3] = random.normal(size=(3, 3)) * 0.5
        matrix[:3, 3] = random.uniform(-8, 8, 3)
        w.node(mesh=mesh, matrix=matrix)
    return w


def embreex_hits(triangles: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Distance (MISS for a miss) and triangle (-1 for a miss) by embreex's own run()."""
    scene = EmbreeScene()
    vertices = triangles.reshape(-1, 3).astype(np.float32)
    TriangleMesh(scene, vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))
    answer = scene.run(origins.astype(np.float32), directions.astype(np.float32), output=True)
    hit = np.asarray(answer["primID"])
    return np.where(hit >= 0, answer["tfar"], MISS), hit


def compare(scene: Scene, probes: Array) -> None:
    """Distance, normal and side of every hit, and every miss."""
    distance, normal, back, _ = capture_distance(build(scene), probes - scene.origin, RESOLUTION, cancelled=np.zeros(1, np.uint8))
    directions = texel_directions(RESOLUTION).reshape(-1, 3)
    origins = np.repeat(probes - scene.origin, len(directions), 0)
    towards = np.tile(directions, (len(probes), 1))
    triangles = world_triangles(scene) - scene.origin
    expected, hit = embreex_hits(triangles, origins, towards)
    found = np.minimum(distance.reshape(-1), MISS)
    # Rays that graze an edge may fall to either side, instances round differently; no more than a few in ten thousand do.
    same = np.abs(found - expected) <= 1e-3 * np.minimum(found, expected)
    assert (~same).mean() < 5e-4
    met = same & (hit >= 0)
    assert met.sum() > 1000 and (same & (hit < 0)).sum() > 1000
    np.testing.assert_allclose(found[met], expected[met], rtol=2e-5, atol=2e-5)
    front = face_normals(triangles)[hit[met]]
    facing = (front * towards[met]).sum(-1)
    side = np.where(facing < 0, 1, -1)[:, None]
    clear = np.abs(facing) > 1e-3  # seen edge-on, rounding chooses the side
    np.testing.assert_allclose(normal.reshape(-1, 3)[met][clear], (front * side)[clear], atol=2e-4)
    one_sided = ~scene.materials.double_sided[_materials(scene)[hit[met]]]
    np.testing.assert_array_equal(back.reshape(-1)[met][clear], ((facing > 0) & one_sided)[clear])
    # And by arithmetic: the point lies in the triangle's plane, as near as a float32 traversal of a stretched instance can tell.
    plane = ((origins[met] + found[met, None] * towards[met] - triangles[hit[met], 0]) * front).sum(-1)
    assert np.abs(plane).max() < 5e-4


def _materials(scene: Scene) -> Array:
    """Material of each triangle of :func:`world_triangles`."""
    first = scene.mesh_first_triangle
    parts = [scene.triangle_material[: first[1]]]
    parts += [scene.triangle_material[first[m] : first[m + 1]] for m in scene.instance_mesh]
    return np.concatenate(parts)


def test_a_soup_of_triangles() -> None:
    compare(load(soup()), np.random.default_rng(1).uniform(-12, 12, (40, 3)))


def test_instances_turned_stretched_and_mirrored() -> None:
    scene = load(instances())
    assert len(scene.instance_mesh) == 30
    compare(scene, np.random.default_rng(2).uniform(-12, 12, (40, 3)))


@numba.njit
def _first_surface(t, ray, x, y, z, dx, dy, dz):  # type: ignore[no-untyped-def]
    bits = ray.view(np.uint32)
    set_ray(ray, bits, x, y, z, dx, dy, dz, np.float32(np.inf))
    intersect1(t.handle, ray.ctypes.data, 0)
    return surface(t, bits, ray, dx, dy, dz)


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_hit_points_lie_in_the_triangle_s_plane_to_float64(scale: float) -> None:
    """Slanted, off zero, a sliver, of any size: point and normal are as good as the float32 corners allow, no worse."""
    corners = np.array([[0.3, 0.1, 5.2], [0.9, 0.4, 5.9], [0.31, 0.11, 5.3], [-0.1, -0.1, 4.1]], np.float32).astype(np.float64) * scale
    w = GlbWriter()
    w.node("t", mesh=w.mesh("t", [Part(corners, [[0, 1, 2], [0, 2, 3]], material=w.material("grey", (0.5,) * 3))]))
    scene = load(w)
    tracer = build(scene)  # its acceleration structure lives as long as it does
    for triangle in scene.positions[scene.indices].astype(np.float64):
        target = triangle.mean(0)
        exact = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        exact /= np.linalg.norm(exact)
        origin = (target + exact * scale).astype(np.float32)
        ray = (target - origin) / np.linalg.norm(target - origin)
        point, normals, *_ = _first_surface(tracer.tables, new_rayhit(), *origin, *ray)
        assert abs(float((np.array(point) - triangle[0]) @ exact)) < 1e-14 * scale
        np.testing.assert_allclose(normals[:3], exact * -np.sign(ray @ exact), atol=1e-13)


def test_the_nearest_of_all_triangles_by_brute_force() -> None:
    """Every ray against every triangle in float64 (Möller and Trumbore 1997), so that no Embree judges itself."""
    scene = load(soup(300))
    probes = np.random.default_rng(3).uniform(-10, 10, (4, 3))
    distance, *_ = capture_distance(build(scene), probes - scene.origin, RESOLUTION, cancelled=np.zeros(1, np.uint8))
    a, b, c = (world_triangles(scene) - scene.origin).transpose(1, 0, 2)
    e, f = b - a, c - a
    directions = texel_directions(RESOLUTION).reshape(-1, 1, 3)
    wrong = 0
    for probe, row in zip(probes - scene.origin, distance, strict=True):
        h = np.cross(directions, f)
        scale = 1 / (e * h).sum(-1)
        s = probe - a
        u = (s * h).sum(-1) * scale
        q = np.cross(s, e)
        v = (directions * q).sum(-1) * scale
        t = (f * q).sum(-1) * scale
        nearest = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf).min(1)
        wrong += int((~(np.isclose(nearest, row, rtol=1e-4) | (np.isinf(nearest) & np.isinf(row)))).sum())
    assert wrong <= 2  # of 4,096, at edges
