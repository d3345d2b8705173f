"""The client and its commands against a service that runs."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from octobake_client import Bake, Client, JobFailed, OctobakeClientError, Point, ServiceError, TransferError, Unreachable
from octobake_client.sse import parse

from bake_core.bundle import read_bundle
from bake_core.examples import closed_box, cornell
from tests.pavilion import SKY, pavilion_spec, write_pavilion
from tests.service.running import Server, box_spec, octobake


@pytest.fixture
def spec_file(tmp_path: Path) -> Path:
    """A spec of a second's work."""
    path = tmp_path / "spec.json"
    path.write_text(json.dumps(box_spec()))
    return path


def test_submit_wait_fetch_is_one_line(server: Server, box: Path, spec_file: Path, tmp_path: Path) -> None:
    submit = ("submit", box, "--spec", spec_file, "--server", server.url)
    whole = octobake(*submit, "--label", "level=rooms", "--fetch", tmp_path / "out.zip", "--fail-above-error", "0.5", "--json")
    assert whole.returncode == 0, whole.stderr
    document = json.loads(whole.stdout)
    assert (document["state"], document["labels"], document["fetched"]) == ("succeeded", {"level": "rooms"}, str(tmp_path / "out.zip"))
    assert "100 %" in whole.stderr or "97 %" in whole.stderr, "progress is on stderr"
    assert read_bundle(tmp_path / "out.zip").volumes[0].counts.tolist() == [2, 2, 2]

    folder = octobake(*submit, "--fetch", tmp_path / "out", "--fail-above-error", "0.0000001")
    assert folder.returncode == 4
    assert "16 samples, error " in folder.stdout
    assert read_bundle(tmp_path / "out").manifest == read_bundle(tmp_path / "out.zip").manifest
    assert sorted(p.name for p in tmp_path.iterdir()) == ["box.glb", "out", "out.zip", "spec.json"], "no other file is left"


def test_the_other_commands(server: Server, box: Path, tmp_path: Path) -> None:
    (tmp_path / "spec.json").write_text(json.dumps(box_spec(samples=1_000_000)))
    at = ("--server", server.url)
    submitted = octobake("submit", box, "--spec", tmp_path / "spec.json", "--label", "which=other", *at)
    assert submitted.returncode == 0
    job = submitted.stdout.strip()
    listed = octobake("list", "--label", "which=other", *at, "--json")
    assert [b["id"] for b in json.loads(listed.stdout)["bakes"]] == [job]
    assert octobake("list", *at).stdout.splitlines()[0].startswith(job)
    assert octobake("cancel", job, *at).returncode == 0
    waited = octobake("wait", job, *at)
    assert (waited.returncode, waited.stdout) == (3, "")
    assert "bake.cancelled" in waited.stderr
    assert json.loads(octobake("status", job, *at, "--json").stdout)["state"] == "cancelled"
    refused = octobake("fetch", job, "-o", tmp_path / "x.zip", *at, "--json")
    assert refused.returncode == 2
    assert json.loads(refused.stdout)["error"]["slug"] == "job.no_result"
    assert not (tmp_path / "x.zip").exists()


def test_errors_of_the_service_reach_the_command_line_unchanged(server: Server, box: Path, tmp_path: Path) -> None:
    at = ("--server", server.url)
    (tmp_path / "spec.json").write_text('{"volumes": [{"fit": "node", "node": "Lamp", "counts": [1, 1, 1]}]}')
    refused = octobake("submit", box, "--spec", tmp_path / "spec.json", *at)
    assert refused.returncode == 2
    assert refused.stderr.startswith("octobake: error [spec.unknown_node] volumes[0].node: ")
    (tmp_path / "bad.glb").write_bytes(b"nonsense")
    assert "[gltf.bad_magic]" in octobake("submit", tmp_path / "bad.glb", "--spec", tmp_path / "spec.json", *at).stderr
    assert "[client.unreadable]" in octobake("submit", tmp_path / "none.glb", "--spec", tmp_path / "spec.json", *at).stderr
    nobody = octobake("list", "--server", "http://127.0.0.1:9")
    assert (nobody.returncode, nobody.stdout) == (3, "")
    assert "[client.unreachable]" in nobody.stderr


def test_what_the_service_has_is_not_sent_again(server: Server, tmp_path: Path) -> None:
    sent: list[str] = []

    class Counting(httpx.HTTPTransport):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            sent.append(request.method)
            return super().handle_request(request)

    path = tmp_path / "blob"
    path.write_bytes(np.random.default_rng(1).bytes(3_000_000))
    with Client(server.url, transport=Counting()) as client:
        assert client.put_blob(path) == client.put_blob(path)
    assert sent == ["HEAD", "PUT", "HEAD"]


def test_a_gltf_goes_with_its_files_and_nothing_else(server: Server, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("not for you")
    folder = tmp_path / "scene"
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "a b.bin").write_bytes(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes())
    gltf: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "bin/a%20b.bin", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    (folder / "room.gltf").write_text(json.dumps(gltf))
    with server.client() as client:
        assert client.add_scene(folder / "room.gltf").triangles == 1
        gltf["buffers"].append({"uri": "../secret", "byteLength": 11})
        (folder / "room.gltf").write_text(json.dumps(gltf))
        with pytest.raises(ServiceError) as caught:
            client.add_scene(folder / "room.gltf")
        assert caught.value.slug == "gltf.unsafe_uri"


def test_an_interrupted_download_goes_on_and_a_wrong_one_is_noticed(server: Server, box: Path, tmp_path: Path) -> None:
    asked: list[str | None] = []

    class Watching(httpx.HTTPTransport):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.method == "GET":
                asked.append(request.headers.get("range"))
            return super().handle_request(request)

    with Client(server.url, transport=Watching()) as client:
        bake = client.wait(client.submit(client.add_scene(box).digest, box_spec())).check()
        asked.clear()
        whole = client.fetch(bake, tmp_path / "whole.zip").read_bytes()
        assert bake.result
        part = tmp_path / f"again.zip.{bake.result['bundle'][-12:]}.part"
        part.write_bytes(whole[:1000])
        assert client.fetch(bake, tmp_path / "again.zip").read_bytes() == whole
        assert asked == [None, "bytes=1000-"]
        part.write_bytes(b"x" * 1000)
        with pytest.raises(TransferError, match="digest"):
            client.fetch(bake, tmp_path / "again.zip")
        assert not part.exists(), "so that the next try begins afresh"
        assert client.report(bake)["curve"]


def test_a_request_is_sent_again_and_is_the_same_one(tmp_path: Path) -> None:
    """The connection breaks, the service is busy, and is still at it: one key, one body, each time the whole of it."""
    busy = httpx.Response(503, headers={"Retry-After": "0"}, json={"slug": "service.busy", "detail": "", "where": ""})
    at_it = httpx.Response(409, headers={"Retry-After": "0"}, json={"slug": "request.key_in_flight", "detail": "", "where": ""})
    refused = httpx.Response(409, headers={"Retry-After": "0"}, json={"slug": "job.not_finished", "detail": "", "where": ""})
    script: list[httpx.Response | Exception] = []
    sent: list[tuple[str, str | None, bytes]] = []

    def answer(request: httpx.Request) -> httpx.Response:
        sent.append((request.method, request.headers.get("idempotency-key"), request.read()))
        following = script.pop(0)
        if isinstance(following, Exception):
            raise following
        return following

    broken = httpx.RemoteProtocolError("broken")
    with Client("http://octobake", transport=httpx.MockTransport(answer)) as client:
        script += [broken]
        with pytest.raises(Unreachable):
            client.bake("x")
        assert len(sent) == 1, "nobody waits for a service that never answered"
        path = tmp_path / "blob"
        path.write_bytes(b"a file")
        script += [httpx.Response(404), broken, busy, httpx.Response(201)]
        client.put_blob(path)
        assert [s[2] for s in sent[-3:]] == [b"a file"] * 3
        sent.clear()
        script += [broken, at_it, refused]
        with pytest.raises(ServiceError) as caught:
            client.submit("sha256:x", {})
        assert caught.value.slug == "job.not_finished" and not script
        assert len(set(sent)) == 1 and sent[0][1]
        script += [broken]
        with pytest.raises(Unreachable):
            client.stop(Bake.of(dict.fromkeys(Bake.__dataclass_fields__, "x")))


def test_a_failed_job_tells_why(server: Server, box: Path) -> None:
    with server.client() as client:
        job = client.submit(client.add_scene(box).digest, box_spec(samples=1_000_000))
        with pytest.raises(JobFailed, match=r"is (queued|preparing|running)"):
            job.check()
        client.cancel(job)
        with pytest.raises(JobFailed) as caught:
            client.wait(job).check()
        assert (caught.value.slug, caught.value.exit_code) == ("bake.cancelled", 3)


def test_a_scene_without_an_answer_is_refused_by_the_worker(server: Server, tmp_path: Path) -> None:
    """Sound glTF and a sound spec: only tracing finds that a sealed white room never grows dark."""
    glb, spec = closed_box(1.0, 1.0)
    (tmp_path / "white.glb").write_bytes(glb)
    with server.client() as client:
        job = client.submit(client.add_scene(tmp_path / "white.glb").digest, spec)
        with pytest.raises(JobFailed) as caught:
            client.wait(job).check()
    assert (caught.value.slug, caught.value.exit_code) == ("scene.light_never_ends", 2)


def test_nobody_there() -> None:
    with Client("http://127.0.0.1:9") as client, pytest.raises(Unreachable):
        client.bake("x")
    with pytest.raises(OctobakeClientError, match="not a URL"):
        Client("http://x:port")


def test_events_are_parsed_as_the_standard_says() -> None:
    lines = [": ping", "", "id: 7", "event: state", 'data: {"state":', 'data: "queued"}', "", "data: {}", "", "event: state", "data: {}"]
    events = list(parse(lines))
    assert [(e.type, e.id, dict(e.document)) for e in events] == [("state", 7, {"state": "queued"}), ("message", None, {})]


def test_a_cornell_box_is_baked_through_the_service_and_its_picture_holds(server: Server, tmp_path: Path) -> None:
    """The thread through every part: HTTP, queue, tracer, bundle, GLSL on lavapipe, picture."""
    glb, spec = cornell()
    (tmp_path / "cornell.glb").write_bytes(glb)
    with server.client() as client:
        points: list[Point] = []
        bake = client.wait(client.submit(client.add_scene(tmp_path / "cornell.glb").digest, spec), point=points.append).check()
        assert bake.result
        assert [(p.samples, p.rays, p.seconds, p.error) for p in points] == [(p.samples, p.rays, p.seconds, p.error) for p in bake.curve]
        report = client.report(bake)
        assert [p["rays"] for p in report["curve"]] == [p.rays for p in points] and report["rate"]["seconds"]["points"] == len(points)
        assert bake.result["error"] <= bake.spec["stop"]["target_error"]
        assert bake.curve[-1].error == bake.result["error"]
        progress: list[float] = []
        verification = client.verify(bake, width=256, height=144, samples=32)
        verification = client.wait(verification, lambda p: progress.append(p.fraction)).check()
        assert verification.result
        report = verification.result["report"]
        assert verification.result["passed"], report["failures"]
        assert progress == sorted(progress)
        files = {p.relative_to(tmp_path / "pictures").as_posix() for p in client.fetch_files(verification, tmp_path / "pictures")}
        assert files == set(verification.result["files"])
        assert json.loads((tmp_path / "pictures" / "verification.json").read_text()) == report
        assert any(name.endswith(".png") for name in files)
        assert any(name.endswith(".exr") for name in files)
        with zipfile.ZipFile(client.fetch(bake, tmp_path / "cornell.zip")) as archive:
            assert json.loads(archive.read("manifest.json"))["scene"]["digest"] == bake.scene


def test_a_bake_under_a_stored_sky_is_verified_under_it(server: Server, tmp_path: Path) -> None:
    """With all that a scene can hold: the worker finds the image where the bake found it."""
    path = write_pavilion(tmp_path)
    with server.client() as client:
        spec = pavilion_spec(client.put_blob(tmp_path / SKY), stop={"target_error": None, "max_samples": 4})
        bake = client.wait(client.submit(client.add_scene(path).digest, spec)).check()
        anything: dict[str, Any] = {"indirect": {}, "whole": {"mean_ratio": [0.5, 2]}}
        verification = client.wait(client.verify(bake, width=32, height=18, samples=2, thresholds=anything)).check()
    assert verification.result
    report = verification.result["report"]
    assert report["failures"] == []
    # Somewhere the sky itself is seen.
    assert any(camera["surface"] < 1 for camera in report["cameras"])


def test_a_verification_that_fails_its_thresholds_has_succeeded_with_exit_code_5(server: Server, box: Path) -> None:
    camera = {"name": "inside", "position": [0, 0, 0.8], "target": [0.1, 0, 0]}
    small: dict[str, Any] = {"width": 16, "height": 16, "samples": 2, "cameras": [camera]}
    with server.client() as client:
        bake = client.wait(client.submit(client.add_scene(box).digest, box_spec())).check()
        impossible = {"indirect": {"mean_ratio": [2.0, 3.0]}}
        done = client.wait(client.verify(bake, thresholds=impossible, **small)).check()
        assert done.result
        assert (done.result["passed"], done.result["exit_code"]) == (False, 5)
        for wrong, slug in (({"cameras": [{**camera, "yfov": 4}]}, "camera.invalid"), ({"thresholds": {"x": 1}}, "thresholds.invalid")):
            with pytest.raises(ServiceError) as caught:
                client.verify(bake, **{**small, **wrong})
            assert (caught.value.slug, caught.value.status) == (slug, 422)
