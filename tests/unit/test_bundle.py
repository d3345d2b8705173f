"""A bundle on disk: written whole or not at all, replaced only by its like, and held against its digests when read."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_core import assemble, bundle, report
from bake_core.bake import bake
from bake_core.bundle import Bundle, check_replaceable, content_digest, read_bundle, read_report
from bake_core.errors import BundleError, MachineError
from bake_core.examples import closed_box, cornell
from bake_core.spec import Spec, parse_spec
from tests.baking import bake_example

STOP = {"target_error": None, "max_samples": 4}


def small_spec(**changes: Any) -> Spec:
    return parse_spec({**closed_box(0.5, 1.0)[1], "outputs": ["irradiance", "visibility"], "stop": STOP, **changes})


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``scene.glb``, ``bundle`` and ``bundle.zip``; not to be written to."""
    folder = tmp_path_factory.mktemp("baked")
    (folder / "scene.glb").write_bytes(closed_box(0.5, 1.0)[0])
    for name in ("bundle", "bundle.zip"):
        bake(folder / "scene.glb", small_spec(), folder / name)
    return folder


@pytest.fixture
def folder(baked: Path, tmp_path: Path) -> Path:
    """A copy of the bundle, to be broken."""
    shutil.copytree(baked / "bundle", tmp_path / "copy")
    return tmp_path / "copy"


def files(path: Path) -> dict[str, bytes]:
    """Every file of a bundle but the report, which holds times."""
    if path.is_dir():
        found = {p.relative_to(path).as_posix(): p.read_bytes() for p in path.rglob("*") if p.is_file()}
    else:
        with zipfile.ZipFile(path) as archive:
            found = {n: archive.read(n) for n in archive.namelist()}
    return {n: d for n, d in found.items() if not n.startswith("report.")}


def refused(path: Path) -> BundleError:
    with pytest.raises(BundleError) as caught:
        read_bundle(path)
    assert str(path) in caught.value.where or caught.value.where.endswith(".exr")
    return caught.value


def test_what_is_in_it(baked: Path) -> None:
    expected = {"manifest.json", "box.irradiance.exr", "box.visibility.exr", "box.walls.exr", "box.probes.exr"}
    expected |= {f"shaders/{n}" for n in ("octahedral.glsl", "grid.glsl", "irradiance.glsl", "trace.glsl", "constants.glsl", "README.md")}
    assert set(files(baked / "bundle")) == expected
    assert {p.name for p in (baked / "bundle").iterdir()} >= {"report.json", "report.html", "report.svg", "report.png"}


def test_maps_without_hue_have_one_channel_and_even_ones_no_file_unless_they_are_demanded(tmp_path: Path) -> None:
    """A room that is dark, under its own spec and with all outputs demanded; a room of grey walls; and one with colours."""
    dark, grey = closed_box(0.5, 0.0), closed_box(0.5, 1.0)
    glb, spec = dark
    demanded = {**spec, "outputs": ["irradiance", "visibility"]}
    bundles = {}
    for name, example in {"dark": dark, "demanded": (glb, demanded), "grey": grey, "colours": cornell()}.items():
        folder = tmp_path / name
        folder.mkdir()
        stop = {"target_error": None, "max_samples": 4}
        few = {"volumes": [{"fit": "scene", "counts": [2, 2, 2]}]} if name == "colours" else {}
        bundles[name] = bake_example(folder, (example[0], {**example[1], **few, "stop": stop}))

    def entry(name: str) -> Any:
        return bundles[name].manifest["volumes"][0]["atlases"][0]

    even = entry("dark")
    assert even["file"] is None and even["constant"] == [0.0, 0.0, 0.0]
    assert entry("demanded")["file"] == "box.irradiance.exr" and entry("demanded")["channels"] == ["R", "G", "B"]
    assert entry("grey")["channels"] == ["Y", "Y", "Y"] and entry("colours")["channels"] == ["R", "G", "B"]
    even_texels, demanded_texels = (bundles[name].volumes[0].atlases["irradiance"].texels for name in ("dark", "demanded"))
    np.testing.assert_array_equal(even_texels, demanded_texels)
    texels = bundles["grey"].volumes[0].atlases["irradiance"].texels
    assert texels.shape[-1] == 3 and texels.any() and (texels == texels[..., :1]).all()
    said = {name: [x["what"] for x in b.manifest["left_out"] if ":" in x["what"]] for name, b in bundles.items()}
    assert said["dark"] == ["box: irradiance map"] and said["grey"] == ["box: irradiance in colour"]
    assert not said["demanded"] and not said["colours"]


def test_folder_and_zip_hold_the_same(baked: Path) -> None:
    assert files(baked / "bundle") == files(baked / "bundle.zip")
    a, b = (read_bundle(baked / n) for n in ("bundle", "bundle.zip"))
    assert a.manifest == b.manifest
    for x, y in zip(a.volumes, b.volumes, strict=True):
        for output, atlas in x.atlases.items():
            np.testing.assert_array_equal(atlas.texels, y.atlases[output].texels)


def test_reading_gives_what_the_manifest_says(baked: Path) -> None:
    read: Bundle = read_bundle(str(baked / "bundle"))
    assert read.path == baked / "bundle"
    (volume,) = read.volumes
    (entry,) = read.manifest["volumes"]
    assert volume.name == "box" and volume.counts.tolist() == [2, 2, 2] == entry["counts"]
    assert volume.origin.tolist() == entry["origin"] and volume.spacing.tolist() == entry["spacing"]
    assert volume.states.tolist() == entry["probes"]["states"] == [1] * 8
    assert volume.offsets.any() and volume.offsets.tolist() == np.float32(entry["probes"]["offsets"]).tolist()
    assert volume.distance_limit == pytest.approx(1.5 * 3**0.5)
    irradiance, visibility = volume.atlases["irradiance"], volume.atlases["visibility"]
    assert irradiance.texels.shape == (2, 2 * 10, 2 * 10, 3) and visibility.texels.shape == (2, 2 * 18, 2 * 18, 2)
    assert (irradiance.encoding, visibility.encoding) == ("half", "float")
    assert parse_spec(read.manifest["spec"]).canonical() == read.manifest["spec"]


def test_every_file_is_digested_and_the_manifest_digests_them_all(baked: Path) -> None:
    found = files(baked / "bundle")
    manifest = json.loads(found.pop("manifest.json"))
    assert set(manifest["files"]) == set(found)
    for name, data in found.items():
        assert manifest["files"][name] == {"sha256": "sha256:" + hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    told = read_report(baked / "bundle")
    assert told is not None
    assert told["content_digest"] == content_digest((baked / "bundle" / "manifest.json").read_bytes())
    assert read_report(baked / "bundle.zip") is not None


def test_nothing_measured_in_time_is_in_the_manifest(baked: Path) -> None:
    text = (baked / "bundle" / "manifest.json").read_text()
    document = json.loads(text)
    assert document["spec"]["stop"]["max_seconds"] is None
    assert "seconds" not in text.replace('"max_seconds"', "") and "curve" not in text and str(baked) not in text


def test_zip_has_one_order_fixed_dates_and_no_compression(baked: Path) -> None:
    with zipfile.ZipFile(baked / "bundle.zip") as archive:
        names = archive.namelist()
        assert names[0] == "manifest.json" and names[1:] == sorted(names[1:])
        for entry in archive.infolist():
            assert entry.date_time == (1980, 1, 1, 0, 0, 0) and entry.compress_type == zipfile.ZIP_STORED
            assert entry.external_attr >> 16 == 0o644


def test_a_report_may_be_left_out(folder: Path) -> None:
    (folder / "report.json").unlink()
    assert read_report(folder) is None
    read_bundle(folder)


# --- damage --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["box.irradiance.exr", "box.probes.exr", "shaders/irradiance.glsl"])
def test_a_changed_or_missing_file_is_named(folder: Path, name: str) -> None:
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / name).write_bytes(data)
    e = refused(folder)
    assert e.slug == "bundle.damaged" and name in e.message
    (folder / name).unlink()
    e = refused(folder)
    assert e.slug == "bundle.damaged" and name in e.message


def edit(folder: Path, change: Callable[[Any], Any]) -> None:
    path = folder / "manifest.json"
    document = json.loads(path.read_bytes())
    change(document)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.pop("files"),
        lambda m: m.pop("volumes"),
        lambda m: m.update(files=3),
        lambda m: m.update(volumes=[3]),
        lambda m: m["volumes"][0].pop("layout"),
        lambda m: m["volumes"][0].update(layout=None),
        lambda m: m["volumes"][0].update(counts=[2, 2, 3]),
        lambda m: m["volumes"][0].update(counts=[2, 2]),
        lambda m: m["volumes"][0]["layout"].update(columns=3),
        lambda m: m["volumes"][0]["atlases"][0].update(output="light"),
        lambda m: m["volumes"][0]["atlases"][0].update(file="other.exr"),
        lambda m: m["volumes"][0]["probes"].update(backface=None),
        lambda m: m["volumes"][0]["probes"].update(backface=[0.0]),
        lambda m: m["files"].update({"../outside": {"sha256": "sha256:00", "bytes": 0}}),
        lambda m: m["files"].update({"/etc/hostname": {"sha256": "sha256:00", "bytes": 0}}),
    ],
)
def test_a_manifest_that_misstates_something_is_refused(folder: Path, change: Callable[[Any], Any]) -> None:
    edit(folder, change)
    assert refused(folder).slug == "bundle.damaged"


def test_a_zip_that_names_files_outside_itself_writes_none(folder: Path, tmp_path: Path) -> None:
    edit(folder, lambda m: m["files"].update({"../../escaped": {"sha256": "sha256:00", "bytes": 0}}))
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        for path in folder.rglob("*"):
            if path.is_file():
                archive.write(path, path.relative_to(folder).as_posix())
        archive.writestr("../../escaped", b"x")
    assert refused(tmp_path / "evil.zip").slug == "bundle.damaged"
    assert not list(tmp_path.rglob("escaped"))


def test_what_is_no_bundle_is_said_to_be_none(tmp_path: Path, folder: Path) -> None:
    assert refused(tmp_path / "missing").slug == "bundle.unreadable"
    (tmp_path / "empty").mkdir()
    assert refused(tmp_path / "empty").slug == "bundle.not_a_bundle"
    (tmp_path / "text.zip").write_text("not a zip")
    assert refused(tmp_path / "text.zip").slug == "bundle.unreadable"
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("manifest.json", '{"format": "other"}')
    assert refused(tmp_path / "other.zip").slug == "bundle.not_a_bundle"
    edit(folder, lambda m: m.update(version=1))
    assert refused(folder).slug == "bundle.version"
    edit(folder, lambda m: m.update(format="other"))
    assert refused(folder).slug == "bundle.not_a_bundle"
    for text in ("", "{", "[1]", '{"a": NaN}', "[" * 100_000, "\xff"):
        (folder / "manifest.json").write_bytes(text.encode("latin-1"))
        assert refused(folder).slug in {"bundle.bad_json", "bundle.not_a_bundle", "bundle.not_finite", "bundle.json_too_deep"}


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.9])
def test_a_truncated_zip_is_refused(baked: Path, tmp_path: Path, keep: float) -> None:
    data = (baked / "bundle.zip").read_bytes()
    (tmp_path / "cut.zip").write_bytes(data[: int(len(data) * keep)])
    assert refused(tmp_path / "cut.zip").slug in {"bundle.unreadable", "bundle.damaged"}


def test_a_zip_with_a_flipped_bit_is_refused(baked: Path, tmp_path: Path) -> None:
    data = bytearray((baked / "bundle.zip").read_bytes())
    with zipfile.ZipFile(baked / "bundle.zip") as archive:
        entry = archive.getinfo("box.visibility.exr")
    data[entry.header_offset + entry.file_size // 2] ^= 1
    (tmp_path / "flipped.zip").write_bytes(data)
    assert refused(tmp_path / "flipped.zip").slug == "bundle.damaged"


def test_a_zip_whose_manifest_is_no_sane_document_is_refused(tmp_path: Path) -> None:
    for text in ('{"format": "octobake-bundle", "files": 3}', '{"format": "octobake-bundle", "files": {"a": 1}}', "[" * 200_000, "[1]"):
        with zipfile.ZipFile(tmp_path / "odd.zip", "w") as archive:
            archive.writestr("manifest.json", text)
            archive.writestr("a", "x")
        refused(tmp_path / "odd.zip")


# --- writing -------------------------------------------------------------------------------------------------------------------------


def test_a_bundle_replaces_a_bundle_and_nothing_else(baked: Path, tmp_path: Path) -> None:
    shutil.copytree(baked / "bundle", tmp_path / "old")
    (tmp_path / "old" / "stray").write_text("gone afterwards")
    shutil.copy(baked / "bundle.zip", tmp_path / "old.zip")
    (tmp_path / "empty").mkdir()
    for name in ("old", "old.zip", "empty"):
        bake(baked / "scene.glb", small_spec(seed=1), tmp_path / name)
        assert read_bundle(tmp_path / name).manifest["spec"]["seed"] == 1
    assert not (tmp_path / "old" / "stray").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "old", "old.zip"]


def test_what_is_not_a_bundle_is_never_replaced(baked: Path, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("years of work")
    (tmp_path / "file").write_text("a file")
    (tmp_path / "file.zip").write_text("not a zip")
    (tmp_path / "folder.zip").mkdir()
    shutil.copy(baked / "bundle.zip", tmp_path / "zip")  # a zip where a folder goes
    shutil.copytree(baked / "bundle", tmp_path / "bundle.zip")  # a folder where a zip goes
    before = sorted((p, p.is_file() and p.read_bytes()) for p in tmp_path.rglob("*"))
    for name in ("folder", "file", "file.zip", "folder.zip", "zip", "bundle.zip"):
        with pytest.raises(BundleError) as caught:
            bake(baked / "scene.glb", small_spec(), tmp_path / name)
        assert caught.value.slug == "bundle.in_the_way" and caught.value.where == str(tmp_path / name)
    assert sorted((p, p.is_file() and p.read_bytes()) for p in tmp_path.rglob("*")) == before


def test_a_missing_folder_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(BundleError) as caught:
        check_replaceable(tmp_path / "missing" / "out")
    assert caught.value.slug == "bundle.no_folder"


def fails(monkeypatch: pytest.MonkeyPatch, target: Any, name: str, at: int) -> None:
    """Let a function fail from its call number `at` on, as on a full disk."""
    whole, calls = getattr(target, name), iter(range(1_000_000))

    def failing(*args: Any, **keywords: Any) -> Any:
        if next(calls) >= at:
            raise OSError(28, "No space left on device")
        return whole(*args, **keywords)

    monkeypatch.setattr(target, name, failing)


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize(
    ("name", "module", "function", "at"),
    [
        ("out", assemble, "write_exr", 0),
        ("out", assemble, "write_exr", 2),
        ("out", report, "write", 0),
        ("out", bundle, "_sync", 0),
        ("out", os, "fsync", 3),
        ("out.zip", report, "write", 0),
        ("out.zip", shutil, "copyfileobj", 0),
        ("out.zip", shutil, "copyfileobj", 3),
        ("out.zip", os, "fsync", 0),
    ],
)
def test_a_full_disk_leaves_nothing_behind(
    baked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, existing: bool, name: str, module: Any, function: str, at: int
) -> None:
    """No temporary file or folder, and what stood there before still stands, whole."""
    if existing and name == "out":
        shutil.copytree(baked / "bundle", tmp_path / name)
    elif existing:
        shutil.copy(baked / "bundle.zip", tmp_path / name)
    before = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*"))
    with monkeypatch.context() as patch:
        fails(patch, module, function, at)
        with pytest.raises(MachineError) as caught:
            bake(baked / "scene.glb", small_spec(seed=2), tmp_path / name)
    assert (caught.value.slug, caught.value.where) == ("machine.cannot_write", str(tmp_path / name))
    assert sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*")) == before
    if existing:
        assert read_bundle(tmp_path / name).manifest["spec"]["seed"] == 0


def test_a_folder_that_cannot_be_replaced_stays(baked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old bundle is already out of the way when the new one cannot take its place."""
    shutil.copytree(baked / "bundle", tmp_path / "out")
    with monkeypatch.context() as patch:
        whole = Path.replace

        def failing(path: Path, target: Path) -> Path:
            if path.name == "bundle":
                raise OSError(5, "Input/output error")
            return whole(path, target)

        patch.setattr(Path, "replace", failing)
        with pytest.raises(MachineError):
            bake(baked / "scene.glb", small_spec(seed=2), tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert read_bundle(tmp_path / "out").manifest["spec"]["seed"] == 0


def test_files_are_readable_by_others_as_umask_allows(baked: Path) -> None:
    mask = os.umask(0)
    os.umask(mask)
    for path in [baked / "bundle", baked / "bundle.zip", *(baked / "bundle").rglob("*")]:
        wanted = (0o777 if path.is_dir() else 0o666) & ~mask
        assert path.stat().st_mode & 0o777 == wanted, f"{path.name}: {path.stat().st_mode & 0o777:o}"


def test_json_holds_no_nan() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        bundle.dump_json({"a": float("nan")})
    assert bundle.dump_json({"b": 1, "a": "π"}) == '{\n  "b": 1,\n  "a": "π"\n}\n'.encode()
