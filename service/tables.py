"""The job store's tables, and how a transaction on them begins.

SQLite embedded, PostgreSQL to scale; the SQL is SQLAlchemy Core's common ground of the two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Engine

from bake_core.errors import MachineError

# SQLite's writers wait for each other this long; the longest transaction here takes milliseconds.
BUSY_SECONDS = 10.0

metadata = sa.MetaData()
blobs = sa.Table(
    "blobs",
    metadata,
    sa.Column("digest", sa.String(71), primary_key=True),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
    # When somebody last sent it, asked for it or named it in a request: what a clean-up goes by.
    sa.Column("used", sa.Double, nullable=False),
)
scenes = sa.Table(
    "scenes",
    metadata,
    sa.Column("digest", sa.String(71), primary_key=True),
    # {"root": NAME, "files": {NAME: "sha256:HEX"}}; a single GLB has one file, itself.
    sa.Column("root", sa.Text, nullable=False),
    sa.Column("files", sa.JSON, nullable=False),
    sa.Column("contents", sa.JSON, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("used", sa.Double, nullable=False),
)
jobs = sa.Table(
    "jobs",
    metadata,
    # BIGINT would not autoincrement on SQLite.
    sa.Column("sequence", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("id", sa.String(32), nullable=False, unique=True),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("request", sa.JSON, nullable=False),
    sa.Column("labels", sa.JSON, nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False, default=0),
    sa.Column("progress", sa.JSON(none_as_null=True)),
    sa.Column("result", sa.JSON(none_as_null=True)),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("started", sa.Double),
    sa.Column("finished", sa.Double),
    sa.Column("fingerprint", sa.String(64), nullable=False),
    sa.Column("memory_bytes", sa.BigInteger),
    sa.Column("webhook", sa.Text),
    sa.Column("pinned", sa.Boolean, nullable=False),
    sa.Column("ttl", sa.Double),
    sa.Column("stop_asked", sa.Boolean, nullable=False),
    sa.Column("plan", sa.JSON(none_as_null=True)),
    sa.Index("jobs_queue", "state", "priority", "sequence"),
    sa.Index("jobs_alike", "fingerprint", "state"),
    sqlite_autoincrement=True,  # a sequence is never used twice, so a cursor never goes back
)
events = sa.Table(
    "events",
    metadata,
    sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), nullable=False),
    sa.Column("at", sa.Double, nullable=False),
    sa.Column("type", sa.String(16), nullable=False),
    sa.Column("data", sa.JSON, nullable=False),
    sa.Index("events_of_job", "job", "id"),
    sqlite_autoincrement=True,
)
passes = sa.Table(
    "passes",
    metadata,
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("index", sa.Integer, primary_key=True),
    sa.Column("first", sa.Integer, nullable=False),
    sa.Column("last", sa.Integer, nullable=False),
    sa.Column("shards", sa.Integer, nullable=False),
    sa.Column("state", sa.Text),
    sa.Column("allocation", sa.Text),
    sa.Column("error", sa.Double),
    sa.Column("seconds", sa.Double),
    # Of all passes up to this one.
    sa.Column("rays", sa.BigInteger),
)
shards = sa.Table(
    "shards",
    metadata,
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("pass_index", sa.Integer, primary_key=True),
    sa.Column("index", sa.Integer, primary_key=True),
    sa.Column("tally", sa.Text, nullable=False),
    sa.Column("seconds", sa.Double, nullable=False),
)


attempts = sa.Table(
    "attempts",
    metadata,
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True),
    sa.Column("began", sa.Double, nullable=False),
    sa.Column("ended", sa.Double),
    sa.Column("outcome", sa.String(16)),
    sa.Column("reason", sa.Text),
)
# Idempotency-Key: `job` is None while the request that brought the key is being answered.
idempotency_keys = sa.Table(
    "idempotency_keys",
    metadata,
    sa.Column("owner", sa.String(64), primary_key=True),
    sa.Column("key", sa.String(255), primary_key=True),
    sa.Column("request", sa.String(64), nullable=False),
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id")),
    sa.Column("created", sa.Double, nullable=False),
)
tokens = sa.Table(
    "tokens",
    metadata,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("hash", sa.String(64), nullable=False, unique=True),
    sa.Column("scopes", sa.JSON, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
)
outbox = sa.Table(
    "outbox",
    metadata,
    sa.Column("id", sa.String(40), primary_key=True),
    sa.Column("job", sa.String(32), sa.ForeignKey("jobs.id"), nullable=False),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("body", sa.Text, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False),
    # None: nothing more is to be done, because it was delivered or given up.
    sa.Column("next", sa.Double, index=True),
    sa.Column("delivered", sa.Double),
    sa.Column("reason", sa.Text),
    sa.Index("outbox_of_job", "job"),
)


def open_engine(url: str) -> Engine:
    """Connect, and make the tables that are not there.

    Raises
    ------
    MachineError
        ``service.other_version``: the tables of another version are refused, rather than fail at the first job.
    """
    engine = sa.create_engine(url)
    if engine.dialect.name == "sqlite":
        sa.event.listen(engine, "connect", _open_sqlite)
        sa.event.listen(engine, "begin", _begin_sqlite)
    metadata.create_all(engine)
    there = sa.inspect(engine)
    for table in metadata.sorted_tables:
        missing = {c.name for c in table.columns} - {c["name"] for c in there.get_columns(table.name)}
        if missing:
            raise MachineError(
                "service.other_version",
                f"the table {table.name!r} lacks {', '.join(sorted(missing))}: another version of octobake made it; "
                "give --data (or --database) a new place",
                engine.url.render_as_string(hide_password=True),
            )
    return engine


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """One transaction that has reached the disk when it ends."""
    with engine.begin() as connection:
        yield connection


@contextmanager
def reading(engine: Engine) -> Iterator[Connection]:
    """One look at a state that does not change meanwhile."""
    with engine.connect().execution_options(octobake_read=True) as connection:
        yield connection


def _open_sqlite(connection: Any, _: object) -> None:
    # The driver must not begin transactions of its own: _begin_sqlite says which kind each is.
    connection.isolation_level = None
    pragmas: Sequence[str] = (
        "journal_mode = WAL",  # readers never wait for the writer
        "synchronous = FULL",  # a commit is on the disk when it returns: what 202 promises
        "foreign_keys = ON",
        f"busy_timeout = {int(BUSY_SECONDS * 1000)}",
    )
    for pragma in pragmas:
        connection.execute(f"PRAGMA {pragma}").close()


def _begin_sqlite(connection: Connection) -> None:
    # A writer takes its lock at the start: two that read first and then write would fail each other without waiting.
    reads = connection.get_execution_options().get("octobake_read", False)
    connection.exec_driver_sql("BEGIN" if reads else "BEGIN IMMEDIATE")
