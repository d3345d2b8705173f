"""Bytes at rest: content-addressed blobs, and each job's work folder.

Keys: ``sha256/ab/HEX`` for blobs, ``work/JOB/NAME`` for what a job needs until it has finished (its shards' sums; small jobs that do the
same work must not share them, or the first to finish would sweep them from under the other).

obstore writes without fsync, so on a local folder a file is written under another name, synced, renamed, and its folder synced, before
anybody puts its name in a row.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import BaseError
from obstore.store import LocalStore, ObjectStore, from_url

from bake_core.errors import BakeError, InputError, OctobakeError

DIGEST = re.compile(r"sha256:[0-9a-f]{64}")
# Large enough that the thread hop per chunk does not matter, small enough that 500 downloads fit in memory.
CHUNK = 256 * 1024


class StoreError(BakeError):
    """The blob store could not be read or written: it is full, or out of reach. Another try may find it well."""


@contextmanager
def store_errors(where: str) -> Iterator[None]:
    """Tell what the operating system and the store's library raise as a :class:`StoreError` with slug ``blob.store_failed``."""
    try:
        yield
    except (OSError, BaseError) as e:
        text = f"the blob store cannot be used ({type(e).__name__}: {e}); see to its room and its network, and requeue the job"
        raise StoreError("blob.store_failed", text, where) from e
    except OctobakeError as e:
        if e.slug not in ("bake.cannot_write", "machine.cannot_write"):
            raise
        # The core's words for the same.
        raise StoreError(e.slug, e.message, e.where) from e


def blob_key(digest: str) -> str:
    """Where a blob lies. Two characters of fan-out keep folders small enough to list."""
    hexadecimal = digest.removeprefix("sha256:")
    return f"sha256/{hexadecimal[:2]}/{hexadecimal}"


def work_key(job: str, name: str) -> str:
    """Where a piece of a job's unfinished work lies."""
    return f"work/{job}/{name}"


class Blobs:
    """A blob store: a local folder, or anything obstore has a URL for.

    Parameters
    ----------
    url : str
        ``file:///folder``, ``s3://bucket/prefix``, …
    scratch : Path
        A local folder for files on their way into or out of a store that is not local. Unused (and not made) where it is.
    """

    def __init__(self, url: str, scratch: Path) -> None:
        parts = urlsplit(url)
        self.url = url
        self.root: Path | None = None
        self._store: ObjectStore
        if parts.scheme == "file":
            self.root = Path(unquote(parts.path))
            self.root.mkdir(parents=True, exist_ok=True)
            self._store = LocalStore(self.root)
        else:
            try:
                self._store = from_url(url)
            except Exception as e:
                raise InputError("settings.invalid", f"not a blob store's URL: {e}", "store") from None
        self._local = self.root or scratch

    def clean(self) -> None:
        """Remove what uploads of an earlier life left behind."""
        shutil.rmtree(self._local / "upload", ignore_errors=True)

    def upload(self) -> Upload:
        """A file on its way in, from the network."""
        return Upload(self, self.staging("upload"))

    def staging(self, folder: str) -> Path:
        """A fresh path in `folder` from where :meth:`put` can move a file into the store."""
        parent = self._local / folder
        parent.mkdir(parents=True, exist_ok=True)
        return parent / f"{secrets.token_hex(8)}.part"

    def put(self, path: Path, key: str) -> None:
        """Move a local file into the store under `key`, durably and atomically; the file is gone from `path`."""
        if self.root is None:
            obstore.put(self._store, key, path)
            path.unlink()
            return
        if path.stat().st_dev != self.root.stat().st_dev:
            # A file is renamed within one file system only, and /tmp is often another.
            near = self.staging("upload")
            shutil.copyfile(path, near)
            path.unlink()
            path = near
        with open(path, "rb") as f:
            os.fsync(f.fileno())
        final = self.root / key
        _make_folders(final.parent)
        os.replace(path, final)
        _sync_folder(final.parent)

    def put_blob(self, path: Path) -> tuple[str, int]:
        """Move a local file in as a blob; answers its digest and its size."""
        with open(path, "rb") as f:
            digest = "sha256:" + hashlib.file_digest(f, "sha256").hexdigest()
        size = path.stat().st_size
        self.put(path, blob_key(digest))
        return digest, size

    def put_work(self, job: str, name: str, data: bytes) -> str:
        """Store bytes in a job's work folder; answers ``NAME@sha256:HEX``, what :meth:`get_work` takes and checks."""
        path = self.staging(f"work/{job}")
        path.write_bytes(data)
        self.put(path, work_key(job, name))
        return f"{name}@sha256:{hashlib.sha256(data).hexdigest()}"

    def get_work(self, job: str, reference: str) -> bytes:
        """Bytes from a job's work folder.

        Raises
        ------
        BakeError
            ``blob.corrupt``, where they are not what was stored, or ``blob.missing``.
        """
        name, _, digest = reference.rpartition("@")
        try:
            data = bytes(obstore.get(self._store, work_key(job, name)).bytes())
        except FileNotFoundError:
            raise BakeError("blob.missing", "is gone from the blob store", work_key(job, name)) from None
        if "sha256:" + hashlib.sha256(data).hexdigest() != digest:
            raise BakeError("blob.corrupt", "does not have the digest it was stored with", work_key(job, name))
        return data

    def peek_work(self, job: str, name: str) -> bytes | None:
        """What lies in a job's work folder under `name`, for a look at it; None where there is nothing."""
        try:
            return bytes(obstore.get(self._store, work_key(job, name)).bytes())
        except FileNotFoundError:
            return None

    def remove_blob(self, digest: str) -> None:
        """Remove a blob that no row names any more."""
        with suppress(FileNotFoundError):
            obstore.delete(self._store, blob_key(digest))
        if self.root is None:
            (self._local / blob_key(digest)).unlink(missing_ok=True)

    def remove_work(self, job: str) -> None:
        """Remove a job's work folder."""
        if self.root is not None:
            shutil.rmtree(self.root / "work" / job, ignore_errors=True)
            return
        shutil.rmtree(self._local / "work" / job, ignore_errors=True)
        for batch in obstore.list(self._store, work_key(job, "")):
            obstore.delete(self._store, [entry["path"] for entry in batch])

    def jobs_with_work(self) -> set[str]:
        """The jobs that have a work folder."""
        found = obstore.list_with_delimiter(self._store, "work")
        return {prefix.removeprefix("work/").strip("/") for prefix in found["common_prefixes"]}

    def local_path(self, digest: str) -> Path:
        """A local file with a blob's bytes; fetched into the scratch folder first where the store is elsewhere."""
        path = self._local / blob_key(digest)
        if self.root is None and not path.exists():
            part = self.staging("fetch")
            with open(part, "wb") as f:
                for chunk in obstore.get(self._store, blob_key(digest)).stream(CHUNK):
                    f.write(chunk)
            _make_folders(path.parent)
            os.replace(part, path)
        if not path.exists():
            raise BakeError("blob.missing", "is gone from the blob store", digest)
        return path

    async def open(self, digest: str, start: int, end: int) -> AsyncIterator[bytes]:
        """Bytes [start, end) of a blob, which are known to be there once this has answered."""
        if end <= start:
            return _chunks(None)
        found = await obstore.get_async(self._store, blob_key(digest), options={"range": (start, end)})
        return _chunks(found)


class Upload:
    """A file being received: hashed while it is written, gone unless it is kept."""

    def __init__(self, store: Blobs, path: Path) -> None:
        self.path = path
        self.size = 0
        self._store = store
        self._hash = hashlib.sha256()
        self._file: BinaryIO = open(path, "xb")  # noqa: SIM115  closed by keep() or __exit__

    def write(self, chunk: bytes) -> None:
        """Append bytes."""
        self._file.write(chunk)
        self._hash.update(chunk)
        self.size += len(chunk)

    @property
    def digest(self) -> str:
        """Of what has been written so far."""
        return "sha256:" + self._hash.hexdigest()

    def close(self) -> None:
        """Everything is written: :attr:`path` may be read now."""
        self._file.close()

    def keep(self) -> None:
        """Move the file into the store as a blob."""
        self.close()
        self._store.put(self.path, blob_key(self.digest))

    def __enter__(self) -> Upload:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
        self.path.unlink(missing_ok=True)


async def _chunks(found: obstore.GetResult | None) -> AsyncIterator[bytes]:
    if found is not None:
        async for chunk in found.stream(CHUNK):
            yield bytes(chunk)


def _make_folders(folder: Path) -> None:
    """Make folders, with each new name synced into its parent: a file is only as durable as the folders above it."""
    if not folder.is_dir():
        _make_folders(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync_folder(folder.parent)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
