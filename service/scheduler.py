"""Takes jobs from the queue and gives each a driver; the one place where jobs begin."""

from __future__ import annotations

import logging
import threading

from service.blobs import Blobs
from service.compute import Compute, Message
from service.driver import Driver
from service.hub import Hub
from service.jobs import FINISHED
from service.settings import Settings
from service.store import Store

log = logging.getLogger("octobake.scheduler")

# A new job rings; this is for jobs that something other than this process put into the database.
IDLE_SECONDS = 1.0
# A scheduler that cannot be reached is tried again this often.
RETRY_SECONDS = 2.0
# Drivers stop in milliseconds; one that does not must not hold up a shutdown, for a restart repairs whatever it leaves.
STOP_SECONDS = 0.5


class Scheduler:
    """A thread that claims queued jobs, as many at once as there are places to work."""

    def __init__(self, settings: Settings, store: Store, blobs: Blobs, hub: Hub) -> None:
        self._settings, self._store, self._blobs, self._hub = settings, store, blobs, hub
        self._compute: Compute | None = None
        self._drivers: dict[str, Driver] = {}
        self._threads: set[threading.Thread] = set()
        # Jobs whose driver could not even say how it ended, because the store failed it.
        self._orphans: set[str] = set()
        self._bell = threading.Condition()
        self._rung = False
        self._stopping = False
        self._thread = threading.Thread(target=self._loop, name="octobake-scheduler", daemon=True)

    def start(self) -> None:
        """Queue again what an earlier life left half done, sweep away what is of no more use, and begin. Does not wait for the workers."""
        self._store.reconcile()
        for job in self._blobs.jobs_with_work():
            found = self._store.job(job)
            if found is None or found.state in FINISHED:
                self._blobs.remove_work(job)
        self._thread.start()

    @property
    def ready(self) -> bool:
        """Whether jobs would be run now."""
        return self._compute is not None and self._compute.ready and not self._stopping

    def wake(self) -> None:
        """There is a new job."""
        with self._bell:
            self._rung = True
            self._bell.notify()

    def cancel(self, job: str) -> None:
        """A job that may have a driver has become `cancelling`."""
        with self._bell:
            driver = self._drivers.get(job)
        if driver:
            driver.cancel()

    def finish(self, job: str) -> None:
        """A running bake shall end with the passes it has."""
        with self._bell:
            driver = self._drivers.get(job)
        if driver:
            driver.finish()

    def drives(self, job: str) -> bool:
        """Whether a driver is still at work on a job, if only to tidy up."""
        with self._bell:
            return job in self._drivers

    def close(self) -> None:
        """Stop the drivers, leave their jobs to the next start, and stop the workers."""
        self._stopping = True
        self.wake()
        with self._bell:
            drivers, threads = list(self._drivers.values()), list(self._threads)
        for driver in drivers:
            driver.stop()
        for thread in threads:
            thread.join(STOP_SECONDS)
        if self._compute:
            self._compute.close()
        if self._thread.is_alive():
            self._thread.join(STOP_SECONDS)

    def _loop(self) -> None:
        while not self._stopping:
            try:
                self._compute = Compute(self._settings, self._hear)
                break
            except Exception as e:
                # A shutdown during the start takes the cluster away from under it.
                if not self._stopping:
                    log.error("%s; trying again", e)
                self._sleep(RETRY_SECONDS)
        while not self._stopping:
            try:
                self._fill()
            except Exception:
                log.exception("the queue cannot be read; trying again")
            self._sleep(IDLE_SECONDS)

    def _fill(self) -> None:
        assert self._compute
        for orphan in list(self._orphans):
            self._store.take_up(orphan)
            self._orphans.discard(orphan)
            self._hub.tell(orphan)
        while not self._stopping and len(self._drivers) < self._compute.slots and (job := self._store.claim()):
            driver = Driver(job, self._settings, self._store, self._blobs, self._compute, self._hub)
            thread = threading.Thread(target=self._drive, args=(driver,), name=f"octobake-job-{job.id}", daemon=True)
            with self._bell:
                self._drivers[job.id] = driver
                self._threads.add(thread)
            # A cancel may have come between the claim and the line above. (A stop cannot: it is taken of a running bake only.)
            if (now := self._store.job(job.id)) and now.state == "cancelling":
                driver.cancel()
            self._hub.tell(job.id)
            thread.start()

    def _drive(self, driver: Driver) -> None:
        try:
            driver.run()
        except Exception:
            # The store itself failed (a full disk, a lost database): the job goes back to the queue as soon as the store takes it.
            log.exception("job %s has lost its driver; it is queued again when the store can be written", driver.job.id)
            self._orphans.add(driver.job.id)
        with self._bell:
            del self._drivers[driver.job.id]
            self._threads.discard(threading.current_thread())
        self.wake()

    def _hear(self, message: Message) -> None:
        with self._bell:
            drivers = list(self._drivers.values())
        for driver in drivers:
            driver.hear(message)

    def _sleep(self, seconds: float) -> None:
        with self._bell:
            self._bell.wait_for(lambda: self._rung or self._stopping, seconds)
            self._rung = False
