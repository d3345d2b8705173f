"""Who may do what, how often, how much at once, and what is written down of it."""

from __future__ import annotations

import asyncio
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.app import create_app
from service.parts import Service
from service.routes.guard import is_loopback, needed_scope
from service.settings import Settings
from service.tokens import Scope
from tests.service.running import BOX, InProcess, box_spec, octobake
from tests.service.test_http import problem


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[Service]:
    """The parts of a service that listens to the network."""
    service = Service(Settings(data=str(tmp_path / "data"), host="0.0.0.0"))
    yield service
    service.close()


def bearer(service: Service, *scopes: Scope, name: str = "") -> dict[str, str]:
    return {"authorization": "Bearer " + service.tokens.create(name or "+".join(scopes), scopes)}


def audit(service: Service) -> list[dict[str, Any]]:
    path = service.settings.data_folder / "audit.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_without_a_token_only_health_and_empty_pages(guarded: Service) -> None:
    http = InProcess(create_app(guarded))
    for path in ("/healthz", "/", "/web/jobs.js", "/v1/openapi.json"):
        assert http.get(path).status_code == 200
    problem(http.get("/readyz"), 503, "service.not_ready")
    for method, path in (("GET", "/v1/bakes"), ("GET", "/metrics"), ("POST", "/v1/scenes"), ("POST", "/v1/cleanup"), ("GET", "/nothing")):
        answer = http.request(method, path)
        problem(answer, 401, "request.no_token")
        assert answer.headers["www-authenticate"] == "Bearer"
    for wrong in ("Bearer x", "Bearer ", "Basic eDp5", "Bearer octobake_" + "A" * 43):
        problem(http.get("/v1/bakes", headers={"authorization": wrong}), 401, "request.bad_token")


def test_a_token_is_good_for_its_scopes_only(guarded: Service) -> None:
    http = InProcess(create_app(guarded))
    submit, read, admin = bearer(guarded, Scope.SUBMIT), bearer(guarded, Scope.READ), bearer(guarded, Scope.ADMIN)
    scene = http.post("/v1/scenes", content=BOX, headers=submit)
    assert scene.status_code == 201
    body = {"scene": scene.json()["digest"], "spec": box_spec()}
    job = http.post("/v1/bakes", json=body, headers=submit).json()["id"]
    answer = http.get(f"/v1/bakes/{job}", headers=submit)
    assert "scope read" in problem(answer, 403, "request.forbidden")["detail"]
    assert answer.headers["www-authenticate"] == 'Bearer error="insufficient_scope", scope="read"'
    assert http.get(f"/v1/bakes/{job}", headers=read).status_code == 200
    problem(http.post("/v1/bakes", json=body, headers=read), 403, "request.forbidden")
    problem(http.post(f"/v1/bakes/{job}:pin", headers=submit), 403, "request.forbidden")
    problem(http.get("/v1/cleanup", headers=read), 403, "request.forbidden")
    both = bearer(guarded, Scope.SUBMIT, Scope.READ)
    assert http.post(f"/v1/bakes/{job}:cancel", headers=both).status_code == 200
    for path in (f"/v1/bakes/{job}:pin", "/v1/cleanup", f"/v1/bakes/{job}:requeue"):
        assert http.post(path, headers=admin).status_code == 200, "admin includes the others"
    guarded.tokens.revoke("read")
    problem(http.get("/v1/bakes", headers=read), 401, "request.bad_token")


@pytest.mark.parametrize(
    ("method", "path", "scope"),
    [
        ("GET", "/v1/bakes/x/events", Scope.READ),
        ("HEAD", "/v1/bakes/x/bundle", Scope.READ),
        ("GET", "/web/bakes/x/curve.svg", Scope.READ),
        ("GET", "/web/bakes/x", None),
        ("HEAD", "/v1/blobs/sha256:x", Scope.SUBMIT),
        ("PUT", "/v1/blobs/sha256:x", Scope.SUBMIT),
        ("POST", "/v1/bakes/x:stop", Scope.SUBMIT),
        ("POST", "/v1/verifications/x:unpin", Scope.ADMIN),
        ("DELETE", "/v1/bakes", Scope.SUBMIT),
    ],
)
def test_what_each_request_takes(method: str, path: str, scope: Scope | None) -> None:
    assert needed_scope(method, path) == scope


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("::", False), ("192.168.1.2", False)],
)
def test_what_loopback_is(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


def test_on_loopback_none_is_needed_unless_it_is_asked_for(http: InProcess, tmp_path: Path) -> None:
    assert http.get("/v1/bakes").status_code == 200
    problem(http.get("/v1/bakes", headers={"authorization": "Bearer x"}), 401, "request.bad_token")
    service = Service(Settings(data=str(tmp_path / "asking"), require_token=1))
    problem(InProcess(create_app(service)).get("/v1/bakes"), 401, "request.no_token")
    service.close()


def test_pages_keep_a_token_in_a_cookie(guarded: Service) -> None:
    """It reads; what changes something takes the header, for a browser sends a cookie by itself."""
    http = InProcess(create_app(guarded))
    secret = guarded.tokens.create("eyes", [Scope.ADMIN])
    problem(http.post("/web/session", json={"token": "octobake_wrong"}), 401, "request.bad_token")
    answer = http.post("/web/session", json={"token": f" {secret} "})
    assert answer.status_code == 204
    kept = answer.headers["set-cookie"]
    assert "HttpOnly" in kept and "SameSite=strict" in kept
    cookie = {"cookie": kept.partition(";")[0]}
    assert http.get("/v1/bakes", headers=cookie).status_code == 200
    problem(http.post("/v1/cleanup", headers=cookie), 401, "request.no_token")
    guarded.tokens.revoke("eyes")
    problem(http.get("/v1/bakes", headers=cookie), 401, "request.no_token")


def test_no_secret_is_kept(tmp_path: Path) -> None:
    """Through the command, with no service running."""
    at = ("--data", tmp_path / "data")
    made = octobake("token", "create", "ci", "--scope", "submit", "--scope", "read", *at)
    assert made.returncode == 0, made.stderr
    secret = made.stdout.strip()
    assert secret.startswith("octobake_") and len(secret) == 52
    for path in (tmp_path / "data").rglob("*"):
        assert secret.encode() not in path.read_bytes()
    with closing(sqlite3.connect(tmp_path / "data" / "octobake.sqlite")) as database:
        ((hashed,),) = database.execute("SELECT hash FROM tokens").fetchall()
    assert len(hashed) == 64
    again = octobake("token", "create", "ci", "--scope", "read", *at)
    assert (again.returncode, "[token.exists]" in again.stderr) == (2, True)
    listed = json.loads(octobake("token", "list", "--json", *at).stdout)["tokens"]
    assert [(t["name"], t["scopes"]) for t in listed] == [("ci", ["read", "submit"])]
    assert secret not in json.dumps(listed)
    assert octobake("token", "revoke", "ci", *at).stdout == "revoked ci\n"
    gone = octobake("token", "revoke", "ci", *at)
    assert (gone.returncode, "[token.unknown]" in gone.stderr) == (2, True)
    assert octobake("token", "create", "a b", "--scope", "read", *at).returncode == 2


def test_what_changes_something_and_who_is_refused_is_written_down(guarded: Service) -> None:
    http = InProcess(create_app(guarded))
    ci = bearer(guarded, Scope.SUBMIT, name="ci")
    http.post("/v1/scenes", content=BOX, headers=ci)
    http.get("/v1/bakes", headers=ci)
    http.get("/v1/bakes")
    http.get("/healthz")
    written = audit(guarded)
    assert [(w["token"], w["method"], w["path"], w["status"]) for w in written] == [
        ("ci", "POST", "/v1/scenes", 201),
        ("ci", "GET", "/v1/bakes", 403),
        ("-", "GET", "/v1/bakes", 401),
    ]
    assert all(w["address"] == "127.0.0.1" and w["at"].endswith("+00:00") for w in written)
    assert "octobake_" not in json.dumps(written)


def test_keys_of_two_tokens_are_two_keys(guarded: Service) -> None:
    http = InProcess(create_app(guarded))
    one, other = bearer(guarded, Scope.SUBMIT, name="one"), bearer(guarded, Scope.SUBMIT, name="other")
    scene = http.post("/v1/scenes", content=BOX, headers=one).json()["digest"]
    body = {"scene": scene, "spec": box_spec()}
    ids = {http.post("/v1/bakes", json=body, headers={**who, "idempotency-key": "k"}).json()["id"] for who in (one, other, one)}
    assert len(ids) == 2


def test_an_address_may_come_so_often(tmp_path: Path) -> None:
    service = Service(Settings(data=str(tmp_path / "data"), max_requests_per_second=5))
    http = InProcess(create_app(service))
    answers = [http.get("/healthz") for _ in range(12)]
    service.close()
    refused = [a for a in answers if a.status_code == 429]
    assert [a.status_code for a in answers[:5]] == [200] * 5 and refused
    problem(refused[0], 429, "request.too_many")
    assert refused[0].headers["retry-after"] == "1"


def test_so_many_at_once(tmp_path: Path) -> None:
    service = Service(Settings(data=str(tmp_path / "data"), max_concurrent_requests=2, max_listeners=1))
    app = create_app(service)
    http = InProcess(app)
    scene = http.post("/v1/scenes", content=BOX).json()["digest"]
    job = http.post("/v1/bakes", json={"scene": scene, "spec": box_spec()}).json()["id"]

    async def ask() -> tuple[list[httpx.Response], list[httpx.Response]]:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://octobake") as client:
            waiting = [client.get(f"/v1/bakes/{job}", headers={"prefer": "wait=1"}) for _ in range(3)]
            listening = [asyncio.ensure_future(client.get(f"/v1/bakes/{job}/events")) for _ in range(2)]
            answers = await asyncio.gather(*waiting)
            await client.post(f"/v1/bakes/{job}:cancel")
            return answers, await asyncio.gather(*listening)

    answers, streams = asyncio.run(ask())
    service.close()
    assert sorted(a.status_code for a in answers) == [200, 200, 503]
    assert sorted(s.status_code for s in streams) == [200, 503], "listeners are counted apart"
    busy = next(a for a in answers if a.status_code == 503)
    problem(busy, 503, "service.busy")
    assert busy.headers["retry-after"] == "1"
