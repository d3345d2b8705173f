"""How kernels are compiled: one place for the options that numbers and speed depend on.

No fastmath (the same bits on every run, and NaN means something), no bounds checks, and no reference counting: kernels own no array, and
counting the tables of a scene in and out of every call took three quarters of a path's time in a box of twelve triangles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

from bake_core.kernel_cache import kernel_cache_dir

numba.config.CACHE_DIR = str(kernel_cache_dir())

# A kernel that only other kernels call; LLVM inlines it as it sees fit.
kernel: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(_nrt=False, error_model="numpy")
# A kernel that Python calls: without the GIL, and kept on disk.
entry_kernel: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(_nrt=False, error_model="numpy", nogil=True, cache=True)
