"""Conventions of HTTP, in this process: every status, every error a problem."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from service.jobs import Kind, State
from service.parts import Service
from service.settings import Settings
from tests.faults.documents import exr
from tests.faults.other_files import make_zip
from tests.service.running import BOX, InProcess, box_spec

HEX = hashlib.sha256(BOX).hexdigest()
DIGEST = f"sha256:{HEX}"


def problem(answer: Any, status: int, slug: str) -> dict[str, Any]:
    """The problem document, after a look at its form."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = answer.json()
    assert set(document) == {"type", "title", "status", "detail", "slug", "where"}
    assert (document["status"], document["slug"], document["type"]) == (status, slug, f"urn:octobake:problem:{slug}")
    assert document["detail"]
    return document


def add_box(http: InProcess) -> str:
    answer = http.post("/v1/scenes", content=BOX, headers={"content-type": "model/gltf-binary"})
    assert answer.status_code in (200, 201), answer.text
    digest: str = answer.json()["digest"]
    return digest


def submit(http: InProcess, **more: Any) -> dict[str, Any]:
    answer = http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec(), **more})
    assert answer.status_code == 202, answer.text
    document: dict[str, Any] = answer.json()
    return document


def finished(service: Service, job: str, content: bytes = b"PK bundle") -> str:
    """Walk a job through its states, with a made-up bundle; answers the bundle's digest."""
    with service.blobs.upload() as upload:
        upload.write(content)
        upload.keep()
        service.store.add_blob(upload.digest, upload.size)
    assert service.store.claim()
    service.store.move(job, State.RUNNING)
    service.store.move(job, State.FINALIZING)
    figures = {"samples": 16, "error": 0.01, "seconds": 1.0, "stopped": "samples", "exit_code": 0}
    service.store.move(job, State.SUCCEEDED, result={"bundle": upload.digest, "report": upload.digest, **figures})
    return upload.digest


async def chunks(chunk: bytes, times: int) -> AsyncIterator[bytes]:
    """A body of a length that is not declared."""
    for _ in range(times):
        yield chunk


# Blobs


def test_a_blob_is_uploaded_once_and_found_again(http: InProcess, service: Service) -> None:
    assert http.head(f"/v1/blobs/{DIGEST}").status_code == 404
    assert http.put(f"/v1/blobs/{DIGEST}", content=BOX).status_code == 201
    found = http.head(f"/v1/blobs/{DIGEST}")
    assert (found.status_code, found.headers["content-length"], found.headers["etag"]) == (200, str(len(BOX)), f'"{DIGEST}"')
    assert http.put(f"/v1/blobs/{DIGEST}", content=BOX).status_code == 204
    assert service.blobs.local_path(DIGEST).read_bytes() == BOX


def test_an_empty_blob_is_a_blob(http: InProcess) -> None:
    assert http.put(f"/v1/blobs/sha256:{hashlib.sha256().hexdigest()}", content=b"").status_code == 201


def test_a_blob_that_is_not_what_its_name_says_leaves_nothing(http: InProcess, service: Service) -> None:
    document = problem(http.put(f"/v1/blobs/sha256:{'0' * 64}", content=BOX), 422, "blob.digest_mismatch")
    assert HEX in document["detail"]
    assert http.head(f"/v1/blobs/sha256:{'0' * 64}").status_code == 404
    assert service.blobs.root
    assert not [p for p in service.blobs.root.rglob("*") if p.is_file()]


@pytest.mark.parametrize("name", ["sha256:abc", f"sha256:{HEX.upper()}", f"md5:{HEX}", "..", "sha256:" + "g" * 64])
def test_a_name_that_is_no_digest_is_refused(http: InProcess, name: str) -> None:
    problem(
        http.put(f"/v1/blobs/{name}", content=b""),
        422 if ".." not in name else 404,
        "blob.bad_digest" if ".." not in name else "request.not_found",
    )


def test_bodies_have_limits(tmp_path: Any) -> None:
    from service.app import create_app

    service = Service(Settings(data=str(tmp_path / "small"), max_json_bytes=100, max_upload_bytes=1000))
    http = InProcess(create_app(service))
    declared = http.put(f"/v1/blobs/{DIGEST}", content=b"x" * 1001)
    assert declared.headers["connection"] == "close"
    problem(declared, 413, "request.too_large")
    problem(http.put(f"/v1/blobs/{DIGEST}", content=chunks(b"x" * 600, 2)), 413, "request.too_large")
    problem(http.post("/v1/scenes", content=b"x" * 1001), 413, "request.too_large")
    problem(http.post("/v1/bakes", json={"scene": DIGEST, "spec": {"volumes": ["x" * 100]}}), 413, "request.too_large")
    service.close()


# Scenes


def test_a_glb_is_read_and_what_is_in_it_is_told(http: InProcess) -> None:
    answer = http.post("/v1/scenes", content=BOX, headers={"content-type": "model/gltf-binary"})
    assert answer.status_code == 201
    document = answer.json()
    assert document["digest"] == DIGEST
    assert document["triangles"] == 12
    assert document["materials"] == ["wall"]
    assert answer.headers["location"] == f"/v1/scenes/{DIGEST}"
    assert http.get(answer.headers["location"]).json() == document
    assert http.post("/v1/scenes", content=BOX).status_code == 200


def test_a_zip_is_the_scene_that_it_holds(http: InProcess) -> None:
    packed = make_zip({"room/box.glb": BOX})
    answer = http.post("/v1/scenes", content=packed, headers={"content-type": "application/zip"})
    assert (answer.status_code, answer.json()["digest"]) == (201, DIGEST), answer.text
    assert http.post("/v1/bakes", json={"scene": DIGEST, "spec": box_spec()}).status_code == 202
    problem(http.post("/v1/scenes", content=packed[:-9], headers={"content-type": "application/zip"}), 422, "scene.bad_zip")


def test_a_scene_of_files_has_the_digest_that_the_command_line_gives_it(http: InProcess, tmp_path: Any) -> None:
    from bake_core.scene_files import load_scene

    positions = b"".join(int(v).to_bytes(4, "little") for v in (0, 0, 0, 0x3F800000, 0, 0, 0, 0x3F800000, 0))
    gltf = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "a%20b.bin", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    (tmp_path / "room.gltf").write_text(json.dumps(gltf))
    (tmp_path / "a b.bin").write_bytes(positions)
    files = {}
    for name in ("room.gltf", "a b.bin"):
        data = (tmp_path / name).read_bytes()
        files[name] = f"sha256:{hashlib.sha256(data).hexdigest()}"
        http.put(f"/v1/blobs/{files[name]}", content=data)
    answer = http.post("/v1/scenes", json={"root": "room.gltf", "files": files})
    assert answer.status_code == 201, answer.text
    assert answer.json()["digest"] == load_scene(tmp_path / "room.gltf").digest
    unnamed = problem(
        http.post("/v1/scenes", json={"root": "room.gltf", "files": {"room.gltf": files["room.gltf"]}}), 422, "gltf.missing_file"
    )
    assert "a b.bin" in unnamed["detail"]
    problem(
        http.post("/v1/scenes", content=b'{"root": "\\ud800", "files": {}}', headers={"content-type": "application/json"}),
        422,
        "request.invalid",
    )
    absent = {**files, "a b.bin": f"sha256:{'0' * 64}"}
    assert (
        problem(http.post("/v1/scenes", json={"root": "room.gltf", "files": absent}), 422, "blob.unknown")["where"] == "body.files.a b.bin"
    )


@pytest.mark.parametrize(
    ("content", "slug"),
    [(b"", "gltf.bad_magic"), (b"nonsense", "gltf.bad_magic"), (BOX[:100], "gltf.truncated"), (BOX[:12], "gltf.truncated")],
)
def test_a_bad_scene_is_refused_with_the_readers_slug_and_leaves_nothing(
    http: InProcess, service: Service, content: bytes, slug: str
) -> None:
    problem(http.post("/v1/scenes", content=content, headers={"content-type": "model/gltf-binary"}), 422, slug)
    assert service.blobs.root
    assert not [p for p in service.blobs.root.rglob("*") if p.is_file()]


def test_an_unknown_scene(http: InProcess) -> None:
    problem(http.get(f"/v1/scenes/{DIGEST}"), 404, "scene.unknown")


# Requests that are wrong as requests


@pytest.mark.parametrize(
    ("body", "status", "slug", "where"),
    [
        (b"", 400, "request.bad_json", "body"),
        (b"{", 400, "request.bad_json", "body"),
        (b"\xff", 400, "request.bad_json", "body"),
        (b'{"a": NaN}', 400, "request.not_finite", "body"),
        (b'{"scene": 1, "scene": 2}', 400, "request.duplicate_key", "body"),
        (b"[" * 200_000, 400, "request.json_too_deep", "body"),
        (b"[]", 422, "request.invalid", "body"),
        (b"null", 422, "request.invalid", "body"),
        (b'{"spec": {}}', 422, "request.missing_key", "body.scene"),
        (b'{"scene": "x", "spec": {}}', 422, "request.invalid", "body.scene"),
        (json.dumps({"scene": DIGEST, "spec": {}, "extra": 1}).encode(), 422, "request.unknown_key", "body.extra"),
        (json.dumps({"scene": DIGEST, "spec": {}, "priority": "1"}).encode(), 422, "request.invalid", "body.priority"),
        (json.dumps({"scene": DIGEST, "spec": {}, "labels": {"-": ""}}).encode(), 422, "request.invalid", "body.labels.-.[key]"),
        (json.dumps({"scene": DIGEST, "spec": {}, "labels": {"a": "\0"}}).encode(), 422, "request.invalid", "body.labels.a"),
        (json.dumps({"scene": DIGEST, "spec": {}, "labels": {"a": "\ud800"}}).encode(), 422, "request.invalid", "body.labels.a"),
        (json.dumps({"scene": DIGEST, "spec": {"volumes": []}}).encode(), 422, "spec.invalid", "spec: volumes"),
        (json.dumps({"scene": DIGEST, "spec": {"rays": 1}}).encode(), 422, "spec.unknown_key", "spec: rays"),
        (json.dumps({"scene": DIGEST, "spec": box_spec()}).encode(), 422, "scene.unknown", "body.scene"),
    ],
)
def test_a_wrong_body_is_named_with_its_place(http: InProcess, body: bytes, status: int, slug: str, where: str) -> None:
    answer = http.post("/v1/bakes", content=body, headers={"content-type": "application/json; charset=utf-8"})
    assert problem(answer, status, slug)["where"] == where


def test_a_spec_that_does_not_fit_the_scene_is_refused_at_once(http: InProcess) -> None:
    add_box(http)
    spec = {"volumes": [{"fit": "node", "node": "Lamp", "counts": [1, 1, 1]}]}
    assert "Lamp" in problem(http.post("/v1/bakes", json={"scene": DIGEST, "spec": spec}), 422, "spec.unknown_node")["detail"]


@pytest.mark.parametrize(
    ("method", "path", "allow"),
    [
        ("DELETE", "/v1/bakes", "GET, POST"),
        ("PUT", "/v1/bakes/x", "GET"),
        ("GET", "/v1/bakes/x:stop", "POST"),
        ("GET", f"/v1/blobs/{DIGEST}", "HEAD, PUT"),
        ("POST", "/healthz", "GET"),
    ],
)
def test_a_method_that_is_not_taken(http: InProcess, method: str, path: str, allow: str) -> None:
    answer = http.request(method, path)
    problem(answer, 405, "request.method_not_allowed")
    assert answer.headers["allow"] == allow


@pytest.mark.parametrize("path", ["/nothing", "/v1", "/v1/bakes/", "/v1/blobs"])
def test_a_path_that_is_not_there(http: InProcess, path: str) -> None:
    problem(http.get(path), 404, "request.not_found")


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", ""])
def test_a_media_type_that_is_not_taken(http: InProcess, kind: str) -> None:
    problem(http.post("/v1/bakes", content=b"{}", headers={"content-type": kind}), 415, "request.unsupported_media_type")
    if kind:
        problem(http.post("/v1/scenes", content=b"{}", headers={"content-type": kind}), 415, "request.unsupported_media_type")


def test_an_error_of_our_own_is_a_problem_too(http: InProcess, service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service.store, "job", lambda *_: 1 / 0)
    problem(http.get("/v1/bakes/x"), 500, "service.internal")


# Jobs


def test_a_bake_is_accepted(http: InProcess) -> None:
    digest = add_box(http)
    answer = http.post("/v1/bakes", json={"scene": digest, "spec": box_spec(), "labels": {"level": "rooms"}, "priority": 3})
    assert answer.status_code == 202
    bake = answer.json()
    assert answer.headers["location"] == bake["links"]["self"] == f"/v1/bakes/{bake['id']}"
    assert "retry-after" in answer.headers
    assert (bake["state"], bake["labels"], bake["priority"], bake["scene"]) == ("queued", {"level": "rooms"}, 3, DIGEST)
    assert bake["spec"]["resolution"]["irradiance"] == 8, "defaults are filled in"
    assert bake["curve"] == []
    assert bake["created"].endswith("Z")
    assert http.get(f"/v1/bakes/{bake['id']}").json() == bake


def test_lists_are_paged_and_filtered(http: InProcess) -> None:
    ids = [submit(http, labels={"n": str(i), "odd": str(i % 2)})["id"] for i in range(5)]
    http.post(f"/v1/bakes/{ids[1]}:cancel")

    def listed(**asked: Any) -> list[str]:
        return [b["id"] for b in http.get("/v1/bakes", params=asked).json()["items"]]

    assert listed() == ids[::-1]
    assert listed(state="cancelled") == [ids[1]]
    assert listed(label="odd:1") == [ids[3], ids[1]]
    assert listed(label=["odd:1", "n:3"]) == [ids[3]]
    assert listed(label="absent:1") == []
    first = http.get("/v1/bakes", params={"limit": 2}).json()
    submit(http)  # what arrives between pages does not move them
    second = http.get("/v1/bakes", params={"limit": 2, "cursor": first["next"]}).json()
    third = http.get("/v1/bakes", params={"limit": 2, "cursor": second["next"]}).json()
    assert [b["id"] for page in (first, second, third) for b in page["items"]] == ids[::-1]
    assert third["next"] is None


@pytest.mark.parametrize(
    ("query", "where"),
    [
        ("state=done", "query.state"),
        ("limit=0", "query.limit"),
        ("label=x", "query.label[0]"),
        ("cursor=%21", "query.cursor"),
        ("cursor=9999999999999999999", "query.cursor"),
        ("cursor=é", "query.cursor"),
    ],
)
def test_a_list_that_cannot_be(http: InProcess, query: str, where: str) -> None:
    assert problem(http.get(f"/v1/bakes?{query}"), 422, "request.invalid")["where"] == where


def test_a_sky_is_a_blob(http: InProcess) -> None:
    """Named by digest, and there before the bake is; a path would be the service's own. What is wrong with it: test_bad_documents.py."""
    blob = exr(np.ones((4, 8, 3), np.float32))
    image = "sha256:" + hashlib.sha256(blob).hexdigest()
    scene = add_box(http)

    def answer(image: str) -> Any:
        spec = {**box_spec(), "environment": {"kind": "equirect", "image": image}}
        return http.post("/v1/bakes", json={"scene": scene, "spec": spec})

    for absent in ("sky.exr", "/etc/hostname", "sha256:../../etc", image):
        problem(answer(absent), 422, "spec.image_not_found")
    assert http.put(f"/v1/blobs/{image}", content=blob).status_code == 201
    assert answer(image).status_code == 202


def test_a_queued_bake_is_cancelled_at_once_and_for_good(http: InProcess) -> None:
    job = submit(http)["id"]
    assert http.post(f"/v1/bakes/{job}:cancel").json()["state"] == "cancelled"
    assert http.post(f"/v1/bakes/{job}:cancel").json()["state"] == "cancelled"
    problem(http.post("/v1/bakes/none:cancel"), 404, "bake.unknown")


def test_unknown_not_yet_and_never_are_different(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    for what in ("bundle", "report"):
        problem(http.get(f"/v1/bakes/none/{what}"), 404, "bake.unknown")
        waiting = http.get(f"/v1/bakes/{job}/{what}")
        problem(waiting, 409, "job.not_finished")
        assert "retry-after" in waiting.headers
    http.post(f"/v1/bakes/{job}:cancel")
    answer = http.get(f"/v1/bakes/{job}/bundle")
    problem(answer, 409, "job.no_result")
    assert "retry-after" not in answer.headers


def test_a_verification_needs_a_finished_bake(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    problem(http.post("/v1/verifications", json={"bake": "none"}), 422, "bake.unknown")
    problem(http.post("/v1/verifications", json={"bake": job}), 422, "bake.no_bundle")
    finished(service, job)
    answer = http.post("/v1/verifications", json={"bake": job})
    assert answer.status_code == 202
    verification = answer.json()
    assert answer.headers["location"] == f"/v1/verifications/{verification['id']}"
    assert (verification["bake"], verification["state"]) == (job, "queued")
    problem(http.get(f"/v1/verifications/{verification['id']}/files/report.json"), 409, "job.not_finished")
    problem(http.get(f"/v1/bakes/{verification['id']}"), 404, "bake.unknown")
    assert [v["id"] for v in http.get("/v1/verifications").json()["items"]] == [verification["id"]]


# Artefacts


@pytest.fixture
def bundle(http: InProcess, service: Service) -> tuple[str, str, bytes]:
    """Path, ETag and bytes of a bundle."""
    content = bytes(range(256)) * 40
    job = submit(http)["id"]
    return f"/v1/bakes/{job}/bundle", f'"{finished(service, job, content)}"', content


def test_a_bundle_is_served_with_its_digest(http: InProcess, bundle: tuple[str, str, bytes]) -> None:
    path, etag, content = bundle
    whole = http.get(path)
    assert (whole.status_code, whole.content) == (200, content)
    hashed = base64.b64encode(hashlib.sha256(content).digest()).decode()
    expected = {
        "etag": etag,
        "repr-digest": f"sha-256=:{hashed}:",
        "content-length": str(len(content)),
        "accept-ranges": "bytes",
        "content-type": "application/zip",
        "x-content-type-options": "nosniff",
    }
    assert expected.items() <= dict(whole.headers).items()
    head = http.head(path)
    assert (head.status_code, head.content) == (200, b"")
    assert expected.items() <= dict(head.headers).items()
    assert http.head(path, headers={"range": "bytes=0-9"}).status_code == 200, "a range is for GET only"


@pytest.mark.parametrize(
    ("asked", "span"),
    [
        ("bytes=0-0", (0, 1)),
        ("bytes=5-9", (5, 10)),
        ("bytes=10000-", (10000, 10240)),
        ("bytes=10000-99999", (10000, 10240)),
        ("bytes=-3", (10237, 10240)),
        ("bytes=-99999", (0, 10240)),
    ],
)
def test_a_range(http: InProcess, bundle: tuple[str, str, bytes], asked: str, span: tuple[int, int]) -> None:
    path, etag, content = bundle
    part = http.get(path, headers={"range": asked})
    assert (part.status_code, part.content) == (206, content[slice(*span)])
    assert part.headers["content-range"] == f"bytes {span[0]}-{span[1] - 1}/{len(content)}"
    assert part.headers["content-length"] == str(span[1] - span[0])
    assert part.headers["etag"] == etag


@pytest.mark.parametrize("asked", ["bytes=10240-", "bytes=99999-", "bytes=-0"])
def test_a_range_outside(http: InProcess, bundle: tuple[str, str, bytes], asked: str) -> None:
    answer = http.get(bundle[0], headers={"range": asked})
    problem(answer, 416, "request.range_not_satisfiable")
    assert answer.headers["content-range"] == "bytes */10240"


@pytest.mark.parametrize("asked", ["bytes=9-5", "bytes=-", "lines=1-2", "bytes=0-1,5-6", "bytes=a-b"])
def test_a_range_that_is_not_understood_gets_the_whole(http: InProcess, bundle: tuple[str, str, bytes], asked: str) -> None:
    assert http.get(bundle[0], headers={"range": asked}).status_code == 200


def test_conditions(http: InProcess, bundle: tuple[str, str, bytes]) -> None:
    path, etag, _ = bundle
    for known in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        answer = http.get(path, headers={"if-none-match": known})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
        assert http.head(path, headers={"if-none-match": known}).status_code == 304
    assert http.get(path, headers={"if-none-match": '"other"'}).status_code == 200
    assert http.get(path, headers={"if-match": etag}).status_code == 200
    problem(http.get(path, headers={"if-match": f"W/{etag}"}), 412, "request.precondition_failed")
    assert http.get(path, headers={"range": "bytes=1-2", "if-range": etag}).status_code == 206
    for other in ('"other"', f"W/{etag}", "Sun, 06 Nov 1994 08:49:37 GMT"):
        assert http.get(path, headers={"range": "bytes=1-2", "if-range": other}).status_code == 200


# Events


def test_events_of_a_finished_job_are_replayed_from_where_the_client_was(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    finished(service, job)
    stream = http.get(f"/v1/bakes/{job}/events")
    assert stream.headers["content-type"].startswith("text/event-stream")
    lines = stream.text.splitlines()
    states = [json.loads(line[6:])["state"] for line in lines if line.startswith("data: ")]
    assert states == ["queued", "preparing", "running", "finalizing", "succeeded"]
    ids = [line[4:] for line in lines if line.startswith("id: ")]
    stream = http.get(f"/v1/bakes/{job}/events", headers={"last-event-id": ids[2]})
    again = [line[4:] for line in stream.text.splitlines() if line.startswith("id: ")]
    assert again == ids[3:]
    problem(http.get(f"/v1/bakes/{job}/events", headers={"last-event-id": "x"}), 400, "request.invalid")
    problem(http.get("/v1/bakes/none/events"), 404, "bake.unknown")


# Health and pages


def test_health(http: InProcess, service: Service) -> None:
    assert http.get("/healthz").json()["status"] == "ok"
    problem(http.get("/readyz"), 503, "service.not_ready")
    submit(http)
    metrics = http.get("/metrics")
    assert metrics.headers["content-type"].startswith("text/plain; version=0.0.4")
    assert 'octobake_jobs{state="queued"} 1' in metrics.text.splitlines()


def test_the_page_loads_nothing_from_elsewhere(http: InProcess) -> None:
    page = http.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["content-security-policy"].startswith("default-src 'none'")
    for path in ("/web/jobs.js", "/web/style.css"):
        assert path in page.text
        assert http.get(path).status_code == 200
    assert "//" not in page.text.replace("<!doctype html>", "")


def test_a_bake_has_a_page_and_its_curve_a_picture(http: InProcess, service: Service) -> None:
    job = service.store.add_job(Kind.BAKE, {"scene": "sha256:" + "0" * 64, "spec": {"stop": {"target_error": 0.02}}}, {}, 0).id
    page = http.get(f"/web/bakes/{job}")
    assert page.status_code == 200 and "/web/bake.js" in page.text and http.get("/web/bake.js").status_code == 200
    assert "no error above 0" in http.get(f"/web/bakes/{job}/curve.svg").text
    for index, samples in enumerate((16, 32, 64)):
        opened = service.store.begin_pass(job, index, samples // 2, samples, 1)
        done = replace(opened, state="sums", error=0.8 / samples**0.5, seconds=samples / 8, rays=samples * 1000)
        progress = {"stage": "tracing", "fraction": 0.5, "samples": samples, "error": done.error, "seconds": done.seconds, "eta": None}
        service.store.commit_pass(job, done, progress)
    answer = http.get(f"/web/bakes/{job}/curve.svg")
    assert answer.headers["content-type"].startswith("image/svg+xml")
    words = [t.text for t in ElementTree.fromstring(answer.text).iter("{http://www.w3.org/2000/svg}text")]
    assert "rate -0.50 ± 0.00" in words and "target 2 %" in words
    assert http.get(f"/v1/bakes/{job}").json()["curve"][1] == {"samples": 32, "rays": 32000, "seconds": 4.0, "error": 0.8 / 32**0.5}
    problem(http.get("/web/bakes/x/curve.svg"), 404, "bake.unknown")


def test_a_job_of_the_other_kind_is_unknown(http: InProcess, service: Service) -> None:
    job = service.store.add_job(Kind.VERIFICATION, {"bake": "b"}, {}, 0)
    problem(http.get(f"/v1/bakes/{job.id}"), 404, "bake.unknown")
