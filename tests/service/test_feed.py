"""Hundreds who follow one job share their looks into the store, and none of them misses what happens during one."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from service.jobs import Kind, State
from service.parts import Service
from service.routes.events import _follow

LISTENERS = 200


def states(told: list[bytes]) -> list[str]:
    """The states that a listener was told of."""
    return [state for event in told for state in State if b'"%s"' % state.encode() in event]


def test_listeners_share_a_look(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    job = service.store.add_job(Kind.BAKE, {}, {}, 0).id
    looks = 0
    events = service.store.events

    def look(*arguments: Any) -> Any:
        nonlocal looks
        looks += 1
        return events(*arguments)

    monkeypatch.setattr(service.store, "events", look)

    async def listen() -> list[bytes]:
        return [event async for event in _follow(service, job, 0) if isinstance(event, bytes)]

    async def everybody() -> list[list[bytes]]:
        listeners = [asyncio.create_task(listen()) for _ in range(LISTENERS)]
        while service.hub.listeners() < LISTENERS:
            await asyncio.sleep(0.01)
        await asyncio.to_thread(service.store.cancel, job)
        await asyncio.to_thread(service.hub.tell, job)
        return await asyncio.gather(*listeners)

    for told in asyncio.run(everybody()):
        assert states(told) == [State.QUEUED, State.CANCELLED]
    assert looks < LISTENERS / 10


def test_what_happens_during_a_look_is_not_missed(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """A listener who comes, or is rung for, while an older look is under way gets another."""
    job = service.store.add_job(Kind.BAKE, {}, {}, 0).id
    looking, go_on = threading.Event(), threading.Event()
    events = service.store.events

    def slow(*arguments: Any) -> Any:
        found = events(*arguments)
        if not looking.is_set():
            looking.set()
            assert go_on.wait(10)
        return found

    monkeypatch.setattr(service.store, "events", slow)

    async def listen() -> list[bytes]:
        return [event async for event in _follow(service, job, 0) if isinstance(event, bytes)]

    async def both() -> list[list[bytes]]:
        first = asyncio.create_task(listen())
        await asyncio.to_thread(looking.wait, 10)
        await asyncio.to_thread(service.store.cancel, job)
        await asyncio.to_thread(service.hub.tell, job)
        second = asyncio.create_task(listen())
        told = await asyncio.wait_for(second, 2)
        go_on.set()
        return [await asyncio.wait_for(first, 2), told]

    for told in asyncio.run(both()):
        assert states(told) == [State.QUEUED, State.CANCELLED]
