"""The wall clock jumps, as it does when a machine wakes or is set right: nothing is lost, done twice or kept from being done."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import dask
import pytest

from service import outbox, retention, store
from service.dask_configuration import configure
from service.jobs import Kind, State
from service.parts import Service
from tests.service.running import InProcess, wait_for

DAY = 86400.0


class Wall:
    """The wall clock, and how far it is off."""

    def __init__(self) -> None:
        self.off = 0.0

    def time(self) -> float:
        """Seconds since 1970, so many too many."""
        return time.time() + self.off


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    """The clock that job store and retention go by."""
    wall = Wall()
    for module in (store, retention):
        clocks = SimpleNamespace(time=wall.time, clock_gettime=time.clock_gettime, CLOCK_BOOTTIME=time.CLOCK_BOOTTIME)
        monkeypatch.setattr(module, "time", clocks)
    return wall


@pytest.mark.parametrize("jump", [-400 * DAY, -1.0, 1.0, 20 * DAY])
def test_a_job_goes_its_way_over_a_jump(jump: float, wall: Wall, service: Service, http: InProcess) -> None:
    """The queue's order is that of coming, events keep theirs, and a job that ended "before" it began is shown."""
    first = service.store.add_job(Kind.BAKE, {}, {}, 0)
    claimed = service.store.claim()
    assert claimed and claimed.id == first.id
    wall.off = jump
    later = service.store.add_job(Kind.BAKE, {}, {}, 0)
    service.store.move(first.id, State.RUNNING)
    service.store.move(first.id, State.FAILED, error={"slug": "bake.crashed", "where": "", "message": "died"})
    wall.off = 0.0
    last = service.store.add_job(Kind.BAKE, {}, {}, 0)
    assert [e.data["state"] for e in service.store.events(first.id)] == ["queued", "preparing", "running", "failed"]
    assert [job.id for job in service.store.list_jobs(Kind.BAKE, limit=9)] == [last.id, later.id, first.id]
    order = [service.store.claim(), service.store.claim()]
    assert [job.id for job in order if job] == [later.id, last.id]
    assert [a.outcome for a in service.store.attempts(first.id)] == ["failed"]
    assert http.get(f"/v1/bakes/{first.id}/log").status_code == 200


def test_a_clock_that_is_set_back_takes_nothing_and_one_set_forward_only_what_its_time_is_up(wall: Wall, service: Service) -> None:
    done = service.store.add_job(Kind.BAKE, {}, {}, 0)
    kept = service.store.add_job(Kind.BAKE, {}, {}, 0, pinned=True)
    for job in (done, kept):
        service.store.claim()
        service.store.move(job.id, State.FAILED, error={"slug": "bake.crashed"})
    running = service.store.add_job(Kind.BAKE, {}, {}, 0)
    service.store.claim()
    wall.off = -400 * DAY
    assert not service.retention.clean().jobs
    wall.off = 31 * DAY
    assert service.retention.preview().jobs == (done.id,)
    wall.off = 0.0
    assert not service.retention.clean().jobs, "a clean-up asks the clock anew"
    found = service.store.job(running.id)
    assert found and found.state == State.PREPARING


def test_the_hour_in_which_a_clock_was_moved_cleans_nothing_up(wall: Wall, service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a machine does that boots with a clock of next year, and is set right by the network."""
    monkeypatch.setattr(retention, "CLEAN_SECONDS", 0.1)
    done = service.store.add_job(Kind.BAKE, {}, {}, 0)
    service.store.claim()
    service.store.move(done.id, State.FAILED, error={"slug": "bake.crashed"})
    looked = threading.Event()
    jump = service.retention._jump

    def look() -> float:
        moved = jump()
        looked.set()
        if moved:
            # Set right again before the next look.
            wall.off = 0.0
        return moved

    def state() -> State:
        found = service.store.job(done.id)
        assert found is not None
        return found.state

    monkeypatch.setattr(service.retention, "_jump", look)
    wall.off = 400 * DAY
    service.retention.start()
    assert looked.wait(5)
    time.sleep(0.5)
    assert state() == State.FAILED
    # Where it stays moved, it is believed.
    monkeypatch.setattr(service.retention, "_jump", jump)
    wall.off = 400 * DAY
    wait_for(lambda: state() == State.EXPIRED, 5)


def test_a_key_stands_for_its_request_over_a_jump_back(wall: Wall, service: Service) -> None:
    assert service.store.take_key("me", "key", "request") == ("", None)
    job = service.store.add_job(Kind.BAKE, {}, {}, 0, key=("me", "key"))
    wall.off = -DAY
    assert service.store.take_key("me", "key", "request") == ("request", job.id)
    wall.off = 0.5 * DAY
    assert service.store.take_key("me", "key", "request") == ("request", job.id)
    wall.off = 2 * DAY
    assert service.store.take_key("me", "key", "request") == ("", None), "a client that still tries has been told something else by then"


def test_a_message_waits_no_longer_than_it_was_to_wait(service: Service) -> None:
    """A clock that is set back by a month must not hold a webhook for a month."""
    job = service.store.add_job(Kind.BAKE, {}, {}, 0, webhook="https://example.com/")
    service.store.cancel(job.id)
    now = time.time()
    assert [m.job for m in service.outbox.due(now, 9)] == [job.id]
    (message,) = service.outbox.due(now, 9)
    service.outbox.failed(message, now, "no answer", final=False)
    assert not service.outbox.due(now + outbox.WAITS[0] / 2, 9)
    assert service.outbox.due(now + outbox.WAITS[0], 9)
    back = now - 30 * DAY
    assert service.outbox.due(back, 9), "it was due later than any wait is long: the clock was set back"


def test_a_jump_loses_no_worker() -> None:
    """Dask's own look at its workers goes by the wall clock, so it is left out."""
    configure()
    assert dask.config.get("distributed.scheduler.worker-ttl") is None
