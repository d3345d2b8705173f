"""How kernels are compiled: one place for the options that numbers and speed depend on.

No fastmath (the same bits on every run, and NaN means something), no bounds checks, and no reference counting: kernels own no array, and
counting the tables of a scene in and out of every call took three quarters of a path's time in a box of twelve triangles. What kernels
call is always inlined: tables are handed on word by word, some hundreds at every call that is left, which was a quarter of a path's time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from numba import types
from numba.extending import overload

from bake_core.kernel_cache import kernel_cache_dir

# What a kernel answers that looks at a flag: whether it was told to stop.
CANCELLED, DONE = 1, 0

numba.config.CACHE_DIR = str(kernel_cache_dir())

_OPTIONS: dict[str, Any] = {"_nrt": False, "error_model": "numpy"}
_INLINED: dict[str, Any] = {**_OPTIONS, "forceinline": True}
# A kernel that only other kernels call.
kernel: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(**_INLINED)
# A kernel that Python calls: without the GIL, and kept on disk.
entry_kernel: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(**_OPTIONS, nogil=True, cache=True)


def either(field: str) -> Callable[[Callable[..., Any]], Callable[[Callable[..., Any]], Callable[..., Any]]]:
    """Two functions under one name, chosen when a kernel is compiled: by whether the tuple they get first has None for `field`.

    A scene without textures so runs code in which there are none: branches alone, never taken, cost a sixth of a path's time and doubled
    what there is to compile.

    Use it as ``name = either("textures")(where_there_are_some)(where_there_are_none)``; both take the same arguments.
    """

    def first(some: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        def second(none: Callable[..., Any]) -> Callable[..., Any]:
            def called(t: Any, *arguments: Any) -> Any:
                return (none if getattr(t, field) is None else some)(t, *arguments)

            def choose(t: Any, *arguments: Any) -> Any:
                kind = t.types[t.fields.index(field)]
                chosen = none if isinstance(kind, types.NoneType) else some
                return getattr(chosen, "py_func", chosen)

            overload(called, jit_options=_INLINED, strict=False)(choose)
            return called

        return second

    return first
