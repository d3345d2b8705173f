"""Webhooks: signed as the specification has it, sent until they arrive, never to where they must not go, never in a job's way."""

from __future__ import annotations

import base64
import hashlib
import hmac
import http.server
import ipaddress
import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bake_core.errors import InputError
from service import outbox, webhooks
from service.app import create_app
from service.jobs import State
from service.parts import Service
from service.settings import Settings
from service.webhooks import check_url, is_public, read_secret, signature
from tests.service.running import InProcess, box_spec, wait_for
from tests.service.test_http import add_box, finished, problem

SECRET = "whsec_" + base64.b64encode(b"0123456789abcdef0123456789abcdef").decode()


class Receiver:
    """Somebody's HTTP server; answers with the statuses it was given, then with 204."""

    def __init__(self, *statuses: int, headers: dict[str, str] | None = None) -> None:
        self.heard: list[tuple[dict[str, str], bytes]] = []
        left = list(statuses)
        receiver = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.heard.append(({k.lower(): v for k, v in self.headers.items()}, body))
                self.send_response(left.pop(0) if left else 204)
                for name, value in (headers or {}).items():
                    self.send_header(name, value)
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/hook?a=b"
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


@pytest.fixture
def sending(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    """A service whose webhooks go out, to this machine too, and are tried again soon."""
    monkeypatch.setattr(webhooks, "POLL_SECONDS", 0.05)
    monkeypatch.setattr(outbox, "WAITS", (0.1, 0.1))
    service = Service(Settings(data=str(tmp_path / "data"), webhook_secret=SECRET, webhook_private=1))
    service.webhooks.start()
    yield service
    service.close()


def bake(service: Service, url: str, **more: Any) -> str:
    http = InProcess(create_app(service))
    answer = http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec(), "webhook": url, **more})
    assert answer.status_code == 202, answer.text
    job: str = answer.json()["id"]
    return job


def delivery(service: Service, job: str) -> dict[str, Any]:
    document = InProcess(create_app(service)).get(f"/v1/bakes/{job}").json()
    (only,) = document["deliveries"]
    answer: dict[str, Any] = only
    return answer


def test_the_specification_s_own_example() -> None:
    secret = base64.b64decode("MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")
    signed = signature(secret, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, '{"test": 2432232314}')
    assert signed == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


def test_the_end_of_a_job_is_told_and_signed(sending: Service) -> None:
    receiver = Receiver()
    try:
        job = bake(sending, receiver.url, labels={"level": "rooms"})
        finished(sending, job)
        wait_for(lambda: receiver.heard, 10)
        wait_for(lambda: delivery(sending, job)["delivered"], 10)
    finally:
        receiver.close()
    ((headers, body),) = receiver.heard
    told = json.loads(body)
    assert told["type"] == "bake.succeeded" and told["data"]["id"] == job and told["data"]["labels"] == {"level": "rooms"}
    assert told["data"]["links"] == {"self": f"/v1/bakes/{job}"} and told["data"]["result"]["samples"] == 16
    assert headers["content-type"] == "application/json" and abs(int(headers["webhook-timestamp"]) - time.time()) < 60
    # As a receiver checks it, from the specification's text.
    key = base64.b64decode(SECRET.removeprefix("whsec_"))
    content = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    assert headers["webhook-signature"] == "v1," + base64.b64encode(hmac.new(key, content, hashlib.sha256).digest()).decode()
    assert headers["webhook-id"] == delivery(sending, job)["id"]


def test_a_message_is_sent_again_under_its_id_until_it_arrives(sending: Service) -> None:
    receiver = Receiver(500, 302, headers={"Location": "http://127.0.0.1:9/"})
    try:
        job = bake(sending, receiver.url)
        sending.store.cancel(job)
        wait_for(lambda: delivery(sending, job)["delivered"], 10)
    finally:
        receiver.close()
    assert len({headers["webhook-id"] for headers, _ in receiver.heard}) == 1
    assert len(receiver.heard) == 3 == delivery(sending, job)["attempts"]
    assert json.loads(receiver.heard[0][1])["type"] == "bake.cancelled"


@pytest.mark.parametrize(("statuses", "attempts", "reason"), [((410,), 1, "answered 410"), ((500,) * 9, 3, "answered 500")])
def test_a_message_is_given_up(sending: Service, statuses: tuple[int, ...], attempts: int, reason: str) -> None:
    receiver = Receiver(*statuses)
    try:
        job = bake(sending, receiver.url)
        sending.store.cancel(job)
        wait_for(lambda: delivery(sending, job)["next"] is None, 10)
        time.sleep(0.3)
    finally:
        receiver.close()
    told = delivery(sending, job)
    assert (told["attempts"], told["delivered"], told["reason"], len(receiver.heard)) == (attempts, None, reason, attempts)


def test_a_receiver_that_says_nothing_holds_up_neither_jobs_nor_other_messages(sending: Service) -> None:
    receiver = Receiver()
    with socket.create_server(("127.0.0.1", 0), backlog=8) as silent:
        silently = f"http://127.0.0.1:{silent.getsockname()[1]}/"
        try:
            mute = bake(sending, silently)
            began = time.monotonic()
            sending.store.cancel(mute)
            job = bake(sending, receiver.url)
            sending.store.cancel(job)
            wait_for(lambda: delivery(sending, job)["delivered"], 10)
            assert time.monotonic() - began < webhooks.DELIVERY_SECONDS / 2
            assert delivery(sending, mute)["delivered"] is None
        finally:
            receiver.close()


def test_what_was_not_delivered_is_after_a_restart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhooks, "POLL_SECONDS", 0.05)
    settings = Settings(data=str(tmp_path / "data"), webhook_private=1)
    receiver = Receiver()
    first = Service(settings)
    secret = read_secret(settings)
    job = bake(first, receiver.url)
    first.store.cancel(job)
    first.close()
    second = Service(settings)
    try:
        second.webhooks.start()
        wait_for(lambda: receiver.heard, 10)
    finally:
        second.close()
        receiver.close()
    assert read_secret(settings) == secret and len(secret) == 32
    assert (settings.data_folder / "webhook-secret").stat().st_mode & 0o777 == 0o600


# Where they may go

PRIVATE = [
    "127.0.0.1", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "0.0.0.0", "100.64.0.1", "224.0.0.1", "255.255.255.255",
    "::1", "::", "fe80::1", "fc00::1", "ff02::1", "::ffff:127.0.0.1", "::ffff:10.0.0.1", "64:ff9b::7f00:1", "2002:7f00:1::1",
]  # fmt: skip


@pytest.mark.parametrize("address", PRIVATE)
def test_a_private_address_by_any_name(http: InProcess, address: str) -> None:
    assert not is_public(ipaddress.ip_address(address))
    url = f"http://[{address}]/x" if ":" in address else f"http://{address}/x"
    answer = http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec(), "webhook": url})
    assert problem(answer, 422, "request.bad_webhook")["where"] == "body.webhook"
    assert check_url(url, private=True) == url


@pytest.mark.parametrize("address", ["93.184.216.34", "2606:2800:220:1::1", "64:ff9b::5db8:d822"])
def test_a_public_address(address: str) -> None:
    assert is_public(ipaddress.ip_address(address))


@pytest.mark.parametrize(
    "url", ["", "x", "ftp://a/b", "http://", "http://u:p@a/", "http://a:99999/", "http://a/\r\nX: y", "http://ä/", "http://[::1"]
)
def test_what_is_no_url_for_a_webhook(http: InProcess, url: str) -> None:
    with pytest.raises(InputError) as caught:
        check_url(url, private=True)
    assert caught.value.slug == "request.bad_webhook"
    problem(http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec(), "webhook": url}), 422, "request.bad_webhook")


def test_a_name_that_leads_to_a_private_address_is_not_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Localhost is a name like another: what counts is the address that is connected to."""
    monkeypatch.setattr(webhooks, "POLL_SECONDS", 0.05)
    receiver = Receiver()
    service = Service(Settings(data=str(tmp_path / "data")))
    service.webhooks.start()
    try:
        job = bake(service, receiver.url.replace("127.0.0.1", "localhost"))
        service.store.cancel(job)
        wait_for(lambda: delivery(service, job)["attempts"], 10)
        told = delivery(service, job)
        assert told["next"] is None and "private" in told["reason"] and receiver.heard == []
    finally:
        service.close()
        receiver.close()


@pytest.mark.parametrize("secret", ["abc", "whsec_", "whsec_!!!", "whsec_" + base64.b64encode(b"x" * 23).decode()])
def test_a_secret_that_is_none(tmp_path: Path, secret: str) -> None:
    with pytest.raises(InputError) as caught:
        read_secret(Settings(data=str(tmp_path), webhook_secret=secret))
    assert caught.value.slug == "settings.invalid"


def test_a_verification_has_a_webhook_too(sending: Service) -> None:
    receiver = Receiver()
    try:
        http = InProcess(create_app(sending))
        job = http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec()}).json()["id"]
        finished(sending, job)
        verification = http.post("/v1/verifications", json={"bake": job, "webhook": receiver.url}).json()["id"]
        sending.store.move(verification, State.CANCELLED)
        wait_for(lambda: receiver.heard, 10)
    finally:
        receiver.close()
    assert json.loads(receiver.heard[0][1])["type"] == "verification.cancelled"
