"""Cancels and killed workers: how soon the CPU is idle, and the shard runs again."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import numpy as np
from octobake_client import Bake, Client

from tests.pavilion import SKY, pavilion_spec, write_pavilion
from tests.service.figures.table import Say
from tests.service.figures.work import ENDLESS, submit
from tests.service.running import Server, busy, cancel_to_idle

# Of all cores, while a shard is traced; reading and building before it take one.
TRACING = 0.8
LOOK_SECONDS = 0.1
# Seconds: workers die rarely, and the next one is ready to take over by then.
BETWEEN_KILLS = (8.0, 12.0)


def measure(folder: Path, cancels: int, kills: int, say: Say) -> None:
    """Cancel and kill at random moments while a Lambert box, or a scene of textures, holes, gloss and sky, is traced."""
    pavilion = write_pavilion(folder)
    chance = random.Random(0)
    server = Server(folder / "data", "--max-attempts", str(kills + 1))
    try:
        server.wait_ready()
        with server.client() as client:
            idle = [_cancel(server, client, pavilion, i, chance) for i in range(cancels)]
            say(f"p99 of cancel -> CPU idle, {cancels} cancels", float(np.quantile(idle, 0.99)), 1.0, "s")
            job = client.bake(submit(server, ENDLESS))
            again = _kill(server, client, job, kills, chance)
            say(f"worker killed -> its shard runs again, median of {kills}", float(np.median(again)), 2.0, "s")
            say(f"worker killed -> its shard runs again, slowest of {kills}", max(again), 2.0, "s")
            client.cancel(job)
    finally:
        server.close()


def _cancel(server: Server, client: Client, pavilion: Path, number: int, chance: random.Random) -> float:
    if number % 2:
        job = client.bake(submit(server, {**ENDLESS, "seed": number}))
    else:
        spec = pavilion_spec(client.put_blob(pavilion.with_name(SKY)), stop={"target_error": None, "max_samples": 1_000_000}, seed=number)
        job = client.submit(client.add_scene(pavilion).digest, spec)
    next(e for e in client.events(job) if e.type == "progress" and e.document["stage"] == "tracing")
    time.sleep(chance.uniform(0, 1))
    return cancel_to_idle(server, client, job)


def _kill(server: Server, client: Client, job: Bake, kills: int, chance: random.Random) -> list[float]:
    took: list[float] = []
    next(e for e in client.events(job) if e.type == "progress" and e.document["stage"] == "tracing")
    while len(took) < kills:
        time.sleep(chance.uniform(*BETWEEN_KILLS))
        server.bake_worker().kill()
        killed = time.monotonic()
        # Not by progress, which never falls: what a shard had told before is not told again. Looked for anew each time: at first the one
        # that has been killed may still be there.
        while busy([server.bake_worker()], LOOK_SECONDS) < TRACING * LOOK_SECONDS * (os.cpu_count() or 1):
            pass
        took.append(time.monotonic() - killed)
    return took
