"""Every setting of the service, in one list: `octobake serve --help`, the environment and docs/settings.md all come from here."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from bake_core.errors import InputError

ENVIRONMENT_PREFIX = "OCTOBAKE_"
# What the client's commands read.
CLIENT_VARIABLES = ("OCTOBAKE_SERVER", "OCTOBAKE_TOKEN")
# Where 0 means: choose for me, never, or no.
MAY_BE_ZERO = ("port", "threads", "require_token", "retention_days", "history_days", "webhook_private")


def _setting(default: str | int | float, text: str) -> Any:
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class Settings:
    """What the service is told.

    In order of precedence: an option (``--max-attempts``), the environment (``OCTOBAKE_MAX_ATTEMPTS``), the default.
    """

    host: str = _setting("127.0.0.1", "Address to listen on. Whoever comes by another than loopback needs a token: see `octobake token`.")
    port: int = _setting(8787, "Port to listen on; 0 takes a free one and prints it.")
    data: str = _setting("", "Folder of all that the service keeps; default $XDG_DATA_HOME/octobake, or ~/.local/share/octobake.")
    database: str = _setting("", "SQLAlchemy URL of the job store; default an SQLite file in the data folder.")
    store: str = _setting("", "URL of the blob store (file:///…, s3://bucket/prefix); default a folder in the data folder.")
    dask: str = _setting("", "URL of a Dask scheduler (tls://…) whose workers reach the blob store; default one worker started here.")
    threads: int = _setting(0, "Threads a worker bakes with; 0 takes every CPU that this process may use.")
    max_json_bytes: int = _setting(16 * 2**20, "Largest JSON body accepted. A spec with the most lights it may have (65,536) is 11 MB.")
    max_upload_bytes: int = _setting(4 * 2**30, "Largest blob or GLB accepted. A GLB's own length field ends at 4 GiB.")
    read_seconds: int = _setting(300, "Seconds in which an uploaded scene or image must be read, or be refused.")
    read_memory: int = _setting(8 * 2**30, "Bytes of memory that reading one uploaded scene or image may take; two are read at once.")
    max_attempts: int = _setting(3, "How often one piece of a job may lose its worker before the job fails as crashed.")
    shard_seconds: float = _setting(3.0, "Work between two commits, aimed at: what a restart or a killed worker costs at most.")
    cached_scenes: int = _setting(2, "Scenes that a worker keeps ready between jobs.")
    require_token: int = _setting(0, "1 asks for a token on loopback too, as it must be behind a proxy on the same machine.")
    max_requests_per_second: int = _setting(500, "Requests of one address; it may save up as many as a second has.")
    max_concurrent_requests: int = _setting(256, "Requests in work at once, event streams not among them.")
    max_listeners: int = _setting(1000, "Event streams at once.")
    retention_days: float = _setting(
        30.0, "Files of a finished job and uploads that nobody asks for are kept so long; 0 keeps them for ever."
    )
    history_days: float = _setting(
        365.0, "Rows of expired jobs, their figures and their events are kept so long after their end; 0: for ever."
    )
    webhook_secret: str = _setting("", "Signs webhooks: whsec_ and base64; default one made at the first start, in the data folder.")
    webhook_private: int = _setting(0, "1 lets webhooks go to private addresses and to this machine.")

    @property
    def data_folder(self) -> Path:
        """The data folder, absolute; not created here."""
        if self.data:
            return Path(self.data).expanduser().absolute()
        base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
        return Path(base).expanduser().absolute() / "octobake"

    @property
    def temporary_folder(self) -> Path:
        """Where files in the making lie: beside the data, for /tmp may be small, or memory. Emptied at every start."""
        return self.data_folder / "temporary"

    @property
    def database_url(self) -> str:
        """The job store's URL."""
        return self.database or f"sqlite:///{self.data_folder / 'octobake.sqlite'}"

    @property
    def store_url(self) -> str:
        """The blob store's URL."""
        return self.store or (self.data_folder / "blobs").as_uri()


def settings_list() -> tuple[Field[Any], ...]:
    """The settings in the order of their documentation; `metadata["help"]` says what each is for."""
    return fields(Settings)


def load(options: Mapping[str, Any], environment: Mapping[str, str]) -> Settings:
    """Settings from command-line options (None: not given) and environment.

    Raises
    ------
    InputError
        ``settings.invalid`` or ``settings.unknown``; `where` is the option or the variable.
    """
    known = {ENVIRONMENT_PREFIX + f.name.upper(): f for f in settings_list()}
    stray = sorted(n for n in environment if n.startswith(ENVIRONMENT_PREFIX) and n not in known and n not in CLIENT_VARIABLES)
    if stray:
        raise InputError("settings.unknown", "no setting has this name; `octobake serve --help` lists them", stray[0])
    given: dict[str, Any] = {}
    for variable, f in known.items():
        option = options.get(f.name)
        if option is not None:
            given[f.name] = _convert(f, option, "--" + f.name.replace("_", "-"))
        elif variable in environment:
            given[f.name] = _convert(f, environment[variable], variable)
    return replace(Settings(), **given)


def _convert(f: Field[Any], value: Any, where: str) -> Any:
    if isinstance(f.default, str):
        return str(value)
    whole = isinstance(f.default, int)
    try:
        number: int | float = int(value) if whole else float(value)
    except ValueError:
        raise InputError("settings.invalid", f"{value!r} is not a {'whole ' if whole else ''}number", where) from None
    least = 0 if f.name in MAY_BE_ZERO else 1e-3 if not whole else 1
    most = 65535 if f.name == "port" else 2**62
    if not least <= number <= most:
        raise InputError("settings.invalid", f"must be at least {least} and at most {most}", where)
    return number
