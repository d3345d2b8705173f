"""Server-sent events, as the WHATWG HTML standard parses them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator

from octobake_client.jobs import Event


def parse(lines: Iterable[str]) -> Iterator[Event]:
    """Events from a stream's lines. One that is cut off by the stream's end is dropped, for it may be incomplete."""
    kind, identity, data = "message", None, list[str]()
    for line in lines:
        if not line:
            if data:
                yield Event(json.loads("\n".join(data)), kind, identity)
            kind, identity, data = "message", None, []
        elif not line.startswith(":"):
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if name == "data":
                data.append(value)
            elif name == "event":
                kind = value
            elif name == "id" and value.isdecimal():
                identity = int(value)
