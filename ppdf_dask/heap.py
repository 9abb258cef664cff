"""Freed memory back to the operating system, so that one task's leavings are not part of the next one's peak."""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """Return glibc's ``malloc_trim``; other C libraries have none."""
    if not sys.platform.startswith("linux"):
        return None
    found: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return found


def give_back() -> None:
    """Give all whole pages that hold nothing back.

    Arrays below `MALLOC_MMAP_THRESHOLD_` (`ppdf_dask.cluster.ENVIRONMENT`) come from one heap, of which only the end
    shrinks by itself: a single small object that stays keeps all below it.
    """
    trim = _trim()
    if trim is not None:
        trim(0)
