"""The job store: what it promises about states, order and what is committed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import sqlalchemy as sa

from bake_core.errors import MachineError
from service.jobs import FINISHED, TRANSITIONS, IllegalTransition, Kind, State
from service.store import Store


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An empty store."""
    store = Store(f"sqlite:///{tmp_path / 'jobs.sqlite'}")
    yield store
    store.close()


def add(store: Store, priority: int = 0) -> str:
    return store.add_job(Kind.BAKE, {"scene": "s", "spec": {}}, {}, priority).id


def test_every_state_can_be_reached_and_left_or_is_final() -> None:
    assert set(TRANSITIONS) == set(State)
    reached = set().union(*TRANSITIONS.values())
    assert reached == set(State)
    assert {State.SUCCEEDED, State.FAILED, State.CANCELLED, State.EXPIRED} == FINISHED


@pytest.mark.parametrize("after", list(State))
def test_only_the_table_s_transitions_happen(store: Store, after: State) -> None:
    job = add(store)
    if after in TRANSITIONS[State.QUEUED]:
        assert store.move(job, after).state == after
    else:
        with pytest.raises(IllegalTransition):
            store.move(job, after)
        found = store.job(job)
        assert found
        assert found.state == State.QUEUED
        assert len(store.events(job)) == 1, "what did not happen is no event"


def test_the_queue_goes_by_priority_then_by_age(store: Store) -> None:
    low, first, second, high = add(store, -1), add(store), add(store), add(store, 5)
    assert [claimed.id for claimed in iter(store.claim, None)] == [high, first, second, low]


def test_a_job_is_claimed_once(store: Store) -> None:
    jobs = {add(store) for _ in range(20)}
    claimed: list[str] = []

    def work() -> None:
        claimed.extend(job.id for job in iter(store.claim, None))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(claimed) == sorted(jobs)


def test_a_restart_queues_again_what_nobody_drives(store: Store) -> None:
    running, cancelling, queued, done = add(store), add(store), add(store), add(store)
    for job in (running, cancelling, done):
        store.move(job, State.PREPARING)
        store.move(job, State.RUNNING)
    store.cancel(cancelling)
    store.move(done, State.FAILED, error={"slug": "x", "where": "", "message": "", "exit_code": 3})
    store.reconcile()
    states = {job.id: job.state for job in store.list_jobs(Kind.BAKE, limit=10)}
    assert states == {running: State.QUEUED, cancelling: State.CANCELLED, queued: State.QUEUED, done: State.FAILED}
    assert [e.data["state"] for e in store.events(running)] == ["queued", "preparing", "running", "queued"]


def test_a_shard_is_committed_once(store: Store) -> None:
    job = add(store)
    opened = store.begin_pass(job, 0, 0, 16, 2)
    store.commit_shard(job, 0, 1, "first", 1.0)
    store.commit_shard(job, 0, 1, "second", 2.0)
    assert {i: s.tally for i, s in store.shards(job, 0).items()} == {1: "first"}
    store.commit_pass(job, replace(opened, state="sums", error=0.5, seconds=3.0, rays=7), {"stage": "tracing"})
    assert [(p.last, p.state, p.error, p.seconds, p.rays) for p in store.passes(job)] == [(16, "sums", 0.5, 3.0, 7)]
    assert store.events(job)[-1].data == {"samples": 16, "rays": 7, "seconds": 3.0, "error": 0.5}


def test_what_is_committed_is_on_the_disk(store: Store) -> None:
    with store._read() as c:
        assert c.exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"
        assert c.exec_driver_sql("PRAGMA synchronous").scalar() == 2, "FULL"


def test_tables_of_another_version_are_refused(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'jobs.sqlite'}"
    store = Store(url)
    with store.engine.begin() as c:
        c.execute(sa.text("ALTER TABLE passes DROP COLUMN rays"))
    store.close()
    with pytest.raises(MachineError) as caught:
        Store(url)
    assert caught.value.slug == "service.other_version"
    assert "rays" in caught.value.message and "jobs.sqlite" in caught.value.where
