"""The audit log: who changed what, and who was refused."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path

FILE_BYTES, OLD_FILES = 32 * 2**20, 4


class Ledger:
    """``audit.jsonl`` in a folder: a JSON document a line. When it is full it is set aside, and the oldest of a few such files goes."""

    def __init__(self, folder: Path) -> None:
        self._handler = RotatingFileHandler(
            folder / "audit.jsonl", maxBytes=FILE_BYTES, backupCount=OLD_FILES, encoding="utf-8", delay=True
        )
        self._log = logging.Logger("octobake.ledger")
        self._log.addHandler(self._handler)

    def write(self, **record: str | int) -> None:
        """Add a line; the time is now."""
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._log.info("%s", json.dumps({"at": at, **record}))

    def close(self) -> None:
        """Close the file."""
        self._handler.close()
