"""One run at a time in a folder: a lock in the store that names its owner and beats.

The rules:

- A lock is put by one atomic put-if-absent. Its owner renews it every `BEAT` seconds with a number that counts up.
- A lock of this machine (same name, same boot, same process namespace) counts while its process lives: when that is
  gone, or has another start time, the lock is stale at once.
- Any other lock is watched: when its number stands still for `PATIENCE` seconds it is stale. Only the watcher's own
  monotonic clock is used, never a time written by another machine, so clocks may differ by any amount.
- A stale lock is taken over. An owner that finds another's name in its lock (it was suspended for long) stops.
- ``--force-unlock`` takes over without waiting: for a folder whose owner is known to be gone.

Should two runs still meet (an owner that was suspended wakes up), no harm is done: all that a task writes depends on
its fingerprint alone and arrives by atomic puts.
"""

from __future__ import annotations

import getpass
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ppdf_dask.errors import LockedError, StoreError
from ppdf_dask.store import RunStore

BEAT = 2.0
"""Seconds between two renewals."""

PATIENCE = 20.0
"""Seconds without a renewal after which a lock of another machine counts as stale: ten beats."""


@contextmanager
def hold(store: RunStore, *, force: bool = False) -> Iterator[Callable[[], None]]:
    """Hold the lock of a run.

    Parameters
    ----------
    store : RunStore
        The run's store; it need not exist yet.
    force : bool
        Take the lock from whoever holds it.

    Yields
    ------
    callable
        To be called now and then: raises LockedError when the lock was lost.

    Raises
    ------
    LockedError
        When another run works there; the message names user, machine and process.
    """
    mine = _me()
    _take(store, mine, force)
    stop = threading.Event()
    lost: list[dict[str, Any]] = []

    def beat() -> None:
        count = 0
        while not stop.wait(BEAT):
            # A disk that is full or away for a moment must not end the run: the next beat tries again.
            with suppress(OSError):
                holder = store.lock()
                if holder and holder.get("token") != mine["token"]:
                    lost.append(holder)
                    return
                count += 1
                store.renew(mine | {"beat": count})

    def check() -> None:
        if lost:
            raise LockedError(f"{store.url} was taken over by {_who(lost[0])}; this run stops")

    thread = threading.Thread(target=beat, name="ppdf-lock", daemon=True)
    thread.start()
    try:
        yield check
    finally:
        stop.set()
        thread.join()
        with suppress(OSError):
            if (store.lock() or {}).get("token") == mine["token"]:
                store.unlock()


def holder(store: RunStore) -> str | None:
    """Return who holds the lock, in words, or None; a lock that is surely stale has no holder."""
    found = store.lock()
    return None if not found or _surely_dead(found) else _who(found)


def _take(store: RunStore, mine: dict[str, Any], force: bool) -> None:
    for _ in range(3):
        if store.claim(mine):
            return
        other = store.lock()
        if other and not force and not _surely_dead(other) and _beats(store, other):
            raise LockedError(
                f"{store.url} is in use by {_who(other)}; wait for it or stop it. If it is surely gone, "
                "--force-unlock takes over"
            )
        store.unlock()
    raise StoreError(f"the lock of {store.url} changes hands all the time; which runs use this folder?")


def _beats(store: RunStore, first: dict[str, Any]) -> bool:
    """Watch a lock until it changes, or until patience ends."""
    if _is_here(first):
        return True
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        time.sleep(BEAT / 4)
        if store.lock() != first:
            return True
    return False


def _me() -> dict[str, Any]:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's number without a name
        user = str(os.getuid())
    return {
        "token": uuid.uuid4().hex,
        "user": user,
        "host": socket.gethostname(),
        "boot": _boot(),
        "pid": os.getpid(),
        "started": _started(os.getpid()),
        "since": time.strftime("%Y-%m-%d %H:%M:%S %z"),
        "beat": 0,
    }


def _is_here(lock: dict[str, Any]) -> bool:
    """Tell whether the lock's process number means something to this process."""
    return (lock.get("host"), lock.get("boot")) == (socket.gethostname(), _boot()) and _boot() != ""


def _surely_dead(lock: dict[str, Any]) -> bool:
    return _is_here(lock) and lock.get("started") != _started(lock.get("pid"))


def _boot() -> str:
    """Return a name of this boot of the machine and of this process namespace, or nothing where there is none."""
    found = ""
    with suppress(OSError):
        found = Path("/proc/sys/kernel/random/boot_id").read_text().strip() + os.readlink("/proc/self/ns/pid")
    return found


def _started(pid: object) -> str:
    """Return when a process began, in the kernel's ticks; nothing when it is gone or only waits to be buried."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return "" if state == "Z" else rest[18]
    except (OSError, IndexError):
        return ""


def _who(lock: dict[str, Any]) -> str:
    return "{user} on {host}, process {pid}, since {since}".format_map(
        {"user": "?", "host": "?", "pid": "?", "since": "?"} | lock
    )
