"""Faults, with real processes: killed services and workers, cancels, shutdowns. Whatever happens, the bytes are the same."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import socket
import sqlite3
import struct
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from octobake_client import Bake, Client

from tests.pavilion import SKY, pavilion_spec, write_pavilion
from tests.service.running import Server, box_spec, busy, cancel_to_idle, environment, free_port, living, octobake, wait_for

# Some 5 s of work for two cores, half of it in the last pass: long enough to be interrupted in the middle.
SAMPLES = 512
WORK: dict[str, Any] = {"probes": (5, 3, 3), "stop": {"target_error": None, "max_samples": SAMPLES}}
# Much is committed by then.
SHORT_SHARDS = ("--shard-seconds", "0.2")
# Interrupted by every test that uses it.
ENDLESS = {"target_error": None, "max_samples": 1_000_000}
ENDLESS_BOX = box_spec(samples=1_000_000, probes=(8, 8, 8))
Make = Callable[..., Server]


def contents(bundle: Path) -> dict[str, str]:
    """Digest of every file of a bundle but the report, which holds times."""
    with zipfile.ZipFile(bundle) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist() if not name.startswith("report.")}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with everything in it, its sky beside it."""
    return write_pavilion(tmp_path_factory.mktemp("pavilion"))


@pytest.fixture(scope="module")
def expected(scene: Path) -> dict[str, str]:
    """What `octobake bake` makes of the same work, with no service at all."""
    spec, out = scene.with_name("spec.json"), scene.with_name("expected.zip")
    spec.write_text(json.dumps(pavilion_spec(**WORK)))
    done = octobake("bake", scene, "--spec", spec, "-o", out)
    assert done.returncode == 0, done.stderr
    return contents(out)


def submit(client: Client, box: Path, spec: dict[str, Any]) -> Bake:
    return client.submit(client.add_scene(box).digest, spec)


def submit_work(client: Client, scene: Path, **more: Any) -> Bake:
    """The work that is expected, or with other keys more of it."""
    return submit(client, scene, pavilion_spec(client.put_blob(scene.with_name(SKY)), **{**WORK, **more}))


def until_the_last_pass(client: Client, job: Bake) -> Bake:
    """Wait until only the last pass is missing, and has begun."""
    for event in client.events(job):
        if event.type == "pass" and event.document["samples"] == SAMPLES // 2:
            break
    time.sleep(0.5)
    return client.bake(job.id)


def test_a_cancel_frees_the_cpu_within_a_second(server: Server, box: Path, scene: Path) -> None:
    """While it traces: a Lambert box, and a scene of textures, holes, gloss and sky."""
    with server.client() as client:
        for lambert in (True, False, True, False):
            job = submit(client, box, ENDLESS_BOX) if lambert else submit_work(client, scene, stop=ENDLESS)
            next(e for e in client.events(job) if e.type == "progress" and e.document["fraction"] > 0.02)
            seconds = cancel_to_idle(server, client, job)
            print(f"cancel to idle: {seconds:.3f} s")
            assert seconds < 1.0
        client.wait(submit(client, box, box_spec())).check()


def test_a_cancel_frees_the_cpu_where_nothing_looks_at_a_flag(
    make_server: Make, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While kernels are compiled, and while a large scene is read and built: the worker is ended and another begun."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    server = make_server()
    server.wait_ready()
    with server.client() as client:
        many = many_triangles(tmp_path / "many.stl")
        for stage in ("compiling", "building"):
            job = submit_work(client, scene) if stage == "compiling" else submit(client, many, box_spec())
            next(e for e in client.events(job) if e.type == "progress" and e.document["stage"] == stage)
            time.sleep(0.2)
            seconds = cancel_to_idle(server, client, job)
            print(f"cancel to idle while {stage}: {seconds:.3f} s")
            assert seconds < 1.0
            wait_for(lambda: client._http.get("/readyz").status_code == 200, 30)
        assert not leftovers(server)


def many_triangles(path: Path) -> Path:
    """A binary STL of small triangles, enough to be read and built for a second."""
    triangles = np.zeros(500_000, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    random = np.random.default_rng(0)
    triangles["corners"] = random.uniform(-5, 5, (len(triangles), 1, 3)) + random.normal(0, 0.02, (len(triangles), 3, 3))
    path.write_bytes(bytes(80) + struct.pack("<I", len(triangles)) + triangles.tobytes())
    return path


def leftovers(server: Server) -> list[Path]:
    """Files that somebody was making; the locks and empty folders that Dask keeps while it runs are none."""
    found = (server.data / "temporary").rglob("*")
    return [p for p in found if p.is_file() and "dask-scratch-space" not in p.parts]


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
        job, other = submit(client, box, ENDLESS_BOX), submit(client, box, box_spec())
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


def test_a_killed_worker_s_shard_is_run_again(make_server: Make, scene: Path, tmp_path: Path, expected: dict[str, str]) -> None:
    server = make_server("data", *SHORT_SHARDS)
    with server.client() as client:
        job = submit_work(client, scene)
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
    assert not leftovers(server)


@pytest.mark.parametrize("end", ["SIGKILL", "SIGTERM"])
def test_a_job_survives_its_service(end: str, make_server: Make, scene: Path, box: Path, tmp_path: Path, expected: dict[str, str]) -> None:
    """Ended in the middle of its last pass and started again, the service goes on from the shards that were committed."""
    # The same port again, so that a client that waits finds the service when it is back.
    server = make_server("data", *SHORT_SHARDS, "--port", str(free_port()))
    waited: list[Bake] = []
    with server.client() as client:
        running, queued = submit_work(client, scene), submit(client, box, box_spec())
        before = until_the_last_pass(client, running)
        assert before.state == "running"
        wait_for(lambda: committed_files(server, running), 10)

    def wait() -> None:
        with Client(server.url, patience=60) as patient:
            waited.append(patient.wait(running))

    waiting = threading.Thread(target=wait)
    waiting.start()
    began = time.monotonic()
    server.kill() if end == "SIGKILL" else server.stop()
    assert not living(server.family, 3), "no processes are left behind"
    print(f"{end}: gone after {time.monotonic() - began:.3f} s")
    committed = committed_files(server, running)
    assert committed and before.curve

    server.start()
    # Shards are traced in order: once there is one more, those that were there would have been overwritten.
    wait_for(lambda: len(committed_files(server, running)) > len(committed), 60)
    assert committed.items() <= shard_files(server, running).items(), "what was committed is not traced again"
    with server.client() as client:
        waiting.join(60)
        after = waited[0].check()
        assert contents(client.fetch(after, tmp_path / "a.zip")) == expected
        assert after.curve[: len(before.curve)] == before.curve, "what was merged is not merged again"
        client.wait(client.bake(queued.id)).check()
        states = [e.document["state"] for e in client.events(after) if e.type == "state"]
    assert states[:3] == ["queued", "preparing", "running"]
    assert states[3:] == ["queued", "preparing", "running", "finalizing", "succeeded"]
    assert not list((server.data / "blobs" / "work").glob("*/*")), "the work of finished jobs is swept away"
    assert not leftovers(server)


def shard_files(server: Server, job: Bake) -> dict[str, tuple[int, int]]:
    """The stored sums of the last pass's shards: which file each is, and since when."""
    folder = server.data / "blobs" / "work" / job.id
    last = max(int(p.name.split("-")[1]) for p in folder.glob("pass-*-shard-*"))
    return {p.name: (p.stat().st_ino, p.stat().st_mtime_ns) for p in folder.glob(f"pass-{last}-shard-*")}


def committed_files(server: Server, job: Bake) -> dict[str, tuple[int, int]]:
    """Those of them that the job store names: a kill may fall between a file and its row, and such a shard is rightly traced again."""
    with closing(sqlite3.connect(server.data / "octobake.sqlite")) as store:
        named = {row[0].partition("@")[0] for row in store.execute("SELECT tally FROM shards WHERE job = ?", (job.id,))}
    return {name: file for name, file in shard_files(server, job).items() if name in named}


def test_a_cluster_of_somebody_else_s(make_server: Make, scene: Path, tmp_path: Path, expected: dict[str, str]) -> None:
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
            done = client.wait(submit_work(client, scene)).check()
            assert contents(client.fetch(done, tmp_path / "box.zip")) == expected
            job = submit_work(client, scene, stop=ENDLESS)
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
        job = submit(client, box, ENDLESS_BOX)

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
