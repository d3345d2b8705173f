"""Before any route: who asks, how often, how many at once; and what is written down of it."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict

from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.parts import Service
from service.problems import problem
from service.tokens import Scope as TokenScope
from service.tokens import Token

# Addresses whose last second is remembered: what one more costs is a few hundred bytes.
REMEMBERED = 10_000
# Where web pages keep the token that they were given.
COOKIE = "octobake_token"
# Who asks without a token, where none is needed.
NOBODY = "-"


def needed_scope(method: str, path: str) -> TokenScope | None:
    """What a token must be good for; None where nobody is asked for one: whether the service lives, and pages that hold no data."""
    if path in ("/healthz", "/readyz", "/", "/v1/openapi.json") or (path.startswith("/web/") and not path.endswith("/curve.svg")):
        return None
    if path.startswith("/v1/cleanup") or path.endswith((":pin", ":unpin")):
        return TokenScope.ADMIN
    if method in ("GET", "HEAD", "OPTIONS") and not path.startswith("/v1/blobs/"):
        return TokenScope.READ
    return TokenScope.SUBMIT


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address that is listened on."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Guard:
    """ASGI middleware: limits, tokens, audit log."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._service: Service | None = None

    def _open(self, service: Service) -> None:
        settings = service.settings
        self._service = service
        self._open_to_all = is_loopback(settings.host) and not settings.require_token
        self._rates = _Rates(settings.max_requests_per_second)
        self._most = {False: settings.max_concurrent_requests, True: settings.max_listeners}
        self._working = {False: 0, True: 0}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        service: Service = scope["app"].state.service
        if service is not self._service:
            self._open(service)
        method, path = scope["method"], scope["path"]
        address = scope["client"][0] if scope.get("client") else ""
        listens = path.endswith("/events")
        name = NOBODY

        async def refuse(status: int, slug: str, detail: str, headers: dict[str, str]) -> None:
            if status in (401, 403):
                self._write(name, address, method, path, status)
            # What was sent with the request is not read.
            await problem(status, slug, detail, headers={**headers, "Connection": "close"})(scope, receive, send)

        wait = self._rates.wait(address)
        if wait > 0:
            text = f"more than {self._rates.rate} requests a second come from this address"
            await refuse(429, "request.too_many", text, {"Retry-After": str(max(1, round(wait)))})
            return
        if self._working[listens] >= self._most[listens]:
            text = "more requests are being worked on than the service takes at once"
            await refuse(503, "service.busy", text, {"Retry-After": "1"})
            return
        # Counted from here on, for a look into the database is work, too.
        self._working[listens] += 1
        try:
            needed = needed_scope(method, path)
            if needed is not None:
                given, shown = _given(scope, method)
                token = await run_in_threadpool(_find, service, given) if given is not None else None
                if token is None and shown:
                    await refuse(401, "request.bad_token", "this token is none of this service's", {"WWW-Authenticate": "Bearer"})
                    return
                if token is None and not self._open_to_all:
                    text = "send a token as Authorization: Bearer ...; `octobake token create` makes one"
                    await refuse(401, "request.no_token", text, {"WWW-Authenticate": "Bearer"})
                    return
                if token is not None:
                    name = token.name
                    if needed not in token.scopes and TokenScope.ADMIN not in token.scopes:
                        text = f"the token {name} is not good for this: it takes the scope {needed}"
                        headers = {"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{needed}"'}
                        await refuse(403, "request.forbidden", text, headers)
                        return
            scope["octobake.owner"] = name

            async def written(message: Message) -> None:
                if message["type"] == "http.response.start" and method not in ("GET", "HEAD"):
                    self._write(name, address, method, path, message["status"])
                await send(message)

            await self.app(scope, receive, written)
        finally:
            self._working[listens] -= 1

    def _write(self, name: str, address: str, method: str, path: str, status: int) -> None:
        assert self._service is not None
        self._service.ledger.write(token=name, address=address, method=method, path=path, status=status)


class _Rates:
    """A bucket of tokens for each address, refilled at `rate` a second, holding a second's worth."""

    def __init__(self, rate: int) -> None:
        self.rate = rate
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait(self, address: str) -> float:
        """0 where the request may come now; else the seconds after which it may."""
        now = time.monotonic()
        left, at = self._buckets.pop(address, (float(self.rate), now))
        left = min(float(self.rate), left + (now - at) * self.rate)
        self._buckets[address] = (left - 1 if left >= 1 else left), now
        while len(self._buckets) > REMEMBERED:
            self._buckets.popitem(last=False)
        return 0.0 if left >= 1 else (1 - left) / self.rate


def _given(scope: Scope, method: str) -> tuple[str | None, bool]:
    """What a request says of who asks, and whether its sender chose to say so.

    A browser sends the pages' cookie by itself, an outlived one too, and where another site's page makes it: so nothing is changed by it.
    """
    headers = Headers(scope=scope)
    given = headers.get("authorization")
    if given is not None:
        return given, True
    secret = cookie_parser(headers.get("cookie", "")).get(COOKIE) if method in ("GET", "HEAD") else None
    return (None if secret is None else f"Bearer {secret}"), False


def _find(service: Service, authorization: str) -> Token | None:
    kind, _, secret = authorization.partition(" ")
    return service.tokens.find(secret.strip()) if kind.lower() == "bearer" else None
