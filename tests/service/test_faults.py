"""Faults, with real processes: killed services and workers, cancels, shutdowns. Whatever happens, the bytes are the same."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil
import pytest
from octobake_client import Bake, Client

from tests.service.running import BOX, Server, box_spec, environment, free_port, living, octobake, wait_for

# Some 5 s of work for two cores, half of it in the last pass: long enough to be interrupted in the middle.
SAMPLES = 128
SPEC = box_spec(samples=SAMPLES, probes=(5, 4, 4))
# Much is committed by then.
SHORT_SHARDS = ("--shard-seconds", "0.2")
# Interrupted by every test that uses it.
ENDLESS = box_spec(samples=1_000_000, probes=(8, 8, 8))
Make = Callable[..., Server]


def contents(bundle: Path) -> dict[str, str]:
    """Digest of every file of a bundle but the report, which holds times."""
    with zipfile.ZipFile(bundle) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist() if not name.startswith("report.")}


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What `octobake bake` makes of the same work, with no service at all."""
    folder = tmp_path_factory.mktemp("expected")
    (folder / "box.glb").write_bytes(BOX)
    (folder / "spec.json").write_text(json.dumps(SPEC))
    done = octobake("bake", folder / "box.glb", "--spec", folder / "spec.json", "-o", folder / "box.zip")
    assert done.returncode == 0, done.stderr
    return contents(folder / "box.zip")


def submit(client: Client, box: Path, spec: dict[str, Any] = SPEC) -> Bake:
    return client.submit(client.add_scene(box).digest, spec)


def until_the_last_pass(client: Client, job: Bake) -> Bake:
    """Wait until only the last pass is missing, and has begun."""
    for event in client.events(job):
        if event.type == "pass" and event.document["samples"] == SAMPLES // 2:
            break
    time.sleep(0.5)
    return client.bake(job.id)


def busy(processes: list[psutil.Process], seconds: float) -> float:
    """CPU seconds that processes use in so many seconds."""

    def used() -> float:
        return sum(sum(p.cpu_times()[:2]) for p in processes if p.is_running())

    before = used()
    time.sleep(seconds)
    return used() - before


def test_a_cancel_frees_the_cpu_within_a_second(server: Server, box: Path) -> None:
    with server.client() as client:
        waits = []
        for _ in range(3):
            job = submit(client, box, ENDLESS)
            next(e for e in client.events(job) if e.type == "progress" and e.document["fraction"] > 0.02)
            began = time.monotonic()
            assert client.cancel(job).state in ("cancelling", "cancelled")
            assert client.wait(job).state == "cancelled"
            waits.append(time.monotonic() - began)
            assert busy(server.workers(), 0.3) < 0.15
            assert not (server.data / "blobs" / "work" / job.id).exists()
        assert max(waits) < 1.0, waits
        print("cancel to idle:", [f"{w:.3f}" for w in waits])
        client.wait(submit(client, box, box_spec())).check()


def test_nothing_listens_but_on_loopback(server: Server) -> None:
    listening = [
        connection.laddr.ip
        for process in (psutil.Process(server.process.pid), *server.workers())
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    ]
    assert len(listening) >= 2
    assert set(listening) == {"127.0.0.1"}


def test_two_services_do_not_share_a_data_folder(server: Server) -> None:
    second = octobake("serve", "--port", "0", "--data", server.data)
    assert second.returncode == 3
    assert "service.data_in_use" in second.stderr
    assert "Traceback" not in second.stderr


def test_an_interrupted_upload_leaves_nothing(server: Server) -> None:
    where = urlsplit(server.url)
    with socket.create_connection((where.hostname, where.port)) as connection:
        head = f"PUT /v1/blobs/sha256:{'0' * 64} HTTP/1.1\r\nHost: x\r\nContent-Length: 5000000\r\n\r\n"
        connection.sendall(head.encode() + os.urandom(2_000_000))
        upload = server.data / "blobs" / "upload"
        wait_for(lambda: upload.is_dir() and list(upload.iterdir()), 10)
    wait_for(lambda: not list(upload.iterdir()), 10)


def test_a_piece_that_always_kills_its_worker_fails_and_does_not_take_the_queue_with_it(server: Server, box: Path) -> None:
    with server.client() as client:
        job, other = submit(client, box, ENDLESS), submit(client, box, box_spec())
        events = client.events(job)
        # The stream ends when the job has failed.
        while next((e for e in events if e.type == "progress" and e.document["fraction"] > 0.02), None):
            server.bake_worker().kill()
            killed = time.monotonic()
            # A kill between two pieces loses none: work goes on, and it is tried again.
            next((e for e in events if e.type == "retry" or (e.type == "progress" and time.monotonic() - killed > 8)), None)
        failed = client.bake(job.id)
        assert failed.error
        assert (failed.state, failed.error["slug"]) == ("failed", "bake.crashed")
        assert failed.attempts >= 3
        assert client.wait(other).check().attempts == 0, "nobody else is blamed"


def test_a_killed_worker_s_shard_is_run_again(make_server: Make, box: Path, tmp_path: Path, expected: dict[str, str]) -> None:
    server = make_server()
    with server.client() as client:
        job = submit(client, box)
        last = next(e.id or 0 for e in client.events(job) if e.type == "pass" and e.document["samples"] == SAMPLES // 2)
        time.sleep(0.5)
        server.bake_worker().kill()
        killed = time.monotonic()
        events = client.events(job, last)
        next(e for e in events if e.type == "retry")
        next(e for e in events if e.type == "progress")
        print(f"shard running again {time.monotonic() - killed:.2f} s after the kill")
        done = client.wait(job).check()
        assert done.attempts == 1
        assert contents(client.fetch(done, tmp_path / "box.zip")) == expected


def test_a_job_survives_the_kill_of_its_service(make_server: Make, box: Path, tmp_path: Path, expected: dict[str, str]) -> None:
    # The same port again, so that a client that waits finds the service when it is back.
    server = make_server("data", *SHORT_SHARDS, "--port", str(free_port()))
    waited: list[Bake] = []
    with server.client() as client:
        running, queued = submit(client, box), submit(client, box, box_spec())
        before = until_the_last_pass(client, running)
        assert before.state == "running"

    def wait() -> None:
        with Client(server.url, patience=60) as patient:
            waited.append(patient.wait(running))

    waiting = threading.Thread(target=wait)
    waiting.start()
    server.kill()
    began = time.monotonic()
    assert not living(server.family, 3), "a killed service leaves no processes behind"
    print(f"orphans gone after {time.monotonic() - began:.3f} s")

    server.start()
    with server.client() as client:
        waiting.join(60)
        after = waited[0].check()
        assert contents(client.fetch(after, tmp_path / "a.zip")) == expected
        assert after.curve[: len(before.curve)] == before.curve, "what was committed is not done again"
        client.wait(client.bake(queued.id)).check()
        states = [e.document["state"] for e in client.events(after) if e.type == "state"]
    assert states[:3] == ["queued", "preparing", "running"]
    assert states[3:] == ["queued", "preparing", "running", "finalizing", "succeeded"]
    assert not list((server.data / "blobs" / "work").glob("*/*")), "the work of finished jobs is swept away"


def test_a_cluster_of_somebody_else_s(make_server: Make, box: Path, tmp_path: Path, expected: dict[str, str]) -> None:
    """Two workers of Dask's own, each with a shard at a time: the same bytes again."""
    url = f"tcp://127.0.0.1:{free_port()}"
    common = ["--host", "127.0.0.1", "--no-dashboard"]
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", *common, "--port", url.rpartition(":")[2]]
    worker = [
        sys.executable,
        "-m",
        "distributed.cli.dask_worker",
        *common,
        "--nthreads",
        "1",
        "--no-nanny",
        "--preload",
        "service.worker",
        url,
    ]
    env = environment(DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0")
    processes: list[subprocess.Popen[bytes]] = []
    try:
        with open(tmp_path / "dask.log", "w") as log:
            processes += [
                subprocess.Popen(command, env=env, cwd=tmp_path, stdout=log, stderr=log) for command in (scheduler, worker, worker)
            ]
        server = make_server("data", "--dask", url)
        server.wait_ready()
        assert not server.workers(), "none of its own"
        with server.client() as client:
            done = client.wait(submit(client, box)).check()
            assert contents(client.fetch(done, tmp_path / "box.zip")) == expected
            job = submit(client, box, ENDLESS)
            next(e for e in client.events(job) if e.type == "progress" and e.document["fraction"] > 0.02)
            client.cancel(job)
            assert client.wait(job).state == "cancelled"
            assert busy([psutil.Process(p.pid) for p in processes], 0.3) < 0.15
    finally:
        for process in processes[::-1]:
            process.kill()
            process.wait()


def test_a_shutdown_does_not_wait_for_listeners(make_server: Make, box: Path) -> None:
    server = make_server()
    server.wait_ready()
    seen = threading.Barrier(6)
    with server.client() as client:
        job = submit(client, box, ENDLESS)

    def listen() -> None:
        with Client(server.url, patience=0) as listener:
            events = listener.events(job)
            next(events)
            seen.wait(30)
            with pytest.raises(Exception, match="no answer"):
                list(events)

    listeners = [threading.Thread(target=listen) for _ in range(5)]
    for listener in listeners:
        listener.start()
    seen.wait(30)
    seconds = server.stop()
    for listener in listeners:
        listener.join(10)
    print(f"stopped after {seconds:.2f} s")
    assert server.process.returncode == 0
    assert seconds < 2.0
    assert not living(server.family, 1)
    assert not server._ready.exists()
    server.start()
    with server.client() as client:
        assert client.cancel(client.bake(job.id)).state in ("cancelling", "cancelled")


def test_ctrl_c_stops_everything(make_server: Make) -> None:
    server = make_server()
    server.wait_ready()
    began = time.monotonic()
    # A terminal sends it to the whole group, the worker included.
    for process in [psutil.Process(server.process.pid), *server.family]:
        process.send_signal(signal.SIGINT)
    assert server.process.wait(timeout=10) == 0
    print(f"stopped after {time.monotonic() - began:.2f} s")
    assert "Traceback" not in server.log()
