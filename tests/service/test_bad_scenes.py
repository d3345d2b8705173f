"""Every fault of the corpus by both doors, command line and HTTP: the same slug and place, and nothing left behind."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.cli import main
from service.parts import Service
from service.settings import Settings
from tests.faults.corpus import corpus
from tests.faults.fault import Fault
from tests.service.leftovers import listing, own_temporary_files
from tests.service.running import InProcess

__all__ = ["own_temporary_files"]

FAULTS = corpus()
SPEC = {"volumes": [{"origin": [0, 0, 0], "spacing": [1, 1, 1], "counts": [1, 1, 1]}]}


@pytest.fixture(scope="module")
def shared_http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[InProcess, Service]]:
    from service.app import create_app

    service = Service(Settings(data=str(tmp_path_factory.mktemp("bad") / "data")))
    yield InProcess(create_app(service)), service
    service.close()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name[:60])
def test_the_command_line_refuses(fault: Fault, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    path = fault.write(folder)
    (tmp_path / "spec.json").write_text(json.dumps(SPEC))
    before = listing(tmp_path)
    code = main(["bake", str(path), "--spec", str(tmp_path / "spec.json"), "-o", str(tmp_path / "out"), "--json"])
    out, err = capsys.readouterr()
    assert code == 2
    error = json.loads(out)["error"]
    assert (error["slug"], error["where"]) == (fault.slug, fault.where)
    assert "Traceback" not in err and f"[{fault.slug}]" in err.strip().splitlines()[-1]
    assert listing(tmp_path) == before


@pytest.mark.parametrize("fault", [f for f in FAULTS if not f.needs_file_system], ids=lambda f: f.name[:60])
def test_http_refuses(fault: Fault, shared_http: tuple[InProcess, Service]) -> None:
    http, service = shared_http
    files = {}
    for name, data in fault.files.items():
        files[name] = f"sha256:{hashlib.sha256(data).hexdigest()}"
        assert http.put(f"/v1/blobs/{files[name]}", content=data).status_code in (201, 204)
    assert service.blobs.root
    before = listing(service.blobs.root)
    answer = http.post("/v1/scenes", json={"root": fault.root, "files": files})
    assert answer.status_code == 422, answer.text
    assert (answer.json()["slug"], answer.json()["where"]) == (fault.slug, fault.where)
    assert listing(service.blobs.root) == before
