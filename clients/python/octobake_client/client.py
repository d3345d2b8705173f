"""The client: each method is one thing that the service does."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar
from uuid import uuid4

import httpx

from octobake_client import sse
from octobake_client.errors import OctobakeClientError, ServiceError, TransferError, Unreachable
from octobake_client.files import file_digest, scene_files
from octobake_client.jobs import FINISHED, Bake, Event, Job, Point, Progress, Scene, Verification

AnyJob = TypeVar("AnyJob", bound=Job)
# A ping comes every 15 s, so a stream silent for this long is dead.
STREAM_TIMEOUT = 45.0
CHUNK = 1 << 20
PATHS: dict[type[Job], str] = {Bake: "/v1/bakes", Verification: "/v1/verifications"}


class Client:
    """A connection to an octobake service.

    Parameters
    ----------
    base_url : str
        ``http://127.0.0.1:8787``.
    timeout : float
        Seconds for one answer.
    patience : float
        How long, in seconds, a call goes on trying when the connection breaks, as it does when the service is restarted, or when the
        service is too busy. A service that has never answered is not waited for.
    token : str, optional
        What ``octobake token create`` printed; none is needed where the service listens on loopback only.
    transport : httpx.BaseTransport, optional
        In place of the network.
    """

    def __init__(
        self,
        base_url: str,
        *,
        timeout: float = 60.0,
        patience: float = 30.0,
        token: str | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.patience = patience
        self._met = False
        headers = {"User-Agent": "octobake-client", **({"Authorization": f"Bearer {token}"} if token else {})}
        try:
            self._http = httpx.Client(base_url=base_url, timeout=timeout, transport=transport, headers=headers)
        except httpx.InvalidURL as e:
            raise OctobakeClientError("client.bad_url", f"is not a URL: {e}", base_url) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    # Uploads

    def put_blob(self, path: str | os.PathLike[str]) -> str:
        """Upload a file unless the service has it; answers its digest."""
        path = Path(path)
        try:
            digest = file_digest(path)
            url = f"/v1/blobs/{digest}"
            if self._send("HEAD", url, missing=True).status_code == 404:
                # A length, so that the service can refuse what is too large before it is sent.
                headers = {"Content-Type": "application/octet-stream", "Content-Length": str(path.stat().st_size)}
                self._send("PUT", url, file=path, headers=headers)
            return digest
        except OSError as e:
            raise OctobakeClientError("client.unreadable", f"cannot be read: {e.strerror}", str(path)) from None

    def add_scene(self, path: str | os.PathLike[str]) -> Scene:
        """Upload a scene file, of a .gltf the files it names too, and have it read; what the service has is not sent again."""
        path = Path(path)
        files = {name: self.put_blob(file) for name, file in scene_files(path).items()}
        return Scene.of(self._send("POST", "/v1/scenes", json={"root": path.name, "files": files}).json())

    # Jobs

    def submit(
        self,
        scene: str,
        spec: Mapping[str, Any],
        *,
        labels: Mapping[str, str] | None = None,
        priority: int = 0,
        fresh: bool = False,
        key: str | None = None,
    ) -> Bake:
        """Queue a bake of the scene with this digest; one that was made of the same before is the answer, unless it shall be `fresh`.

        However often it has to be sent, one bake comes of it. With a `key` of your own that holds for a day, over calls and processes.
        """
        body = {"scene": scene, "spec": dict(spec), "labels": dict(labels or {}), "priority": priority}
        headers = {"Idempotency-Key": key or uuid4().hex, **({"Cache-Control": "no-cache"} if fresh else {})}
        return Bake.of(self._send("POST", PATHS[Bake], json=body, headers=headers).json())

    def verify(self, bake: Bake | str, *, labels: Mapping[str, str] | None = None, priority: int = 0, **options: Any) -> Verification:
        """Queue a verification of a finished bake; `options` are the request's further keys (see the OpenAPI document)."""
        body = {"bake": bake if isinstance(bake, str) else bake.id, "labels": dict(labels or {}), "priority": priority, **options}
        headers = {"Idempotency-Key": uuid4().hex}
        return Verification.of(self._send("POST", PATHS[Verification], json=body, headers=headers).json())

    def bake(self, job: str) -> Bake:
        """A bake as it stands now."""
        return self._job(Bake, job)

    def verification(self, job: str) -> Verification:
        """A verification as it stands now."""
        return self._job(Verification, job)

    def bakes(self, *, state: str | None = None, labels: Mapping[str, str] | None = None) -> Iterator[Bake]:
        """All bakes, the newest first, page by page as they are taken."""
        asked: dict[str, Any] = {"limit": 100, "label": [f"{k}:{v}" for k, v in (labels or {}).items()]}
        if state is not None:
            asked["state"] = state
        while True:
            page = self._send("GET", PATHS[Bake], params=asked).json()
            yield from map(Bake.of, page["items"])
            if page["next"] is None:
                return
            asked["cursor"] = page["next"]

    def cancel(self, job: AnyJob) -> AnyJob:
        """Ask for a job's end; answers it as it stands then."""
        return type(job).of(self._send("POST", f"{PATHS[type(job)]}/{job.id}:cancel").json())

    def stop(self, bake: Bake) -> Bake:
        """End a running bake with the passes it has; answers it as it stands then."""
        return Bake.of(self._send("POST", f"{PATHS[Bake]}/{bake.id}:stop", again=False).json())

    def events(self, job: Job, after: int = 0) -> Iterator[Event]:
        """A job's events from the first after `after` until it has finished, across broken connections."""
        url = f"{PATHS[type(job)]}/{job.id}/events"
        contact = time.monotonic()
        while True:
            try:
                headers = {"Last-Event-ID": str(after), "Accept": "text/event-stream"}
                timeout = httpx.Timeout(self._http.timeout.connect, read=STREAM_TIMEOUT)
                with self._http.stream("GET", url, headers=headers, timeout=timeout) as answer:
                    if answer.status_code != 200:
                        answer.read()
                        raise ServiceError.of(answer)
                    for event in sse.parse(answer.iter_lines()):
                        contact = time.monotonic()
                        after = event.id or after
                        yield event
                        if event.type == "state" and event.document["state"] in FINISHED:
                            return
                reason = "the stream ended early"
            except httpx.TransportError as e:
                reason = _reason(e)
            self._pause(contact, url, reason)

    def wait(self, job: AnyJob, progress: Callable[[Progress], None] | None = None, point: Callable[[Point], None] | None = None) -> AnyJob:
        """Follow a job until it has finished; answers it as it stands then. See :meth:`Job.check`.

        `point` is told every point of a bake's curve, those first that there are already; `progress` only the latest.
        """
        last = 0
        while True:
            for event in self.events(job, last):
                last = event.id or last
                if event.type == "progress" and progress:
                    progress(Progress.of(event.document))
                if event.type == "pass" and point:
                    point(Point.of(event.document))
            now = self._job(type(job), job.id)
            # One that was queued again has finished before, and goes on.
            if now.done:
                return now

    # Downloads

    def fetch(self, bake: Bake | str, out: str | os.PathLike[str]) -> Path:
        """Download a bake's bundle to `out`, a zip.

        Written beside `out` under a name with its digest and renamed when it is whole and right, so that a second call goes on where the
        first was interrupted.

        Raises
        ------
        TransferError
            Where the bytes that arrived do not have the digest.
        """
        name = bake if isinstance(bake, str) else bake.id
        return self._download(f"{PATHS[Bake]}/{name}/bundle", Path(out))

    def fetch_files(self, verification: Verification, folder: str | os.PathLike[str]) -> list[Path]:
        """Download all files of a verification into `folder`."""
        folder = Path(folder)
        names: Sequence[str] = sorted((verification.result or {}).get("files", ()))
        for name in names:
            # The service makes these names; whoever answers in its stead shall not write elsewhere all the same.
            if not (folder / name).resolve().is_relative_to(folder.resolve()):
                raise TransferError("client.unsafe_name", "a file's name leads out of the folder", name)
        return [self._download(f"{PATHS[Verification]}/{verification.id}/files/{name}", folder / name) for name in names]

    def report(self, bake: Bake | str) -> dict[str, Any]:
        """A bake's report.json."""
        name = bake if isinstance(bake, str) else bake.id
        document: dict[str, Any] = self._send("GET", f"{PATHS[Bake]}/{name}/report").json()
        return document

    # How it is done

    def _job(self, kind: type[AnyJob], job: str) -> AnyJob:
        return kind.of(self._send("GET", f"{PATHS[kind]}/{job}").json())

    def _send(
        self, method: str, url: str, *, missing: bool = False, again: bool = True, file: Path | None = None, **arguments: Any
    ) -> httpx.Response:
        """One request; raises for every answer that is no success, but for 404 where `missing` is expected.

        It is sent `again` where nobody can know what became of it, and where the service asks for that; `file` is its body, read anew each
        time.
        """
        contact = time.monotonic()
        while True:
            try:
                answer = self._once(method, url, file, arguments)
            except httpx.TransportError as e:
                if not (again and self._met):
                    raise Unreachable(str(self._http.base_url.join(url)), _reason(e)) from None
                self._pause(contact, url, _reason(e))
                continue
            self._met = True
            if answer.is_success or (missing and answer.status_code == 404):
                return answer
            wait = _wish(answer)
            if wait is None or time.monotonic() + wait - contact > self.patience:
                break
            time.sleep(wait)
        if method == "HEAD":
            # An answer to HEAD has no body to say why: ask again for one that has, and for no more than a byte should it be there now.
            self._send("GET", url, headers={"Range": "bytes=0-0"})
            return self._send("HEAD", url)
        raise ServiceError.of(answer)

    def _once(self, method: str, url: str, file: Path | None, arguments: Mapping[str, Any]) -> httpx.Response:
        if file is None:
            return self._http.request(method, url, **arguments)
        with open(file, "rb") as f:
            return self._http.request(method, url, content=iter(lambda: f.read(CHUNK), b""), **arguments)

    def _pause(self, contact: float, url: str, reason: str) -> None:
        if time.monotonic() - contact > self.patience:
            raise Unreachable(str(self._http.base_url.join(url)), reason)
        time.sleep(0.2)

    def _download(self, url: str, out: Path) -> Path:
        head = self._send("HEAD", url)
        etag = head.headers["ETag"]
        digest, size = etag.strip('"'), int(head.headers["Content-Length"])
        part = out.with_name(f"{out.name}.{digest[-12:]}.part")
        out.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
        contact = time.monotonic()
        while (have := part.stat().st_size) < size:
            try:
                # If-Range: should the file be another one by now, the whole of it comes, with 200.
                headers = {"Range": f"bytes={have}-", "If-Range": etag} if have else {}
                with self._http.stream("GET", url, headers=headers) as answer:
                    if not answer.is_success:
                        answer.read()
                        raise ServiceError.of(answer)
                    with open(part, "ab" if answer.status_code == 206 else "wb") as f:
                        for chunk in answer.iter_raw(CHUNK):
                            f.write(chunk)
                            contact = time.monotonic()
                continue
            except httpx.TransportError as e:
                reason = _reason(e)
            self._pause(contact, url, reason)
        if file_digest(part) != digest:
            part.unlink()
            raise TransferError("client.digest_mismatch", "what arrived does not have its digest; fetch it again", str(out))
        os.replace(part, out)
        return out


def _reason(error: httpx.TransportError) -> str:
    return str(error) or type(error).__name__


def _wish(answer: httpx.Response) -> float | None:
    """Seconds after which a service that is busy, full or still at the same request asks for it again; None where it does not."""
    after = answer.headers.get("Retry-After", "")
    busy = answer.status_code in (429, 503, 507) or (answer.status_code == 409 and ServiceError.of(answer).slug == "request.key_in_flight")
    return float(after) if busy and after.isdecimal() else None
