"""Cube maps onto the octahedral square: areas exactly, surfaces where they are, and a baked room's cube maps against its bake."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bake_core.bundle import read_bundle
from bake_core.cubemaps import FACES, FRAMES, cube_directions, octahedral_radiance, octahedral_surfaces
from bake_core.distances import _distance_kernel
from bake_core.embree import new_rayhit
from bake_core.examples import glossy_cornell
from bake_core.images import write_exr
from bake_core.octahedral import oct_to_dir, texel_directions
from bake_core.prepared import prepare
from bake_core.ray_radiance import path_traced_radiance
from bake_core.scene_files import load_scene
from bake_core.spec import parse_spec
from bake_core.trace_check import Rays
from bake_core.volume_chains import tiles_of
from service.cli import main
from tests.baking import THREADS, bake_example
from tests.conformance.rooms import Room


def test_faces_are_those_of_opengl() -> None:
    for i, (axis, right, down) in enumerate(FRAMES):
        # A left-handed frame, as OpenGL has it.
        np.testing.assert_array_equal(np.cross(right, -down), axis)
        np.testing.assert_array_equal(cube_directions(3)[i, 1, 1], axis)
        np.testing.assert_allclose(cube_directions(3)[i, 1, 2] - axis, 2 / 3 * right)
        np.testing.assert_allclose(cube_directions(3)[i, 2, 1] - axis, 2 / 3 * down)


@pytest.mark.parametrize(("n", "c"), [(8, 8), (6, 5), (4, 16), (16, 3)])
def test_a_texel_is_the_mean_over_its_area(n: int, c: int) -> None:
    """Against 40 × 40 points in each texel, at which the cube texel that they lie in is looked up."""
    faces = np.random.default_rng(1).random((1, 6, c, c, 3)).astype(np.float32)
    found = octahedral_radiance(faces, n)[0]
    fine = (np.arange(40 * n) + 0.5) * 2 / (40 * n) - 1
    w = oct_to_dir(np.stack(np.meshgrid(fine, fine), -1))
    along = w @ FRAMES[:, 0].T
    face = along.argmax(-1)
    u, v = ((w * FRAMES[face, i]).sum(-1) / along.max(-1) for i in (1, 2))
    column, row = (np.clip(((x + 1) / 2 * c).astype(int), 0, c - 1) for x in (u, v))
    expected = faces[0][face, row, column].reshape(n, 40, n, 40, 3).mean((1, 3))
    # Of 1,600 points, those on borders of cube texels are right by half: a few hundredths of a share.
    np.testing.assert_allclose(found, expected, atol=0.02)
    np.testing.assert_allclose(octahedral_radiance(np.full_like(faces, 3), n), 3, rtol=1e-6)


@pytest.mark.parametrize("measure", [64, 15])
def test_surfaces_are_where_they_were(measure: int) -> None:
    room = Room(open_top=True)
    eye = np.array([0.3, 1.1, -0.7])
    rays = cube_directions(measure).reshape(-1, 3)
    distance = room.hit(np.broadcast_to(eye, rays.shape), rays / np.linalg.norm(rays, axis=1, keepdims=True))[0]
    found, normal = octahedral_surfaces(distance.reshape(1, 6, measure, measure), 32)
    w = texel_directions(32).reshape(-1, 3)
    truth, facing = room.hit(np.broadcast_to(eye, w.shape), w)
    both = np.isfinite(truth) & np.isfinite(found[0])
    # Only texels of the cube that an edge runs through can be wrong.
    assert (np.isfinite(truth) == np.isfinite(found[0])).mean() > 1 - 3 / measure
    assert (np.abs(found[0][both] - truth[both]) < 1e-6).mean() > 1 - 6 / measure
    assert (np.abs(normal[0] - facing)[both].max(-1) < 1e-5).mean() > 1 - 6 / measure


def test_cube_maps_of_a_baked_room_give_its_bundle(tmp_path: Path) -> None:
    """Four probes in a room of boxes: captured by path tracing and rays through the texels of faces, then imported."""
    example = glossy_cornell(0.5)
    grid = {"name": "room", "origin": [-0.6, 0.3, 0.7], "spacing": [1.2, 1.4, 1.3], "counts": [2, 2, 1]}
    sides = {"radiance": 32, "distance": 32, "normal": 32}
    stop = {"target_error": None, "max_samples": 16}
    baked = bake_example(tmp_path, example, volumes=[grid], resolution=sides, stop=stop, probes="lattice").volumes[0]
    scene = load_scene(tmp_path / "scene.glb")
    tracer = prepare(scene, parse_spec({"version": 1, "volumes": [grid]})).tracer
    captured = tmp_path / "captured"
    for probe, eye in enumerate(baked.positions()):
        if baked.states[probe] == 0:
            continue
        folder = captured / "room" / str(probe)
        folder.mkdir(parents=True)
        light = cube_directions(48).reshape(-1, 3)
        light /= np.linalg.norm(light, axis=1, keepdims=True)
        rays = Rays(np.broadcast_to(eye, light.shape), light, np.zeros(len(light)))
        radiance = path_traced_radiance(tracer, rays, samples=4, threads=THREADS).mean(0).reshape(6, 48, 48, 3)
        look = cube_directions(64).reshape(-1, 3)
        length = np.linalg.norm(look, axis=1)
        distance, normal = np.empty((1, len(look))), np.empty((1, len(look), 3), np.float32)
        _distance_kernel(
            tracer.tables,
            new_rayhit(),
            eye[None] - tracer.origin,
            look / length[:, None],
            np.zeros(1, np.uint8),
            distance,
            normal,
            np.empty((1, len(look)), np.bool_),
        )
        depth = (distance[0] / length).reshape(6, 64, 64, 1).astype(np.float32)
        for i, face in enumerate(FACES):
            write_exr(folder / f"radiance.{face}.exr", np.ascontiguousarray(radiance[i], np.float32), ("R", "G", "B"))
            write_exr(folder / f"distance.{face}.exr", np.ascontiguousarray(depth[i]), ("Z",))
    description = {"format": "octobake-cubemaps", "version": 1, "distances": "depth", "volumes": [grid], "resolution": sides}
    (captured / "cubemaps.json").write_text(json.dumps(description))
    assert main(["import-cubemaps", str(captured), "-o", str(tmp_path / "imported.zip")]) == 0
    bundle = read_bundle(tmp_path / "imported.zip")
    assert (bundle.manifest["samples"], bundle.manifest["error"]["value"]) == (0, None)
    found = bundle.volumes[0]
    assert found.atlases.keys() == baked.atlases.keys()
    np.testing.assert_array_equal(found.states, baked.states)
    count = int(baked.states.sum())
    tiles = {name: (tiles_of(found.atlases[name], count), tiles_of(baked.atlases[name], count)) for name in baked.atlases}
    apart = {name: np.abs(a - b) for name, (a, b) in tiles.items()}
    # A cube texel is 0.04 rad wide, one ray through its middle decides about a lamp's edge, and noise comes with 16 paths: some per cent.
    a, b = tiles["irradiance"]
    assert np.sqrt(((a - b) ** 2).mean() / (b**2).mean()) < 0.05
    assert a.mean() == pytest.approx(b.mean(), rel=0.02)
    # On flat surfaces exact; at edges a texel of one map lies on the other side of the edge.
    assert (apart["distance"] < 1e-4).mean() > 0.9
    assert (apart["normal"].max(-1) < 2e-3).mean() > 0.9
    assert np.median(apart["visibility"][..., 0]) < 0.01


@pytest.mark.parametrize(
    ("change", "slug"),
    [
        ({"format": "other"}, "cubemaps.invalid"),
        ({"volumes": [{"fit": "scene", "counts": [1, 1, 1]}]}, "cubemaps.invalid"),
        ({"volumes": []}, "cubemaps.invalid"),
        ({"resolution": {"radiance": 7}}, "spec."),
        ({}, "cubemaps.no_probes"),
        (None, "cubemaps.unreadable"),
    ],
)
def test_what_is_wrong_is_told(change: dict[str, object] | None, slug: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}
    if change is not None:
        document = {"format": "octobake-cubemaps", "version": 1, "distances": "ray", "volumes": [grid], **change}
        (tmp_path / "cubemaps.json").write_text(json.dumps(document))
    assert main(["import-cubemaps", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert f"[{slug}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("fault", ["missing", "oblong", "negative", "zero", "not finite"])
def test_what_is_wrong_with_a_face_is_told(fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = {"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}
    document = {"format": "octobake-cubemaps", "version": 1, "distances": "ray", "volumes": [grid]}
    (tmp_path / "cubemaps.json").write_text(json.dumps(document))
    folder = tmp_path / "v0" / "0"
    folder.mkdir(parents=True)
    for face in FACES:
        write_exr(folder / f"radiance.{face}.exr", np.ones((4, 4, 3), np.float32), ("R", "G", "B"))
        write_exr(folder / f"distance.{face}.exr", np.full((4, 4, 1), np.inf, np.float32), ("Z",))
    bad = np.full((4, 4, 3), {"negative": -1, "not finite": np.inf}.get(fault, 1), np.float32)
    if fault == "missing":
        (folder / "radiance.ny.exr").unlink()
    elif fault == "zero":
        write_exr(folder / "distance.ny.exr", np.zeros((4, 4, 1), np.float32), ("Z",))
    else:
        write_exr(folder / "radiance.ny.exr", bad[: 3 if fault == "oblong" else 4], ("R", "G", "B"))
    assert main(["import-cubemaps", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "[cubemaps.bad_face]" in capsys.readouterr().err
