"""What is kept, and what a clean-up takes: the preview says the same, and nothing goes that somebody needs."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from service.app import create_app
from service.jobs import Kind, State
from service.parts import Service
from service.retention import DAY
from service.settings import Settings
from service.tables import blobs, jobs, metadata, scenes
from tests.service.running import InProcess
from tests.service.test_http import DIGEST, add_box, finished, problem, submit


def age(service: Service, days: float) -> None:
    """Make everything that there is so much older."""
    with service.store._write() as c:
        for table in (blobs, scenes):
            c.execute(sa.update(table).values(used=table.c.used - days * DAY))
        c.execute(sa.update(jobs).values(finished=jobs.c.finished - days * DAY))


def there(service: Service) -> set[str]:
    assert service.blobs.root
    return {p.name for p in (service.blobs.root / "sha256").rglob("*") if p.is_file()}


def upload(http: InProcess, content: bytes) -> str:
    digest = hashlib.sha256(content).hexdigest()
    assert http.put(f"/v1/blobs/sha256:{digest}", content=content).status_code in (201, 204)
    return digest


def test_a_finished_job_expires_and_its_files_go(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    bundle = finished(service, job)
    stray = upload(http, b"nobody's")
    empty = {"jobs": [], "forgotten": [], "scenes": [], "blobs": 0, "bytes": 0}
    assert http.get("/v1/cleanup").json() == http.post("/v1/cleanup").json() == empty
    age(service, 31)
    preview = http.get("/v1/cleanup").json()
    assert preview["jobs"] == [job] and preview["scenes"] == [DIGEST] and preview["blobs"] == 3
    assert http.get(f"/v1/bakes/{job}/bundle").status_code == 200, "a preview takes nothing"
    assert http.post("/v1/cleanup").json() == preview
    assert there(service) == set() and stray not in there(service)
    gone = http.get(f"/v1/bakes/{job}/bundle")
    problem(gone, 410, "job.expired")
    document = http.get(f"/v1/bakes/{job}").json()
    assert document["state"] == "expired" and document["result"]["bundle"] == bundle, "the figures stay"
    assert "bundle" not in document["links"]
    assert http.get("/v1/cleanup").json() == http.post("/v1/cleanup").json() == empty
    problem(http.post(f"/v1/bakes/{job}:requeue"), 422, "scene.unknown")
    add_box(http)
    assert http.post(f"/v1/bakes/{job}:requeue").json()["state"] == "queued"


def test_a_job_that_expired_long_ago_is_forgotten(http: InProcess, service: Service) -> None:
    old, again = submit(http)["id"], submit(http)["id"]
    for job in (old, again):
        finished(service, job)
    age(service, 31)
    assert set(http.post("/v1/cleanup").json()["jobs"]) == {old, again}
    age(service, 335)
    preview = http.get("/v1/cleanup").json()
    assert set(preview["forgotten"]) == {old, again} and preview["jobs"] == []
    add_box(http)
    assert http.post(f"/v1/bakes/{again}:requeue").status_code == 200
    assert http.post("/v1/cleanup").json()["forgotten"] == [old]
    problem(http.get(f"/v1/bakes/{old}"), 404, "bake.unknown")
    with service.store._read() as c:
        for table in metadata.sorted_tables:
            if "job" in table.c:
                assert c.execute(sa.select(sa.func.count()).where(table.c.job == old)).scalar_one() == 0


def test_what_is_pinned_stays_and_so_does_what_others_need(http: InProcess, service: Service) -> None:
    pinned, shared, queued = submit(http)["id"], submit(http)["id"], submit(http, spec={"volumes": [{"fit": "scene", "counts": [2, 2, 2]}]})
    assert http.post(f"/v1/bakes/{pinned}:pin").json()["pinned"] is True
    same, other = finished(service, pinned, b"PK same"), finished(service, shared, b"PK same")
    assert same == other
    age(service, 31)
    assert http.post("/v1/cleanup").json() == {"jobs": [shared], "forgotten": [], "scenes": [], "blobs": 0, "bytes": 0}
    assert http.get(f"/v1/bakes/{pinned}/bundle").content == b"PK same"
    assert http.get(f"/v1/bakes/{queued['id']}").json()["state"] == "queued"
    assert http.post(f"/v1/bakes/{pinned}:unpin").json()["pinned"] is False
    taken = http.post("/v1/cleanup").json()
    assert (taken["jobs"], taken["blobs"], taken["bytes"]) == ([pinned], 1, len(b"PK same")), "the queued bake still needs the scene"


def test_a_job_has_its_own_time(http: InProcess, service: Service) -> None:
    short, long = submit(http, keep_seconds=3600)["id"], submit(http, keep_seconds=90 * DAY)["id"]
    finished(service, short, b"PK short")
    finished(service, long, b"PK long")
    age(service, 1)
    assert http.post("/v1/cleanup").json()["jobs"] == [short]
    assert http.get(f"/v1/bakes/{short}/bundle").status_code == 410
    age(service, 88)
    assert http.get("/v1/cleanup").json()["jobs"] == []
    age(service, 2)
    assert http.get("/v1/cleanup").json()["jobs"] == [long]


def test_who_asks_for_a_blob_keeps_it(http: InProcess, service: Service) -> None:
    asked, sent = upload(http, b"asked"), upload(http, b"sent")
    age(service, 31)
    assert http.get("/v1/cleanup").json()["blobs"] == 2
    assert http.head(f"/v1/blobs/sha256:{asked}").status_code == 200
    upload(http, b"sent")
    assert http.post("/v1/cleanup").json()["blobs"] == 0
    assert there(service) == {asked, sent}


def test_a_bake_that_is_to_be_verified_stays(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    finished(service, job)
    verification = http.post("/v1/verifications", json={"bake": job}).json()["id"]
    age(service, 31)
    assert http.post("/v1/cleanup").json() == {"jobs": [], "forgotten": [], "scenes": [], "blobs": 0, "bytes": 0}
    http.post(f"/v1/verifications/{verification}:cancel")
    age(service, 31)
    assert set(http.post("/v1/cleanup").json()["jobs"]) == {job, verification}


def test_no_file_goes_while_a_worker_may_be_writing_it(http: InProcess, service: Service) -> None:
    upload(http, b"old")
    job = submit(http)["id"]
    service.store.claim()
    service.store.move(job, State.RUNNING)
    service.store.move(job, State.FINALIZING)
    age(service, 31)
    assert http.post("/v1/cleanup").json()["blobs"] == 0
    service.store.move(job, State.FAILED, error={"slug": "x", "where": "", "message": "", "exit_code": 3})
    assert http.post("/v1/cleanup").json()["blobs"] == 1


@pytest.fixture
def forever(tmp_path: Path) -> Iterator[Service]:
    service = Service(Settings(data=str(tmp_path / "forever"), retention_days=0.0))
    yield service
    service.close()


def test_no_days_are_for_ever(forever: Service) -> None:
    http = InProcess(create_app(forever))
    job = submit(http)["id"]
    finished(forever, job)
    age(forever, 10_000)
    assert http.post("/v1/cleanup").json()["jobs"] == []
    assert forever.store.job(job, Kind.BAKE)


def test_what_came_between_the_look_and_the_deed_stays(http: InProcess, service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    job = submit(http)["id"]
    finished(service, job)
    age(service, 31)
    find = service.retention._find
    calls: list[Any] = []

    def find_and_be_late(c: Any) -> Any:
        found = find(c)
        if not calls:
            calls.append(found)
            monkeypatch.setattr(service.store, "expire", lambda job: service.store.pin(job, True) and False)
        return found

    monkeypatch.setattr(service.retention, "_find", find_and_be_late)
    assert http.post("/v1/cleanup").json()["blobs"] == 0
    assert http.get(f"/v1/bakes/{job}/bundle").status_code == 200
