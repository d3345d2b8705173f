"""Every bad document by both doors, command line and HTTP: its slug and its place, in time, and nothing left behind."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bake_core.bake import bake
from bake_core.spec import parse_spec
from service.app import create_app
from service.cli import main
from service.jobs import Kind, State
from service.parts import Service
from service.settings import Settings
from tests.faults.__main__ import summary
from tests.faults.documents import SKY, SPEC, BundleFault, DocumentFault, bundles, documents
from tests.faults.fault import changed
from tests.service.leftovers import listing, own_temporary_files
from tests.service.running import InProcess

__all__ = ["own_temporary_files"]

FAULTS, BUNDLES = documents(), bundles()
ROOT = Path(__file__).resolve().parents[2]
# What a request's own JSON is called, and where in it each kind of document goes.
PLACES = {"spec": "spec", "cameras": "body.cameras", "thresholds": "body.thresholds"}


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sound scene and its bundle."""
    folder = tmp_path_factory.mktemp("baked")
    (folder / "scene.glb").write_bytes(changed())
    bake(folder / "scene.glb", parse_spec(SPEC), folder / "bundle")
    return folder


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[InProcess, Service, dict[str, str]]]:
    """A service with a sound scene, and a bake of it that has succeeded as far as the store knows; their names."""
    service = Service(Settings(data=str(tmp_path_factory.mktemp("bad") / "data")))
    here = InProcess(create_app(service))
    scene = here.post("/v1/scenes", content=changed(), headers={"Content-Type": "model/gltf-binary"}).json()["digest"]
    job = service.store.add_job(Kind.BAKE, {"scene": scene, "spec": parse_spec(SPEC).canonical()}, {}, 0).id
    service.store.claim()
    service.store.move(job, State.RUNNING)
    service.store.move(job, State.FINALIZING)
    service.store.move(job, State.SUCCEEDED, result={"bundle": scene})
    yield here, service, {"scene": scene, "bake": job}
    service.close()


def refused(arguments: list[str], slug: str, where: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Run a command that must say no: exit 2, one line, no traceback, at once."""
    began = time.perf_counter()
    assert main(arguments) == 2
    assert time.perf_counter() - began < 5
    out, err = capsys.readouterr()
    error = json.loads(out)["error"]
    assert (error["slug"], error["where"]) == (slug, where)
    assert error["message"] and "\n" not in error["message"] and tempfile.gettempdir() not in error["message"]
    assert "Traceback" not in err and f"[{slug}]" in err.strip().splitlines()[-1]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name[:70])
def test_the_command_line_refuses(fault: DocumentFault, baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"{fault.kind}.json"
    path = tmp_path / name
    path.write_bytes(fault.document)
    for image, data in fault.images.items():
        (tmp_path / image).write_bytes(data)
    scene, bundle, out = str(baked / "scene.glb"), str(baked / "bundle"), str(tmp_path / "out")
    command = {
        "spec": ["bake", scene, "--spec", str(path), "-o", out],
        "cameras": ["verify", bundle, "--scene", scene, "--camera", str(path), "-o", out],
        "thresholds": ["verify", bundle, "--scene", scene, "--thresholds", str(path), "-o", out],
        "points": ["sample", bundle, "--points", str(path)],
    }[fault.kind]
    before = listing(tmp_path)
    refused([*command, "--json"], fault.slug, fault.where.format(document=name, image=repr(SKY)), capsys)
    assert listing(tmp_path) == before


@pytest.mark.parametrize("fault", [f for f in FAULTS if f.kind in PLACES], ids=lambda f: f.name[:70])
def test_http_refuses(fault: DocumentFault, http: tuple[InProcess, Service, dict[str, str]]) -> None:
    here, service, names = http
    text, image = fault.document, ""
    for name, data in fault.images.items():
        image = f"sha256:{hashlib.sha256(data).hexdigest()}"
        assert here.put(f"/v1/blobs/{image}", content=data).status_code in (201, 204)
        text = text.replace(json.dumps(name).encode(), json.dumps(image).encode())
    path, key, named = ("bakes", "spec", "scene") if fault.kind == "spec" else ("verifications", fault.kind, "bake")
    body = json.dumps({named: names[named], key: None}).encode().replace(b"null", text or b" ")
    slug, where, status = fault.slug, fault.where.format(document=PLACES[fault.kind], image=repr(image)), 422
    if not fault.is_json:
        # Then the request cannot be read at all.
        slug, where, status = f"request.{fault.slug.partition('.')[2]}", "body", 400
    if fault.shape:
        slug, where = "request.invalid", f"body.{key}"
    assert service.blobs.root
    before, jobs = listing(service.blobs.root), service.store.count_jobs()
    began = time.perf_counter()
    answer = here.post(f"/v1/{path}", content=body, headers={"Content-Type": "application/json"})
    assert time.perf_counter() - began < 5
    problem: dict[str, Any] = answer.json()
    assert (answer.status_code, problem["slug"], problem["where"]) == (status, slug, where), problem
    assert listing(service.blobs.root) == before and service.store.count_jobs() == jobs


@pytest.mark.parametrize("packed", [False, True], ids=["folder", "zip"])
@pytest.mark.parametrize("fault", BUNDLES, ids=lambda f: f.name)
def test_a_bad_bundle_is_refused(fault: BundleFault, packed: bool, baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bundle = tmp_path / "bundle"
    shutil.copytree(baked / "bundle", bundle)
    fault.damage(bundle)
    if packed:
        bundle = Path(shutil.make_archive(str(bundle), "zip", bundle))
    before = listing(tmp_path)
    for command in (["info", str(bundle)], ["sample", str(bundle), "--at", "0,0,0", "--normal", "0,1,0"]):
        refused([*command, "--json"], fault.slug, str(bundle), capsys)
    assert listing(tmp_path) == before


def test_the_page_says_how_many_faults_there_are() -> None:
    names = [f.name for f in FAULTS] + [f.name for f in BUNDLES]
    assert len(names) == len(set(names))
    page = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    assert summary() in page, "run: python -m tests.faults"
