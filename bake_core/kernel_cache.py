"""Where compiled kernels are kept between runs.

numba recompiles a kernel when the kernel's own file changes, not when a file changes that it inlines functions or constants from. A cache
beside the sources would therefore run yesterday's `lambert_cosine` in today's tracer. Here its folder is named by all of the sources.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

# Old folders serve a checkout that goes back and forth between versions; a week later they are only in the way.
KEEP_SECONDS = 7 * 24 * 3600


def kernel_cache_dir(environment: Mapping[str, str] = os.environ) -> Path:
    """The folder for ``numba.config.CACHE_DIR``.

    ``NUMBA_CACHE_DIR`` goes first where somebody has set it, as an image of a read-only installation does.
    """
    if chosen := environment.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    package = Path(__file__).resolve().parent
    return _first_writable((package / "__pycache__", _user_cache(environment)), f"kernels-{_digest(package.glob('*.py'))}")


def _digest(sources: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _user_cache(environment: Mapping[str, str]) -> Path:
    return Path(environment.get("XDG_CACHE_HOME") or Path(environment.get("HOME", "/nonexistent")) / ".cache") / "octobake"


def _first_writable(parents: Iterable[Path], name: str) -> Path:
    """`name` inside the first of `parents` that can be written, else a private folder that lasts as long as this process.

    Never a folder that others could have written: the cache is code.
    """
    for parent in parents:
        folder = parent / name
        try:
            fresh = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        if fresh:
            _drop_old(parent)
        return folder
    private = tempfile.mkdtemp(prefix="octobake-kernels-")
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    return Path(private)


def _drop_old(parent: Path) -> None:
    for folder in parent.glob("kernels-*"):
        if folder.stat().st_mtime < time.time() - KEEP_SECONDS:
            shutil.rmtree(folder, ignore_errors=True)
