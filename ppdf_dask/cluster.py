"""Clusters that the command line starts, on loopback only, one thread per worker process."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ppdf_dask.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client

SINGLE = {
    "NUMBA_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
"""Environment of a worker: parallelism comes from processes alone, so threads must not multiply inside."""


def memory_per_worker(workers: int) -> float:
    """Return the bytes each of `workers` local processes may use: its share of nine tenths of what the machine lets."""
    from distributed.system import MEMORY_LIMIT

    return 0.9 * float(MEMORY_LIMIT) / workers


def default_workers() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local(workers: int | None = None) -> Iterator[Client]:
    """Start a local cluster and stop it at the end.

    Parameters
    ----------
    workers : int, optional
        Worker processes of one thread each; default one per processor.

    Yields
    ------
    distributed.Client
        Scheduler, workers and dashboard listen on 127.0.0.1 only.
    """
    import dask
    from distributed import Client, LocalCluster

    count = workers or default_workers()
    config = {
        "distributed.nanny.pre-spawn-environ": {**dask.config.get("distributed.nanny.pre-spawn-environ"), **SINGLE},
        "distributed.worker.daemon": True,
    }
    with (
        dask.config.set(config),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            memory_limit=int(memory_per_worker(count)),
            dashboard_address=f"127.0.0.1:{_port(8787)}",
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def connect(address: str, *, insecure: bool = False) -> Iterator[Client]:
    """Connect to a scheduler that runs already.

    Parameters
    ----------
    address : str
        ``tcp://host:port`` or ``tls://host:port``, or the path of a scheduler file.
    insecure : bool
        Allow an unencrypted connection to another machine: whoever reaches a Dask port can run code there.

    Raises
    ------
    ClusterError
        No scheduler answers, or the connection would be open.
    """
    from distributed import Client

    is_file = os.path.isfile(address)
    if not is_file and not insecure and not address.startswith("tls://") and not _is_loopback(address):
        raise ClusterError(
            f"{address} is on another machine and not encrypted: whoever reaches that port can run code there. "
            "Use a tls:// scheduler, or --insecure if its network is closed"
        )
    try:
        client = Client(scheduler_file=address) if is_file else Client(address, timeout=20)
    except (OSError, ValueError, TimeoutError) as error:
        raise ClusterError(
            f"no scheduler answers at {address} ({error}); check the address and that it runs"
        ) from error
    with client:
        yield client


def _is_loopback(address: str) -> bool:
    host = address.split("://")[-1].rsplit(":", 1)[0].strip("[]")
    return host in ("localhost", "::1") or host.startswith("127.") or address.startswith("inproc://")


def _port(wanted: int) -> int:
    """Return the wanted port, or 0 (any) when it is taken."""
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return 0
    return wanted
