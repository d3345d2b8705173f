"""The parts of the service, put together."""

from __future__ import annotations

import fcntl
import shutil

from bake_core.errors import MachineError
from service.blobs import Blobs
from service.feed import Feed
from service.hub import Hub
from service.ledger import Ledger
from service.outbox import Outbox
from service.retention import Retention
from service.sandbox import Sandbox
from service.scenes import Outlines
from service.scheduler import Scheduler
from service.settings import Settings
from service.store import Store
from service.tokens import Tokens
from service.webhooks import Webhooks


class Service:
    """Everything behind the routes. One process owns a data folder at a time."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        folder = settings.data_folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = open(folder / "lock", "w")  # noqa: SIM115  held until close()
        except OSError as e:
            raise MachineError("service.data_unusable", f"the data folder cannot be used: {e.strerror}", str(folder)) from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.close()
            text = "another octobake serves from this data folder; stop it, or give --data"
            raise MachineError("service.data_in_use", text, str(folder)) from None
        self._sweep()
        settings.temporary_folder.mkdir()
        self.blobs = Blobs(settings.store_url, folder / "scratch")
        self.blobs.clean()
        self.store = Store(settings.database_url)
        self.sandbox = Sandbox(settings.temporary_folder, settings.read_seconds, settings.read_memory)
        self.outlines = Outlines(self.blobs, self.sandbox)
        self.hub = Hub()
        self.feed = Feed(self.store)
        self.ledger = Ledger(folder)
        self.tokens = Tokens(self.store.engine)
        self.outbox = Outbox(self.store.engine)
        self.retention = Retention(settings, self.store, self.blobs)
        self.webhooks = Webhooks(settings, self.store.engine)
        self.scheduler = Scheduler(settings, self.store, self.blobs, self.hub)

    def start(self) -> None:
        """Take up the work, and what goes on beside it."""
        self.scheduler.start()
        self.webhooks.start()
        self.retention.start()

    def close(self) -> None:
        """Stop the work, leave it to be resumed, and let go of the data folder."""
        try:
            self.retention.close()
            self.scheduler.close()
            self.webhooks.close()
        finally:
            self.sandbox.close()
            self.store.close()
            self.ledger.close()
            self._sweep()
            self._lock.close()

    def _sweep(self) -> None:
        """Remove what was in the making; a killed service leaves it to the next start."""
        shutil.rmtree(self.settings.temporary_folder, ignore_errors=True)
