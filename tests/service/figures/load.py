"""Under load: latencies while baking, many listeners, a shutdown under them, a start with many jobs."""

from __future__ import annotations

import asyncio
import json
import secrets
import sqlite3
import time
from contextlib import closing, suppress
from datetime import datetime
from pathlib import Path

import httpx
import numpy as np
import psutil

from tests.service.figures.table import Say
from tests.service.figures.work import ENDLESS, submit, until_running
from tests.service.running import Server, box_spec, wait_for

REQUESTS_PER_SECOND = 50
LISTENERS = 500
JOBS = 10_000


async def requests_while_baking(server: Server, job: str, seconds: float) -> dict[str, list[float]]:
    """Seconds that each of a steady stream of requests takes from the moment at which it was due: half GET, half POST of new bakes."""
    body = {"scene": httpx.get(f"{server.url}/v1/bakes/{job}").json()["scene"], "spec": box_spec(), "priority": -1}
    took: dict[str, list[float]] = {"GET": [], "POST": []}

    async with httpx.AsyncClient(base_url=server.url, timeout=60, limits=httpx.Limits(max_connections=100)) as client:

        async def one(number: int, began: float) -> None:
            due = began + number / REQUESTS_PER_SECOND
            await asyncio.sleep(due - time.monotonic())
            if number % 2:
                # Each its own: the same bake twice would be no work.
                spec = {**body["spec"], "seed": number}
                answer = await client.post("/v1/bakes", json={**body, "spec": spec})
            else:
                answer = await client.get(f"/v1/bakes/{job}")
            answer.raise_for_status()
            took["POST" if number % 2 else "GET"].append(time.monotonic() - due)

        began = time.monotonic() + 0.2
        await asyncio.gather(*(one(i, began) for i in range(int(seconds * REQUESTS_PER_SECOND))))
    return took


async def listen(server: Server, job: str, cancel_after: float | None) -> list[float]:
    """Let many listen to a job until its stream ends: seconds between an event and each listener's having it."""
    lags: list[float] = []
    connected = 0

    address = httpx.URL(server.url)
    request = f"GET /v1/bakes/{job}/events HTTP/1.1\r\nHost: {address.netloc.decode()}\r\nConnection: close\r\n\r\n".encode()

    async def one() -> None:
        nonlocal connected
        began = time.time()
        # Bare connections: a client's pool takes seconds to close hundreds at once, and those would count as the service's.
        reader, writer = await asyncio.open_connection(address.host, address.port)
        writer.write(request)
        assert b" 200 " in await reader.readline()
        connected += 1
        with suppress(ConnectionError):
            while line := await reader.readline():
                if line.startswith(b"data:") and (at := json.loads(line[5:]).get("at")):
                    happened = datetime.fromisoformat(at).timestamp()
                    # Replayed ones happened before anybody listened.
                    if happened > began:
                        lags.append(time.time() - happened)
        writer.close()

    listeners = [asyncio.create_task(one()) for _ in range(LISTENERS)]
    while connected < LISTENERS:
        await asyncio.sleep(0.05)
    if cancel_after is None:
        server.stopped = await asyncio.to_thread(server.stop)  # type: ignore[attr-defined]
    else:
        await asyncio.sleep(cancel_after)
        async with httpx.AsyncClient(base_url=server.url) as client:
            await client.post(f"/v1/bakes/{job}:cancel")
    await asyncio.gather(*listeners)
    return lags


def multiply(database: Path, job: str, count: int) -> None:
    """Fill a stopped service's store with so many queued copies of a job."""
    with closing(sqlite3.connect(database)) as store:
        names = [row[1] for row in store.execute("PRAGMA table_info(jobs)") if row[1] not in ("sequence", "id", "state")]
        columns = ", ".join(f'"{name}"' for name in names)
        query = f"INSERT INTO jobs (id, state, {columns}) SELECT ?, 'queued', {columns} FROM jobs WHERE id = ?"
        store.executemany(query, [(secrets.token_hex(8), job) for _ in range(count)])
        store.commit()


def measure(folder: Path, seconds: float, say: Say) -> None:
    """Measure it in turn."""
    server = Server(folder / "data")
    try:
        server.wait_ready()
        job = submit(server, ENDLESS)
        until_running(server, job)
        process = psutil.Process(server.process.pid)
        before = sum(process.cpu_times()[:2])
        took = asyncio.run(requests_while_baking(server, job, seconds))
        used = sum(process.cpu_times()[:2]) - before
        # What a busy machine does not change much; the goal is half a core.
        say("CPU of the service for a request", 1000 * used / sum(map(len, took.values())), 1000 * 0.5 / REQUESTS_PER_SECOND, "ms")
        for method, goal in (("GET", 0.05), ("POST", 0.25)):
            say(f"p99 of {method} at {REQUESTS_PER_SECOND} requests/s while baking", float(np.quantile(took[method], 0.99)), goal, "s")
        lags = asyncio.run(listen(server, job, min(seconds, 10.0)))
        say(f"p99 of the lag of {len(lags)} events at {LISTENERS} listeners", float(np.quantile(lags, 0.99)), 1.0, "s")
        job = submit(server, {**ENDLESS, "seed": 1})
        asyncio.run(listen(server, job, None))
        say(f"SIGTERM while {LISTENERS} listen -> gone", server.stopped, 2.0, "s")  # type: ignore[attr-defined]
        multiply(server.data / "octobake.sqlite", job, JOBS)
        began = time.monotonic()
        server.start()
        say(f"restart with {JOBS} jobs -> answers", time.monotonic() - began, 5.0, "s")
        wait_for(lambda: httpx.get(f"{server.url}/v1/bakes?state=running").json()["items"], 120)
        say(f"restart with {JOBS} jobs -> one runs again", time.monotonic() - began, 5.0, "s")
        wal = server.data / "octobake.sqlite-wal"
        say("write-ahead log after all this", wal.stat().st_size / 2**20, 64.0, "MB")
    finally:
        server.close()
