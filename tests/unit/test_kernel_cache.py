"""Compiled kernels: one folder per state of the sources, in a place that can be written and that only we write."""

import os
import time
from pathlib import Path

from bake_core import kernel_cache


def test_folder_is_named_by_every_source(tmp_path: Path) -> None:
    a, b = tmp_path / "a.py", tmp_path / "b.py"
    a.write_text("x = 1")
    b.write_text("y = 1")
    before = kernel_cache._digest([a, b])
    assert kernel_cache._digest([b, a]) == before
    b.write_text("y = 2")
    assert kernel_cache._digest([a, b]) != before
    # Text that moves from one file to another is a change as well.
    a.write_text("")
    b.write_text("x = 1y = 1")
    assert kernel_cache._digest([a, b]) != before


def test_somebodys_choice_is_left_alone() -> None:
    assert kernel_cache.kernel_cache_dir({"NUMBA_CACHE_DIR": "elsewhere"}) == Path("elsewhere")


def test_read_only_installation_falls_back_to_the_users_cache(tmp_path: Path) -> None:
    # A file where the folder should be: permission bits would not stop root, who runs the tests on a bare machine.
    blocked = tmp_path / "blocked"
    blocked.write_text("")
    user = kernel_cache._user_cache({"HOME": str(tmp_path)})
    assert user == tmp_path / ".cache" / "octobake"
    assert kernel_cache._first_writable((blocked, user), "kernels-1") == user / "kernels-1"
    assert (user / "kernels-1").is_dir()


def test_without_any_place_a_private_folder(tmp_path: Path) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("")
    private = kernel_cache._first_writable((blocked,), "kernels-1")
    try:
        assert private.stat().st_mode & 0o077 == 0
    finally:
        private.rmdir()


def test_folders_of_old_sources_go_after_a_week(tmp_path: Path) -> None:
    for name, age in (("kernels-old", kernel_cache.KEEP_SECONDS + 60), ("kernels-young", 60), ("other", kernel_cache.KEEP_SECONDS + 60)):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    kernel_cache._first_writable((tmp_path,), "kernels-new")
    assert {p.name for p in tmp_path.iterdir()} == {"kernels-young", "kernels-new", "other"}
