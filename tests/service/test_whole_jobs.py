"""Jobs as they run: stopped with what they have, limited, looked at on their way, told of at their end, answered for at once."""

from __future__ import annotations

import hashlib
import json
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from octobake_client import Client, JobFailed, ServiceError

from bake_core.bundle import read_bundle
from tests.service.running import BOX, OCTOBAKE, Server, box_spec, environment, octobake, wait_for
from tests.service.test_webhooks import Receiver

SCENE = "sha256:" + hashlib.sha256(BOX).hexdigest()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service that may send webhooks to this machine; its shards are short, so that little is lost by a stop."""
    server = Server(tmp_path_factory.mktemp("whole") / "data", "--webhook-private", "1", "--shard-seconds", "0.2")
    server.wait_ready()
    with server.client() as client:
        client._send("POST", "/v1/scenes", content=BOX)
    yield server
    server.close()


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    """A client; what a test leaves running when it fails holds up no other."""
    with server.client() as client:
        yield client
        for job in client.bakes():
            if not job.done:
                client.cancel(job)


def endless(client: Client, samples: int = 1_000_000) -> Any:
    """A bake that goes on until it is told to end."""
    return client.submit(SCENE, {**box_spec(samples, (4, 4, 4)), "seed": time.monotonic_ns()})


def until(client: Client, job: Any, passes: int) -> None:
    wait_for(lambda: len(client.bake(job.id).curve) >= passes, 120)


def test_a_bake_that_is_told_to_stop_keeps_its_passes(client: Client, server: Server, tmp_path: Path) -> None:
    job = endless(client)
    with pytest.raises(ServiceError) as caught:
        client.stop(job)
    assert caught.value.slug in ("job.not_running", "job.no_pass")
    until(client, job, 3)
    stopped = octobake("stop", job.id, "--server", server.url, "--json")
    assert stopped.returncode == 0, stopped.stderr
    done = client.wait(job).check()
    assert done.result and (done.result["stopped"], done.result["exit_code"]) == ("interrupt", 4)
    assert done.result["samples"] == done.curve[-1].samples < 1_000_000
    bundle = read_bundle(client.fetch(job, tmp_path / "stopped.zip"))
    assert (bundle.manifest["stopped"], bundle.manifest["samples"]) == ("interrupt", done.result["samples"])
    assert client.report(job)
    waited = octobake("wait", job.id, "--server", server.url)
    assert waited.returncode == 4 and "stopped when told to" in waited.stdout, waited
    with pytest.raises(ServiceError) as caught:
        client.stop(job)
    assert (caught.value.status, caught.value.slug) == (409, "job.not_running")
    states = [e.document["state"] for e in client.events(job) if e.type == "state"]
    assert states == ["queued", "preparing", "running", "finalizing", "succeeded"]


def test_a_cancelled_bake_stays_cancelled(client: Client) -> None:
    job = endless(client)
    until(client, job, 1)
    client.cancel(job)
    with pytest.raises(ServiceError) as caught:
        client.stop(job)
    assert caught.value.slug == "job.not_running"
    with pytest.raises(JobFailed):
        client.wait(job).check()
    assert client.bake(job.id).state == "cancelled"


def test_a_bake_that_was_stopped_and_then_cancelled_ends_as_one_of_the_two(client: Client) -> None:
    job = endless(client)
    until(client, job, 1)
    client.stop(job)
    client.cancel(job)
    done = client.wait(job)
    assert done.state in ("cancelled", "succeeded")
    assert (done.state == "succeeded") == bool(done.result)


@pytest.mark.slow
def test_a_stop_is_kept_over_a_restart(tmp_path: Path) -> None:
    """The service is killed with the stop in its store and before its effect: the next one knows."""
    server = Server(tmp_path / "data", "--shard-seconds", "0.2")
    try:
        with server.client() as client:
            client._send("POST", "/v1/scenes", content=BOX)
            job = endless(client)
            until(client, job, 2)
            client.stop(job)
            server.kill()
        server.start()
        with server.client() as client:
            done = client.wait(job).check()
        assert done.result and done.result["stopped"] == "interrupt"
    finally:
        server.close()


def test_a_running_bake_shows_itself(client: Client, server: Server) -> None:
    # A time to go is told from a fiftieth of the samples on.
    job = endless(client, samples=4096)
    until(client, job, 2)
    document = wait_for(lambda: (d := client.bake(job.id).document)["progress"]["eta_range"] and d, 60)
    least, most = document["progress"]["eta_range"]
    # It has no target, so all samples are to come, as fast as in the fastest pass or as in the slowest.
    assert 0 < least <= document["progress"]["eta"] * 1.0001 and document["progress"]["eta"] <= most * 1.0001
    plan = client._send("GET", f"/v1/bakes/{job.id}/plan").json()
    assert (plan["probes"], plan["volumes"][0]["counts"]) == (64, [4, 4, 4]) and plan["memory_bytes"] > 0 and plan == document["plan"]
    running = client._send("GET", f"/v1/bakes/{job.id}/preview")
    assert (running.headers["content-type"], running.headers["cache-control"]) == ("image/png", "no-store")
    assert running.content.startswith(b"\x89PNG")
    assert [a["outcome"] for a in document["history"]] == [None]
    client.stop(job)
    client.wait(job).check()
    final = client._send("GET", f"/v1/bakes/{job.id}/preview")
    assert final.content.startswith(b"\x89PNG") and final.headers["etag"].strip('"') == client.bake(job.id).document["result"]["preview"]
    again = httpx.get(f"{server.url}/v1/bakes/{job.id}/preview", headers={"if-none-match": final.headers["etag"]})
    assert again.status_code == 304
    log = client._send("GET", f"/v1/bakes/{job.id}/log").text.splitlines()
    kinds = [line.split()[1] for line in log]
    assert kinds[0] == "state" and "plan" in kinds and "pass" in kinds and "stop" in kinds and log[-1].endswith("stopped=interrupt")


def test_the_same_bake_is_answered_at_once(client: Client, server: Server) -> None:
    body = {"scene": SCENE, "spec": box_spec()}
    first = httpx.post(f"{server.url}/v1/bakes", json=body, headers={"prefer": "wait=50"}, timeout=60)
    assert (first.status_code, first.json()["state"], first.headers["preference-applied"]) == (200, "succeeded", "wait=50")
    began = time.monotonic()
    second = httpx.post(f"{server.url}/v1/bakes", json=body)
    assert time.monotonic() - began < 1
    assert (second.status_code, second.headers["cache-status"], second.json()["id"]) == (200, "octobake; hit", first.json()["id"])
    forced = client.wait(client.submit(SCENE, box_spec(), fresh=True)).check()
    assert forced.id != first.json()["id"] and forced.result
    assert forced.result["samples"] == first.json()["result"]["samples"]


@pytest.mark.parametrize("limit", [1, 600_000_000])
def test_a_bake_that_would_take_more_memory_than_it_may_fails_and_harms_nobody(client: Client, limit: int) -> None:
    """Told from its plan; what a process really comes to is watched too: see test_driver.py."""
    probes = (2, 2, 2) if limit == 1 else (40, 40, 40)
    spec = {**box_spec(1_000_000, probes), "seed": limit}
    body = {"scene": SCENE, "spec": spec, "limits": {"memory_bytes": limit}}
    job = client.bake(client._send("POST", "/v1/bakes", json=body).json()["id"])
    with pytest.raises(JobFailed) as caught:
        client.wait(job).check()
    assert caught.value.slug == "job.over_memory" and str(limit) in caught.value.message
    assert client.wait(client.submit(SCENE, {**box_spec(), "seed": limit})).check().result


def test_limits_end_a_bake_within_its_budget(client: Client) -> None:
    body = {"scene": SCENE, "spec": {**box_spec(1_000_000), "seed": 5}, "limits": {"samples": 8}}
    job = client.bake(client._send("POST", "/v1/bakes", json=body).json()["id"])
    done = client.wait(job).check()
    assert done.result and done.result["samples"] == 8 and done.spec["stop"]["max_samples"] == 8
    body = {"scene": SCENE, "spec": {**box_spec(1_000_000), "seed": 6}, "limits": {"seconds": 0.5}}
    done = client.wait(client.bake(client._send("POST", "/v1/bakes", json=body).json()["id"])).check()
    assert done.result and done.result["stopped"] == "time"


def test_a_webhook_hears_of_a_real_bake(client: Client) -> None:
    receiver = Receiver()
    try:
        body = {"scene": SCENE, "spec": {**box_spec(4), "seed": 9}, "webhook": receiver.url}
        job = client._send("POST", "/v1/bakes", json=body).json()["id"]
        wait_for(lambda: receiver.heard, 60)
    finally:
        receiver.close()
    told = json.loads(receiver.heard[0][1])
    assert told["type"] == "bake.succeeded" and told["data"]["result"]["bundle"] == client.bake(job).document["result"]["bundle"]


def test_another_try_of_a_cancelled_bake_is_as_good_as_a_first(client: Client) -> None:
    spec = {**box_spec(64, (4, 4, 4)), "seed": 11}
    job = client.submit(SCENE, spec)
    client.cancel(job)
    assert client.wait(job).state == "cancelled"
    wait_for(lambda: client._http.post(f"/v1/bakes/{job.id}:requeue").status_code == 200, 10)
    done = client.wait(job).check()
    assert done.result
    other = client.wait(client.submit(SCENE, spec, fresh=True)).check()
    assert other.result and done.result["preview"] == other.result["preview"]


def answer_to(server: Server, head: str) -> bytes:
    """What the service says to a request of which only the head is sent."""
    parts = urlsplit(server.url)
    with socket.create_connection((parts.hostname, parts.port), timeout=10) as s:
        s.sendall(head.encode())
        return s.recv(4096)


def test_a_blob_that_is_here_is_answered_before_it_is_sent(server: Server) -> None:
    head = "PUT /v1/blobs/{} HTTP/1.1\r\nHost: x\r\nContent-Length: {}\r\nExpect: 100-continue\r\n\r\n"
    assert answer_to(server, head.format(SCENE, len(BOX))).startswith(b"HTTP/1.1 204 ")
    assert answer_to(server, head.format("sha256:" + "1" * 64, len(BOX))).startswith(b"HTTP/1.1 100 ")
    assert answer_to(server, head.format("sha256:" + "1" * 64, 2**40)).startswith(b"HTTP/1.1 413 ")


def test_events_are_replayed_over_the_wire_from_the_last_id(client: Client, server: Server) -> None:
    job = client.wait(client.submit(SCENE, box_spec()))
    events = [e for e in client.events(job) if e.id]
    middle = events[len(events) // 2]
    assert [e.id for e in client.events(job, middle.id or 0) if e.id] == [e.id for e in events if (e.id or 0) > (middle.id or 0)]
    # One that has heard all of it is told nothing, and not kept waiting.
    rest = httpx.get(f"{server.url}/v1/bakes/{job.id}/events", headers={"last-event-id": str(events[-1].id)}, timeout=5)
    assert "event:" not in rest.text


@pytest.mark.slow
def test_a_service_that_listens_to_others_asks_for_a_token(tmp_path: Path, box: Path) -> None:
    """From a user's end: make a token, serve, submit with it, and see the audit log."""
    data = tmp_path / "data"
    secret = octobake("token", "create", "ci", "--scope", "submit", "--scope", "read", "--data", data).stdout.strip()
    server = Server(data, "--host", "0.0.0.0")
    try:
        url = server.url.replace("0.0.0.0", "127.0.0.1")
        (tmp_path / "spec.json").write_text(json.dumps(box_spec(4)))
        submit = ("submit", box, "--spec", tmp_path / "spec.json", "--server", url)
        refused = octobake(*submit)
        assert (refused.returncode, "[request.no_token]" in refused.stderr) == (2, True), refused.stderr
        done = subprocess.run(
            [*OCTOBAKE, *map(str, submit), "--fetch", str(tmp_path / "out.zip")],
            env=environment(OCTOBAKE_TOKEN=secret),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert read_bundle(tmp_path / "out.zip").manifest["samples"] == 4
        written = [json.loads(line) for line in (data / "audit.jsonl").read_text().splitlines()]
        assert {w["token"] for w in written} == {"-", "ci"} and {"POST"} < {w["method"] for w in written}
        assert secret not in (data / "audit.jsonl").read_text()
    finally:
        server.close()


def test_health_answers_while_a_bake_is_posted_with_patience(client: Client, server: Server) -> None:
    """Those that wait hold up nobody."""
    job = endless(client)
    threads = [
        threading.Thread(target=lambda: httpx.get(f"{server.url}/v1/bakes/{job.id}", headers={"prefer": "wait=2"}, timeout=30))
        for _ in range(60)
    ]
    for thread in threads:
        thread.start()
    time.sleep(0.5)
    began = time.monotonic()
    assert httpx.get(f"{server.url}/healthz").status_code == 200
    assert client.bake(job.id).id == job.id
    assert time.monotonic() - began < 1.5
    client.cancel(job)
    for thread in threads:
        thread.join()


def test_an_answer_does_not_wait_for_its_own_acknowledgement(server: Server) -> None:
    """Nagle's algorithm would hold the second segment of an answer until the client's delayed acknowledgement of the first, 40 ms."""
    with httpx.Client(base_url=server.url) as http:
        took = sorted(http.get("/v1/bakes?limit=1").raise_for_status().elapsed.total_seconds() for _ in range(60))
    # Not the median, for the machine may be busy; not the fastest, for a connection's first segments are acknowledged at once.
    assert took[20] < 0.035


@pytest.mark.slow
def test_what_the_service_adds_is_measured(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = octobake("bench", "service", "-o", out, "--runs", "1", "--bake-seconds", "1", timeout=300)
    assert done.returncode == 0, done.stderr
    document = json.loads((out / "service.json").read_text())
    assert len(document["accepted"]) == 50 and len(document["alone"]) == len(document["served"]) == 1
    assert all(0 < a < b < c for a, b, c in zip(document["accepted"], document["begun"], document["done"], strict=True))
