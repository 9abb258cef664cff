"""A cluster whose scheduler, nannies and workers are processes of their own, and what each of them takes."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client


@dataclass
class Usage:
    """What one kind of process took.

    Attributes
    ----------
    processes : int
        How many there were.
    peak_mb : float
        Largest resident size of any of them, sampled, MB.
    cpu_seconds : float
        Processor time of all of them.
    """

    processes: int = 0
    peak_mb: float = 0.0
    cpu_seconds: float = 0.0


class Watch:
    """Samples the processes of a cluster while it is entered."""

    def __init__(self, pids: dict[str, list[int]], every: float = 0.2) -> None:
        import psutil

        self._every, self._end = every, threading.Event()
        self._groups = {role: [psutil.Process(p) for p in found] for role, found in pids.items()}
        self.usage = {role: Usage(len(found)) for role, found in self._groups.items()}
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> Watch:
        self._before = self._cpu()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        for role, seconds in self._cpu().items():
            self.usage[role].cpu_seconds = round(seconds - self._before[role], 2)

    def _cpu(self) -> dict[str, float]:
        return {role: sum(sum(p.cpu_times()[:2]) for p in group) for role, group in self._groups.items()}

    def _sample(self) -> None:
        while not self._end.is_set():
            for role, group in self._groups.items():
                peak = max((p.memory_info().rss for p in group), default=0) / 1e6
                self.usage[role].peak_mb = round(max(self.usage[role].peak_mb, peak), 1)
            self._end.wait(self._every)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Give child processes started meanwhile what the user has not set."""
    added = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


@contextmanager
def cluster(workers: int) -> Iterator[tuple[Client, dict[str, list[int]]]]:
    """Start a scheduler and workers as processes of their own; give a client and the process ids by role."""
    from distributed import Client
    from distributed.deploy.subprocess import SubprocessCluster

    from ppdf_dask.cluster import ENVIRONMENT, memory_per_worker

    # Such workers do not hear of this process's Dask configuration, but they get its environment.
    with (
        _environment(ENVIRONMENT),
        SubprocessCluster(
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            n_workers=workers,
            threads_per_worker=1,
            worker_kwargs={"memory_limit": int(memory_per_worker(workers))},
        ) as made,
        Client(made) as client,
    ):
        client.wait_for_workers(workers)
        yield (
            client,
            {
                "workers": list(client.run(os.getpid).values()),
                "nannies": list(client.run(os.getpid, nanny=True).values()),
                "scheduler": [client.run_on_scheduler(os.getpid)],
                "client": [os.getpid()],
            },
        )
