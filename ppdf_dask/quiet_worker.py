"""Loaded into local workers: Ctrl-C on a terminal reaches them too, and only the command itself shall answer it."""

from __future__ import annotations

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Ignore SIGINT; called by distributed when the worker starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
