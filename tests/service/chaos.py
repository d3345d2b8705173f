"""Random kills of a service and of its worker, with clients that write down what they were told: ``make chaos``.

``python -m tests.service.chaos --kills 1000`` starts a service, submits jobs with and without cancels, and sends SIGKILL to the service or
to its worker at random moments, starts and recoveries included. After the last kill everything may finish; then what clients were told,
what the database holds and what the bundles contain are compared. Exits with 1 where something does not hold, and says what.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import sqlite3
import sys
import tempfile
import threading
import time
import zipfile
from collections import Counter
from contextlib import closing
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx

from bake_core.errors import BakeError
from bake_core.examples import closed_box
from service.jobs import ACTIVE, FINISHED, TRANSITIONS, State
from tests.service.running import Server, box_spec, free_port, living, octobake

# Jobs differ in their seed and so in their bytes: a mix-up would show.
SEEDS = 4
# Some seconds of work in some tens of shards, so that many jobs meet a kill.
SAMPLES, PROBES, SHARD_SECONDS = 64, (4, 4, 4), 0.1
CLIENTS = 3
# Of jobs that clients cancel, and of requests that they send a second time under the same key.
CANCELLED, REPEATED = 0.15, 0.3
# Between two kills, in the mean: a start takes about as long, so that many kills meet one.
KILL_SECONDS = 3.0
# After the last kill.
SETTLE_SECONDS = 600.0


@dataclass
class Histories:
    """What clients were told, in the order in which they were: job to states and lengths of its curve; and what they asked for."""

    acknowledged: dict[str, int] = field(default_factory=dict)
    cancelled: set[str] = field(default_factory=set)
    seen: dict[str, list[tuple[str, int]]] = field(default_factory=dict)
    bundles: dict[str, dict[str, str]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Figures:
    """What is printed."""

    kills_of_service: int
    kills_of_worker: int
    seconds: float
    acknowledged: int
    succeeded: int
    cancelled: int
    lost: int
    shards: int
    shards_committed_twice: int
    passes_merged_twice: int
    without_an_owner: int
    bundles_compared: int
    faults: list[str]


class Clients:
    """Threads that submit, look, cancel and fetch, whatever becomes of the service; each writes down every answer."""

    def __init__(self, server: Server, scene: str, seed: int) -> None:
        self.told = Histories()
        self.stopping = threading.Event()
        self._server, self._scene = server, scene
        self._threads = [threading.Thread(target=self._live, args=(random.Random(f"{seed}-{i}"),), daemon=True) for i in range(CLIENTS)]
        for thread in self._threads:
            thread.start()

    def join(self) -> None:
        """Let every client see its last job to its end."""
        self.stopping.set()
        for thread in self._threads:
            thread.join()

    def _live(self, chance: random.Random) -> None:
        try:
            while not self.stopping.is_set():
                self._follow(chance, *self._submit(chance))
        except Exception as e:
            self.told.faults.append(f"a client ended: {type(e).__name__}: {e}")

    def _submit(self, chance: random.Random) -> tuple[str, int]:
        seed, key = chance.randrange(SEEDS), f"{chance.getrandbits(64):x}"
        job = self._post(seed, key)
        self.told.acknowledged[job] = seed
        if chance.random() < REPEATED and self._post(seed, key) != job:
            self.told.faults.append(f"key {key} of job {job} was answered with another job")
        return job, seed

    def _post(self, seed: int, key: str) -> str:
        body = {"scene": self._scene, "spec": spec(seed)}
        # Without no-cache, one bake would answer for all of them.
        answer = self._ask("POST", "/v1/bakes", (200, 202), json=body, headers={"Idempotency-Key": key, "Cache-Control": "no-cache"})
        job: str = answer.json()["id"]
        return job

    def _follow(self, chance: random.Random, job: str, seed: int) -> None:
        give_up = time.monotonic() + chance.uniform(0, 3) if chance.random() < CANCELLED else float("inf")
        deadline = None
        seen = self.told.seen.setdefault(job, [])
        while True:
            document = self._ask("GET", f"/v1/bakes/{job}", (200,)).json()
            now = document["state"], len(document["curve"])
            if not seen or seen[-1] != now:
                seen.append(now)
            if now[0] in FINISHED:
                break
            if time.monotonic() > give_up:
                self._ask("POST", f"/v1/bakes/{job}:cancel", (200,))
                self.told.cancelled.add(job)
                give_up = float("inf")
            if self.stopping.is_set():
                deadline = deadline or time.monotonic() + SETTLE_SECONDS
                if time.monotonic() > deadline:
                    return
            time.sleep(0.05)
        if now[0] == State.SUCCEEDED:
            self.told.bundles[job] = contents(self._ask("GET", f"/v1/bakes/{job}/bundle", (200,)).content)

    def _ask(self, method: str, path: str, expected: tuple[int, ...], **arguments: Any) -> httpx.Response:
        """One request until it is answered: a service that was killed is started again, and whoever asks cannot know what it had done."""
        began = time.monotonic()
        while True:
            try:
                answer = httpx.request(method, self._server.url + path, timeout=30, **arguments)
            except httpx.TransportError:
                if time.monotonic() - began > SETTLE_SECONDS:
                    raise
            else:
                if answer.status_code in expected:
                    return answer
                # The first request with this key was being answered when the service died, or still is.
                if answer.status_code != 409 or answer.json()["slug"] != "request.key_in_flight":
                    self.told.faults.append(f"{method} {path} answered {answer.status_code}: {answer.text}")
                    raise BakeError("bake.internal", answer.text, path)
            time.sleep(0.1)


def spec(seed: int) -> dict[str, Any]:
    """The work of a seed."""
    return box_spec(SAMPLES, PROBES, seed=seed)


def contents(bundle: bytes) -> dict[str, str]:
    """Digest of every file of a bundle but the report, which holds times."""
    with tempfile.TemporaryFile() as file:
        file.write(bundle)
        with zipfile.ZipFile(file) as archive:
            return {n: hashlib.sha256(archive.read(n)).hexdigest() for n in archive.namelist() if not n.startswith("report.")}


def expected_contents(folder: Path) -> list[dict[str, str]]:
    """What `octobake bake` makes of each seed's work, with no service and no kill."""
    made = []
    for seed in range(SEEDS):
        (folder / "spec.json").write_text(json.dumps(spec(seed)))
        out = folder / f"expected-{seed}.zip"
        done = octobake("bake", folder / "box.glb", "--spec", folder / "spec.json", "-o", out, timeout=600)
        assert done.returncode == 0, done.stderr
        made.append(contents(out.read_bytes()))
    return made


def watch_commits(database: Path) -> None:
    """Let the database itself write down every commit, for a row that is written twice looks like one."""
    with closing(sqlite3.connect(database, timeout=30)) as store:
        store.executescript(
            """
            CREATE TABLE chaos (what TEXT NOT NULL, job TEXT NOT NULL, pass INTEGER NOT NULL, shard INTEGER);
            CREATE TRIGGER chaos_shard AFTER INSERT ON shards BEGIN
              INSERT INTO chaos VALUES ('shard', NEW.job, NEW.pass_index, NEW."index");
            END;
            CREATE TRIGGER chaos_shard_again AFTER UPDATE ON shards BEGIN
              INSERT INTO chaos VALUES ('shard', NEW.job, NEW.pass_index, NEW."index");
            END;
            CREATE TRIGGER chaos_pass AFTER UPDATE OF state ON passes BEGIN
              INSERT INTO chaos VALUES ('pass', NEW.job, NEW."index", NULL);
            END;
            """
        )


def run(folder: Path, kills: int, seed: int, every: float = KILL_SECONDS) -> Figures:
    """Kill so often, let everything finish, and check."""
    scene, _ = closed_box(0.5, 1.0)
    (folder / "box.glb").write_bytes(scene)
    expected = expected_contents(folder)
    options = ("--shard-seconds", str(SHARD_SECONDS), "--port", str(free_port()), "--max-attempts", str(kills + 1))
    # One address asks here for what many would.
    server = Server(folder / "data", *options, "--max-requests-per-second", "100000")
    try:
        server.wait_ready()
        watch_commits(server.data / "octobake.sqlite")
        headers = {"Content-Type": "model/gltf-binary"}
        digest = httpx.post(f"{server.url}/v1/scenes", content=scene, headers=headers, timeout=60).json()["digest"]
        clients = Clients(server, digest, seed)
        began = time.monotonic()
        counted = _kill(server, clients.told, kills, random.Random(seed), every)
        if server.process.poll() is not None:
            server.start()
        clients.join()
        seconds = time.monotonic() - began
        server.stop()
    finally:
        server.close()
    return check(clients.told, server.data, expected, counted, seconds)


def _kill(server: Server, told: Histories, kills: int, chance: random.Random, every: float) -> Counter[str]:
    counted: Counter[str] = Counter()
    while counted.total() < kills:
        time.sleep(chance.expovariate(1 / every))
        if counted.total() % 50 == 0:
            print(f"{counted.total()} kills, {len(told.acknowledged)} jobs acknowledged", file=sys.stderr, flush=True)
        if chance.random() < 0.5:
            server.bake_worker().kill()
            counted["worker"] += 1
            continue
        server.kill()
        counted["service"] += 1
        left = living(server.family, 5)
        if left:
            told.faults.append(f"outlived the service: {left}")
        # Every other one may be killed while it starts.
        server.start(wait=chance.random() < 0.5)
    return counted


def check(told: Histories, data: Path, expected: list[dict[str, str]], kills: Counter[str], seconds: float) -> Figures:
    """Compare what was told with what there is."""
    faults = list(told.faults)
    with closing(sqlite3.connect(data / "octobake.sqlite")) as store:
        assert store.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        states = dict(store.execute("SELECT id, state FROM jobs"))
        moves: dict[str, list[str]] = {}
        for job, event in store.execute("SELECT job, data FROM events WHERE type = 'state' ORDER BY id"):
            moves.setdefault(job, []).append(json.loads(event)["state"])
        commits = Counter(store.execute("SELECT what, job, pass, shard FROM chaos"))
    lost = [job for job in told.acknowledged if job not in states]
    for job, states_of in moves.items():
        for before, after in pairwise(states_of):
            if State(after) not in TRANSITIONS[State(before)]:
                faults.append(f"job {job} went from {before} to {after}")
    for job, seen in told.seen.items():
        # What a client saw is what there was, in the same order: an iterator that both walk along says so.
        there = iter(moves.get(job, []))
        if not all(state in there for state in _without_repeats([s for s, _ in seen])):
            faults.append(f"job {job} was seen as {seen}, and was {moves.get(job)}")
        if any(b < a for (_, a), (_, b) in pairwise(seen)):
            faults.append(f"job {job} lost points of its curve: {seen}")
    owners = [job for job, state in states.items() if State(state) in ACTIVE or state in (State.QUEUED, State.CANCELLING)]
    for job, state in states.items():
        if (state == State.CANCELLED and job not in told.cancelled) or state == State.FAILED:
            faults.append(f"job {job} is {state}, and nobody asked for it")
    for job, made in told.bundles.items():
        if made != expected[told.acknowledged[job]]:
            faults.append(f"job {job} has other bytes than octobake bake")
    work = list((data / "blobs" / "work").glob("*/*"))
    if work:
        faults.append(f"left behind: {work}")
    twice = Counter(what for (what, *_), times in commits.items() if times > 1)
    finished = Counter(states.values())
    return Figures(
        kills_of_service=kills["service"],
        kills_of_worker=kills["worker"],
        seconds=round(seconds, 1),
        acknowledged=len(told.acknowledged),
        succeeded=finished[State.SUCCEEDED],
        cancelled=finished[State.CANCELLED],
        lost=len(lost),
        shards=sum(1 for what, *_ in commits if what == "shard"),
        shards_committed_twice=twice["shard"],
        passes_merged_twice=twice["pass"],
        without_an_owner=len(owners),
        bundles_compared=len(told.bundles),
        faults=faults,
    )


def _without_repeats(states: list[str]) -> list[str]:
    return [s for i, s in enumerate(states) if i == 0 or states[i - 1] != s]


def holds(figures: Figures) -> bool:
    """Whether all that was promised is so."""
    wrong = figures.lost, figures.shards_committed_twice, figures.passes_merged_twice, figures.without_an_owner, len(figures.faults)
    return not any(wrong) and figures.bundles_compared > 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the moments and the victims")
    parser.add_argument("--every", type=float, default=KILL_SECONDS, metavar="SECONDS", help="between two kills, in the mean")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="octobake-chaos-") as folder:
        figures = run(Path(folder), args.kills, args.seed, args.every)
    print(json.dumps(asdict(figures), indent=2))
    return 0 if holds(figures) else 1


if __name__ == "__main__":
    sys.exit(main())
