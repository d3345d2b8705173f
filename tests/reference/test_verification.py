"""A Cornell box baked, rasterised with its bundle, and held against its path-traced twin; and what verification refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core import examples
from bake_core.automatic_cameras import automatic_cameras
from bake_core.bundle import Bundle, read_bundle
from bake_core.cameras import parse_cameras
from bake_core.environment import no_images, read_environment
from bake_core.errors import BundleError, Cancelled, InputError
from bake_core.gltf.reader import load_scene
from bake_core.images import read_exr
from bake_core.irradiance import covered, sample
from bake_core.lights import merge_lights
from bake_core.progress import Progress
from bake_core.raster import Rasterizer
from bake_core.scene import Scene
from bake_core.spec import parse_spec
from bake_core.texture_tables import texture_table
from bake_core.thresholds import Thresholds, load_thresholds
from bake_core.verification import verify
from bake_core.vulkan import Device
from service.cli import main
from tests.baking import THREADS, bake_example

SMALL: dict[str, Any] = {"width": 128, "height": 72, "samples": 64, "threads": THREADS}
TINY: dict[str, Any] = {"width": 32, "height": 18, "samples": 2, "threads": THREADS}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``scene.glb``, and in ``bundle`` what was baked from it."""
    folder = tmp_path_factory.mktemp("cornell")
    bake_example(folder, examples.cornell(), stop={"target_error": None, "max_samples": 32})
    return folder


@pytest.fixture(scope="module")
def bundle(folder: Path) -> Bundle:
    return read_bundle(folder / "bundle")


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder / "scene.glb")


def test_the_cornell_box_lit_by_its_bundle_is_the_path_tracers(bundle: Bundle, scene: Scene, tmp_path: Path) -> None:
    """The limits are this scene's own and only ever tighten."""
    told: list[Progress] = []
    thresholds = load_thresholds(Path(__file__).with_name("cornell.thresholds.json"))
    report = verify(bundle, scene, None, tmp_path / "out", **SMALL, thresholds=thresholds, progress=told.append)
    assert report["failures"] == []
    assert report["passed"]
    assert [c["name"] for c in report["cameras"]] == [c.name for c in scene.cameras]
    assert [p.fraction for p in told] == sorted(p.fraction for p in told)
    assert told[-1].fraction == 1
    assert json.loads((tmp_path / "out" / "verification.json").read_text()) == report
    page = (tmp_path / "out" / "index.html").read_text()
    for camera in report["cameras"]:
        for part in ("whole", "indirect"):
            for name in camera["files"][part].values():
                assert f"{name}.png" in page
                pixels, _ = read_exr(tmp_path / "out" / f"{name}.exr", InputError, "test.unreadable")
                assert pixels.shape == (72, 128, 3)
    assert report["receivers"]["count"] == 2048
    assert report["receivers"]["samples"] == 16 * SMALL["samples"]
    assert f"{report['receivers']['p95']:.4g}" in page
    rows = json.loads((tmp_path / "out" / "receivers.json").read_text())
    answers = sample(bundle.volumes, [r["position"] for r in rows], [r["normal"] for r in rows]).irradiance
    np.testing.assert_allclose(answers, [r["irradiance"] for r in rows])
    first = report["cameras"][0]["files"]["whole"]
    raster, path, difference = (read_exr(tmp_path / "out" / f"{first[k]}.exr", InputError, "test.unreadable")[0] for k in first)
    np.testing.assert_allclose(difference, raster - path, atol=1e-5)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_bundle_whose_light_is_wrong_fails(bundle: Bundle, scene: Scene, tmp_path: Path) -> None:
    """A port that forgets the 1/π, or counts a half twice, is off by more than the default limits allow: so is a fifth too much."""
    brighter = []
    for volume in bundle.volumes:
        atlas = volume.atlases["irradiance"]
        brighter.append(replace(volume, atlases={**volume.atlases, "irradiance": replace(atlas, texels=atlas.texels * np.float32(1.2))}))
    report = verify(replace(bundle, volumes=tuple(brighter)), scene, scene.cameras[:1], tmp_path / "out", **SMALL)
    assert not report["passed"]
    said = report["failures"][0].split()
    assert said[:4] == ["front:", "indirect:", "mean", "ratio"] and 1.15 < float(said[4]) < 1.25
    assert 1.2 < report["receivers"]["mean_ratio"] < 1.27
    assert report["receivers"]["relmse"] > 0.04


def test_a_verification_replaces_an_older_one_and_nothing_else(bundle: Bundle, scene: Scene, tmp_path: Path) -> None:
    (camera,) = parse_cameras([{"name": "given", "position": [0, 1, 0.9], "target": [0, 0.9, 0]}])
    out = tmp_path / "out"
    out.mkdir()
    for _ in range(2):
        verify(bundle, scene, [camera], out, **TINY, thresholds=Thresholds())
    assert (out / "given.raster.png").is_file()
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    with pytest.raises(InputError) as caught:
        verify(bundle, scene, [camera], other, **TINY)
    assert caught.value.slug == "verification.in_the_way"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other", "out"]


@pytest.mark.parametrize(
    ("changes", "slug"),
    [
        ({"width": 8}, "verification.invalid"),
        ({"height": 10000}, "verification.invalid"),
        ({"samples": 3}, "verification.invalid"),
        ({"samples": 0}, "verification.invalid"),
    ],
)
def test_requests_that_make_no_sense_are_refused(bundle: Bundle, scene: Scene, tmp_path: Path, changes: dict[str, int], slug: str) -> None:
    with pytest.raises(InputError) as caught:
        verify(bundle, scene, None, tmp_path / "out", **(TINY | changes))
    assert caught.value.slug == slug
    assert caught.value.where == next(iter(changes))


def test_a_bundle_of_another_scene_or_without_irradiance_is_refused(bundle: Bundle, scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(BundleError) as caught:
        verify(bundle, replace(scene, digest="sha256:0"), None, tmp_path / "out", **TINY)
    assert caught.value.slug == "bundle.other_scene"
    bare = replace(bundle, volumes=tuple(replace(v, atlases={"visibility": v.atlases["visibility"]}) for v in bundle.volumes))
    with pytest.raises(BundleError) as caught:
        verify(bare, scene, None, tmp_path / "out", **TINY)
    assert caught.value.slug == "bundle.no_irradiance"


def test_cancelling_leaves_nothing_behind(bundle: Bundle, scene: Scene, tmp_path: Path) -> None:
    flag = np.zeros(1, np.uint8)

    def cancel(progress: Progress) -> None:
        if progress.stage == "tracing":
            flag[0] = 1

    with pytest.raises(Cancelled):
        verify(bundle, scene, None, tmp_path / "out", **SMALL, progress=cancel, cancelled=flag)
    assert list(tmp_path.iterdir()) == []


def test_automatic_cameras_stand_inside_and_see_something(bundle: Bundle, scene: Scene) -> None:
    spec = parse_spec(bundle.manifest["spec"])
    with Device() as device:
        environment = read_environment(spec.environment, no_images)[0]
        rasterizer = Rasterizer(device, scene, merge_lights(scene, spec), environment.constant, bundle.volumes, texture_table(scene))
        cameras, again = (automatic_cameras(rasterizer, scene, bundle.volumes) for _ in range(2))
        assert 1 < len(cameras) <= 3
        assert len({c.name for c in cameras}) == len(cameras)
        for camera, same in zip(cameras, again, strict=True):
            np.testing.assert_array_equal(camera.matrix, same.matrix)
            assert covered(bundle.volumes, camera.matrix[None, :3, 3]).all()
            picture, points = rasterizer.glimpse(camera, 64, 36)
            assert picture.hit.mean() > 0.5
            assert np.nanmedian(np.linalg.norm(points - camera.matrix[:3, 3], axis=-1)) > 0.4


@pytest.fixture
def cameras_file(tmp_path: Path) -> Path:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([{"name": "one", "position": [0, 1, 0.9], "target": [0, 0.9, 0]}]))
    return path


def test_the_command_says_by_its_exit_code_whether_limits_are_kept(
    folder: Path, cameras_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = ["--width", "64", "--height", "36", "--samples", "32", "--camera", str(cameras_file)]
    command = ["verify", str(folder / "bundle"), "--scene", str(folder / "scene.glb"), *size]
    limits = tmp_path / "limits.json"
    limits.write_text('{"indirect": {"mean_ratio": [0.8, 1.25]}}')
    assert main([*command, "--thresholds", str(limits), "-o", str(tmp_path / "a"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["passed"]
    assert report["cameras"][0]["name"] == "one"
    limits.write_text('{"whole": {"flip": 0}, "receivers": {"p95": 0.001}}')
    assert main([*command, "--thresholds", str(limits), "-o", str(tmp_path / "b")]) == 5
    told = capsys.readouterr()
    assert "2048 receivers, 512 paths from each" in told.out
    assert "octobake: receivers: 95th percentile" in told.err
    assert "HDR-FLIP" in told.out
    assert "octobake: one: whole: HDR-FLIP" in told.err
    assert (tmp_path / "b" / "index.html").is_file()
    assert main([*command[:3], str(tmp_path / "none.glb"), "-o", str(tmp_path / "c")]) == 2
