"""Messages for webhooks, kept until they are delivered: rows of the transactions that ended jobs, so none is lost and none invented."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Engine

from service.jobs import Job
from service.tables import outbox, reading, writing

# After each failure in turn, as the Standard Webhooks specification proposes; after the last, a message is given up.
WAITS = (5.0, 300.0, 1800.0, 7200.0, 18000.0, 36000.0, 50400.0, 72000.0, 86400.0)


@dataclass(frozen=True)
class Message:
    """A row that is to be sent; `attempts` have failed before."""

    id: str
    job: str
    url: str
    body: str
    attempts: int


def add(c: Connection, job: Job, now: float) -> None:
    """Put the end of a job into the outbox, within the transaction that ends it."""
    data: Mapping[str, Any] = {
        "id": job.id,
        "kind": job.kind,
        "state": job.state,
        "labels": job.labels,
        "result": job.result,
        "error": job.error,
        "links": {"self": f"/v1/{job.kind}s/{job.id}"},
    }
    at = datetime.fromtimestamp(now, UTC).isoformat()
    body = json.dumps({"type": f"{job.kind}.{job.state}", "timestamp": at, "data": data})
    row = {"id": f"msg_{secrets.token_hex(12)}", "job": job.id, "url": job.webhook, "body": body}
    c.execute(sa.insert(outbox).values(**row, created=now, attempts=0, next=now))


class Outbox:
    """The table, from the side of who delivers."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def due(self, now: float, limit: int) -> list[Message]:
        """Messages to be sent by now, those that wait longest first.

        What is due after more than the longest wait there is, was put off before the clock was set back: it goes now.
        """
        is_due = (outbox.c.next <= now) | (outbox.c.next > now + WAITS[-1])
        query = sa.select(outbox).where(is_due).order_by(outbox.c.next).limit(limit)
        with reading(self._engine) as c:
            return [Message(row.id, row.job, row.url, row.body, row.attempts) for row in c.execute(query)]

    def delivered(self, message: Message, now: float) -> None:
        """It has arrived."""
        self._change(message, next=None, delivered=now, attempts=message.attempts + 1, reason=None)

    def failed(self, message: Message, now: float, reason: str, final: bool) -> None:
        """It has not; `final`: nor will it."""
        over = final or message.attempts >= len(WAITS)
        following = None if over else now + WAITS[message.attempts]
        self._change(message, next=following, attempts=message.attempts + 1, reason=reason)

    def of_job(self, job: str) -> list[dict[str, Any]]:
        """What became of a job's messages."""
        query = sa.select(outbox).where(outbox.c.job == job).order_by(outbox.c.created)
        with reading(self._engine) as c:
            return [{k: row[k] for k in ("id", "attempts", "next", "delivered", "reason")} for row in c.execute(query).mappings()]

    def _change(self, message: Message, **columns: Any) -> None:
        with writing(self._engine) as c:
            c.execute(sa.update(outbox).where(outbox.c.id == message.id).values(**columns))
