"""A job's history for people: its events, a line each."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from service.jobs import Event
from service.store import Store

PAGE = 1000


def log_lines(store: Store, job: str) -> Iterator[str]:
    """``2026-11-26T22:07:31.412Z state     running``, the oldest first."""
    last = 0
    while events := store.events(job, last, PAGE):
        for event in events:
            at = datetime.fromtimestamp(event.at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
            yield f"{at} {event.type:<8} {_words(event)}".rstrip()
        last = events[-1].id


def _words(event: Event) -> str:
    data = event.data
    if event.type == "state":
        error, result = data.get("error"), data.get("result")
        more = ""
        if error:
            place = f"{error['where']}: " if error["where"] else ""
            more = f" [{error['slug']}] {place}{error['message']}"
        elif result:
            more = "".join(
                f" {name}={_figure(result[name])}" for name in ("samples", "error", "seconds", "stopped", "passed") if name in result
            )
        return f"{data['state']}{more}"
    return data.get("reason") or " ".join(f"{name}={_figure(value)}" for name, value in data.items())


def _figure(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
