"""Compiled kernels never outlive the code they were made from, and have a place on a read-only machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import ppdf_dask
from ppdf_dask.numbacache import state

PROGRAM = "import os, ppdf_dask; print(os.environ.get('NUMBA_CACHE_DIR', ''))"


def chosen(**environment: str) -> Path:
    kept = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    shown = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, env=kept | environment
    )
    return Path(shown.stdout.strip())


def test_any_changed_kernel_changes_the_folder(tmp_path):
    (tmp_path / "inner").mkdir()
    for name in ("a.py", "inner/b.py"):
        (tmp_path / name).write_text("from numba import njit\nx = 1\n")
    (tmp_path / "plain.py").write_text("x = 1\n")
    before = state(tmp_path)
    (tmp_path / "plain.py").write_text("x = 22\n")
    assert state(tmp_path) == before
    (tmp_path / "inner/b.py").write_text("from numba import njit\nx = 2\n")
    assert state(tmp_path) != before


def test_every_module_that_uses_numba_is_looked_at():
    package = Path(ppdf_dask.__file__).parent
    for path in package.rglob("*.py"):
        text = path.read_text()
        if "@njit" in text or "@leaf" in text:
            assert "import njit" in text or "compiled import" in text, path


def test_the_user_s_choice_wins(tmp_path):
    assert chosen(NUMBA_CACHE_DIR=str(tmp_path)) == tmp_path


def test_home_is_used_and_private(tmp_path):
    folder = chosen(HOME=str(tmp_path))
    assert folder.parent == tmp_path / ".cache" / "ppdf_dask"
    assert folder.stat().st_mode & 0o077 == 0


def test_a_home_that_cannot_be_written_gives_way_to_a_private_temporary_folder(tmp_path):
    (tmp_path / "file").write_text("")
    folder = chosen(HOME=str(tmp_path / "file"), TMPDIR=str(tmp_path))
    assert folder.is_relative_to(tmp_path)
    assert folder.is_dir()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="symbolic links and owners are POSIX matters")
def test_a_link_laid_in_the_temporary_folder_is_not_followed(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "trap").mkdir()
    (tmp_path / f"ppdf_dask-{os.getuid()}").symlink_to(tmp_path / "trap")
    assert str(chosen(HOME=str(tmp_path / "file"), TMPDIR=str(tmp_path))) == "."
    assert not list((tmp_path / "trap").iterdir())
