"""A blob store that is slow, or refuses: whoever only asks is answered meanwhile, and nothing that was sent is lost or said to be there."""

from __future__ import annotations

import asyncio
import hashlib
import os
import threading
from pathlib import Path
from typing import Any

import httpx
import obstore
import pytest
from obstore.exceptions import GenericError

from service.blobs import Blobs, blob_key
from service.jobs import Kind, State
from service.parts import Service
from service.routes.files import THREADS
from tests.service.running import InProcess

# More than any pool of threads holds.
UPLOADS = 2 * THREADS
# Far longer than any of these answers takes, far shorter than the store does.
SOON = 5.0


def named(data: bytes) -> str:
    """The digest that a blob goes by."""
    return "sha256:" + hashlib.sha256(data).hexdigest()


def test_requests_are_answered_while_the_store_hangs(service: Service, http: InProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()
    put = Blobs.put

    def slow(self: Blobs, path: Path, key: str) -> None:
        assert released.wait(60)
        put(self, path, key)

    monkeypatch.setattr(Blobs, "put", slow)
    job = service.store.add_job(Kind.BAKE, {"scene": named(b""), "spec": {}}, {}, 0)
    blobs = [os.urandom(64) for _ in range(UPLOADS)]

    async def all_at_once() -> list[int]:
        transport = httpx.ASGITransport(http.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://octobake", timeout=None) as client:
            uploads = [asyncio.create_task(client.put(f"/v1/blobs/{named(data)}", content=data)) for data in blobs]
            await asyncio.sleep(0.5)
            assert not any(upload.done() for upload in uploads)
            try:
                async with asyncio.timeout(SOON):
                    assert (await client.get("/healthz")).status_code == 200
                    assert (await client.get("/v1/bakes")).json()["items"][0]["id"] == job.id
                    assert (await client.head(f"/v1/blobs/{named(blobs[0])}")).status_code == 404, "it is not there before it is"
                    cancelled = await client.post(f"/v1/bakes/{job.id}:cancel")
                    assert cancelled.json()["state"] == State.CANCELLED
            finally:
                released.set()
            return [answer.status_code for answer in await asyncio.gather(*uploads)]

    assert asyncio.run(all_at_once()) == [201] * UPLOADS
    assert all(service.blobs.local_path(named(data)).read_bytes() == data for data in blobs)


def test_a_store_that_refuses_is_told_before_an_answer_has_begun(
    service: Service, http: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A download is a 503, not a 200 that breaks off; an upload is a 503, too, and is not said to be there."""
    data = os.urandom(64)
    made, _ = service.blobs.put_blob(write(service.blobs.staging("upload"), data))
    service.store.add_blob(made, len(data))
    job = service.store.add_job(Kind.BAKE, {}, {}, 0)
    service.store.claim()
    for state in (State.RUNNING, State.FINALIZING):
        service.store.move(job.id, state)
    service.store.move(job.id, State.SUCCEEDED, result={"bundle": made})
    assert http.get(f"/v1/bakes/{job.id}/bundle").content == data

    def refuse(*_: Any, **__: Any) -> Any:
        raise GenericError("out of reach")

    with monkeypatch.context() as broken:
        broken.setattr(obstore, "get_async", refuse)
        broken.setattr(Blobs, "put", refuse)
        download = http.get(f"/v1/bakes/{job.id}/bundle")
        other = os.urandom(64)
        upload = http.put(f"/v1/blobs/{named(other)}", content=other)
    for answer in (download, upload):
        assert (answer.status_code, answer.json()["slug"]) == (503, "service.store_unavailable")
        assert answer.headers["retry-after"]
    assert http.head(f"/v1/blobs/{named(other)}").status_code == 404
    assert http.put(f"/v1/blobs/{named(other)}", content=other).status_code == 201
    assert http.get(f"/v1/bakes/{job.id}/bundle").content == data
    assert service.blobs.root is not None
    kept = [path.relative_to(service.blobs.root).as_posix() for path in service.blobs.root.rglob("*") if path.is_file()]
    assert sorted(kept) == sorted(blob_key(digest) for digest in (made, named(other)))


def write(path: Path, data: bytes) -> Path:
    """A file to be moved into the store."""
    path.write_bytes(data)
    return path
