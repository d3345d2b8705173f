"""Tells others of the ends of jobs: HTTP POSTs from the outbox, signed, apart from whatever runs jobs.

Signatures are those of the Standard Webhooks specification, version 1 (standardwebhooks.com): any of its libraries checks them.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import hashlib
import hmac
import ipaddress
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterable
from urllib.parse import urlsplit

import httpcore
from sqlalchemy.engine import Engine

import bake_core
from bake_core.errors import InputError
from service.outbox import Message, Outbox
from service.settings import Settings

log = logging.getLogger("octobake.webhooks")

SECRET_PREFIX = "whsec_"
# The specification's bounds for a secret.
SECRET_BYTES = range(24, 65)
POLL_SECONDS = 1.0
# For one message, from the name's resolution to the status line: within the specification's 15 to 30 seconds.
DELIVERY_SECONDS = 20.0
AT_ONCE = 16
# A receiver that says so wants no more (the specification's word).
GONE = 410
# IPv4 inside IPv6: RFC 6052's well-known prefix.
NAT64 = ipaddress.ip_network("64:ff9b::/96")


def check_url(url: str, private: bool) -> str:
    """Answer `url`, where a webhook may be sent to it as far as its text tells.

    Raises
    ------
    InputError
        ``request.bad_webhook``.
    """
    where = "body.webhook"
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise InputError("request.bad_webhook", "is not a URL", where) from None
    plain = url.isascii() and url.isprintable() and " " not in url
    if parts.scheme not in ("http", "https") or not host or parts.username is not None or port == 0 or not plain:
        raise InputError("request.bad_webhook", "a webhook is an http or https URL with a host and without a user", where)
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return url
    if not private and not is_public(address):
        raise InputError("request.bad_webhook", "is a private address; the setting webhook_private allows it", where)
    return url


def is_public(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Whether an address is out on the internet, by whatever name of IPv6's it goes."""
    if isinstance(address, ipaddress.IPv6Address):
        inner = address.ipv4_mapped or address.sixtofour or (address.teredo[1] if address.teredo else None)
        if address in NAT64:
            inner = ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
        if inner is not None:
            return is_public(inner)
    return address.is_global and not address.is_multicast


def signature(secret: bytes, identity: str, timestamp: int, body: str) -> str:
    """``v1,`` and the base64 of HMAC-SHA256 over ``id.timestamp.body``."""
    signed = f"{identity}.{timestamp}.{body}".encode()
    return "v1," + base64.b64encode(hmac.digest(secret, signed, hashlib.sha256)).decode()


def read_secret(settings: Settings) -> bytes:
    """The secret that was set, or the data folder's own, made where there is none.

    Raises
    ------
    InputError
        ``settings.invalid``.
    """
    text, where = settings.webhook_secret, "webhook_secret"
    if not text:
        path = settings.data_folder / "webhook-secret"
        where = str(path)
        if not path.exists():
            part = path.with_name(path.name + ".part")
            part.unlink(missing_ok=True)
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as f:
                f.write(SECRET_PREFIX + base64.b64encode(secrets.token_bytes(32)).decode() + "\n")
            part.replace(path)
        text = path.read_text().strip()
    try:
        secret = base64.b64decode(text.removeprefix(SECRET_PREFIX), validate=True)
    except binascii.Error:
        secret = b""
    if not text.startswith(SECRET_PREFIX) or len(secret) not in SECRET_BYTES:
        raise InputError("settings.invalid", "a webhook's secret is whsec_ and the base64 of 24 to 64 bytes", where)
    return secret


class Webhooks:
    """A thread with an event loop of its own: a receiver that is slow, or lies, holds up nobody but itself."""

    def __init__(self, settings: Settings, engine: Engine) -> None:
        self._secret = read_secret(settings)
        self._private = bool(settings.webhook_private)
        self._outbox = Outbox(engine)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._loop()), name="octobake-webhooks", daemon=True)

    def start(self) -> None:
        """Begin to deliver."""
        self._thread.start()

    def close(self) -> None:
        """Stop; what was not delivered stays in the outbox, and a message under way is sent again (its id is the same)."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(2 * POLL_SECONDS)

    async def _loop(self) -> None:
        under_way: dict[str, asyncio.Task[None]] = {}
        while not self._stopping.is_set():
            under_way = {i: task for i, task in under_way.items() if not task.done()}
            try:
                # Those under way are still due, so ask for more than there may be of them.
                for message in await asyncio.to_thread(self._outbox.due, time.time(), 2 * AT_ONCE):
                    if message.id not in under_way and len(under_way) < AT_ONCE:
                        under_way[message.id] = asyncio.create_task(self._deliver(message))
            except Exception:
                log.exception("the outbox cannot be read; trying again")
            # Looked at often, so that a shutdown does not wait for it.
            for _ in range(10):
                if not self._stopping.is_set():
                    await asyncio.sleep(POLL_SECONDS / 10)
        for task in under_way.values():
            task.cancel()

    async def _deliver(self, message: Message) -> None:
        try:
            status = await asyncio.wait_for(self._post(message), DELIVERY_SECONDS)
            reason = "" if 200 <= status < 300 else f"answered {status}"
            final = status == GONE
        except InputError as e:
            reason, final = e.message, True
        except Exception as e:
            reason, final = f"{type(e).__name__}: {e}".rstrip(": "), False
        try:
            if not reason:
                await asyncio.to_thread(self._outbox.delivered, message, time.time())
                return
            log.warning("webhook %s of job %s: %s", message.id, message.job, reason)
            await asyncio.to_thread(self._outbox.failed, message, time.time(), reason, final)
        except Exception:
            log.exception("webhook %s is sent again", message.id)

    async def _post(self, message: Message) -> int:
        timestamp = int(time.time())
        headers = {
            "Host": urlsplit(message.url).netloc,
            "Content-Type": "application/json",
            "User-Agent": f"octobake/{bake_core.__version__}",
            "webhook-id": message.id,
            "webhook-timestamp": str(timestamp),
            "webhook-signature": signature(self._secret, message.id, timestamp, message.body),
        }
        content = message.body.encode()
        headers["Content-Length"] = str(len(content))
        # No redirect is followed, and no proxy of the environment's is asked.
        async with (
            httpcore.AsyncConnectionPool(network_backend=_Public(self._private)) as pool,
            pool.stream("POST", message.url, headers=list(headers.items()), content=content) as answer,
        ):
            # Of the body nobody wants to know.
            return int(answer.status)


class _Public(httpcore.AsyncNetworkBackend):
    """Connects to the very addresses that were looked at: a name that is resolved twice may answer twice."""

    def __init__(self, private: bool) -> None:
        self._private = private
        self._backend = httpcore.AnyIOBackend()

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        """Resolve, look, connect."""
        found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
        addresses = [str(entry[4][0]) for entry in found]
        if not self._private and not all(is_public(ipaddress.ip_address(a.partition("%")[0])) for a in addresses):
            raise InputError("request.bad_webhook", "leads to a private address; the setting webhook_private allows it", host)
        failure: Exception | None = None
        for address in addresses:
            try:
                return await self._backend.connect_tcp(address, port, timeout, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as e:
                failure = e
        raise failure or httpcore.ConnectError(f"{host} has no address")

    async def sleep(self, seconds: float) -> None:
        """Sleep."""
        await asyncio.sleep(seconds)
