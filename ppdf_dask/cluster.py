"""Clusters for the command line and notebooks, safe by default: loopback only, or encrypted, or said to be insecure."""

from __future__ import annotations

import getpass
import ipaddress
import json
import os
import signal
import socket
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import SplitResult, urlsplit

from ppdf_dask.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

ENVIRONMENT = {
    "NUMBA_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": "8388608",
    "MALLOC_TRIM_THRESHOLD_": "33554432",
    "DASK_DISTRIBUTED__WORKER__PROFILE__CYCLE": "10m",
}
"""Environment of a worker.

Parallelism comes from processes alone, so threads must not multiply inside. Dask's own threshold of 64 KiB makes glibc
give each array back at once and fetch its pages anew: a tenth of a run's processor time. With these it keeps up to
32 MiB and what lies between arrays of less than 8 MiB, once per process: with an arena for each of a worker's threads,
what one has freed is lost to the others.

The profiler of the dashboard keeps a tree of calls for each cycle, up to a thousand of them: with Dask's own cycle of a
second a busy worker grows for a quarter of an hour.
"""

ENCRYPTED = ("tls", "wss", "inproc")
"""Kinds of address that nobody on the way can read."""

CONNECT_TIMEOUT = 20.0
"""Seconds until a scheduler that does not answer counts as absent."""


def memory_per_worker(workers: int) -> float:
    """Return the bytes each of `workers` local processes may use: its share of nine tenths of what the machine lets."""
    from distributed.system import MEMORY_LIMIT

    return 0.9 * float(MEMORY_LIMIT) / workers


def default_workers() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_cluster(workers: int | None = None) -> Iterator[Client]:
    """Start a local cluster and stop it at the end.

    Parameters
    ----------
    workers : int, optional
        Worker processes of one thread each; default one per processor.

    Yields
    ------
    distributed.Client
        Scheduler, workers and dashboard listen on 127.0.0.1 only. Other users of the same machine can reach that, too:
        on a shared login node start a TLS scheduler instead (deploy/README.md).
    """
    import dask
    from distributed import Client, LocalCluster

    count = workers or default_workers()
    before = dask.config.get("distributed.nanny.pre-spawn-environ")
    config = {
        "distributed.nanny.pre-spawn-environ": {**before, **ENVIRONMENT},
        "distributed.worker.daemon": True,
        "distributed.worker.profile.cycle": ENVIRONMENT["DASK_DISTRIBUTED__WORKER__PROFILE__CYCLE"],
        # Dask gives up a worker's place for good when it is empty 15 seconds after a death, also when the next worker
        # died meanwhile or starts slowly on a busy machine: in the end nobody is left and the run waits for ever.
        "distributed.deploy.lost-worker-timeout": "365 days",
        "distributed.worker.preload": [*dask.config.get("distributed.worker.preload"), "ppdf_dask.quiet_worker"],
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
        try:
            yield client
        except BaseException:
            _kill_workers(cluster)
            raise


def _kill_workers(cluster: LocalCluster) -> None:
    """End the workers at once: asked politely, a busy one takes many seconds, and a run survives any death."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.process is not None and nanny.process.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(nanny.process.pid, signal.SIGKILL)


@contextmanager
def connect(address: str, *, insecure: bool = False) -> Iterator[Client]:
    """Connect to a scheduler that runs already.

    Certificates for ``tls://`` come from Dask's own configuration: ``distributed.comm.tls`` in a YAML file, or the
    variables ``DASK_DISTRIBUTED__COMM__TLS__CA_FILE``, ``..__CLIENT__CERT`` and ``..__CLIENT__KEY``.

    Parameters
    ----------
    address : str
        ``tls://host:port`` or ``tcp://host:port``, or the path of a scheduler file.
    insecure : bool
        Allow an unencrypted connection to another machine: whoever reaches a Dask port can run code there.

    Yields
    ------
    distributed.Client
        Closed at the end; the scheduler stays.

    Raises
    ------
    ClusterError
        No scheduler answers, its certificate or ours is refused, a private key is open to others, or the connection
        would not be encrypted.
    """
    from distributed import Client

    wanted = scheduler_file(address) if os.path.isfile(address) else address
    check_address(wanted, insecure=insecure)
    if wanted.startswith("tls://"):
        _check_key()
    try:
        client = Client(wanted, timeout=CONNECT_TIMEOUT)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise ClusterError(_no_answer(wanted, error)) from error
    with client:
        yield client


def check_address(address: str, *, insecure: bool = False) -> None:
    """Refuse an address over which code and data would travel openly.

    Parameters
    ----------
    address : str
        A scheduler's address.
    insecure : bool
        Whether the user takes the risk.

    Raises
    ------
    ClusterError
        For an unencrypted scheduler on another machine.

    Examples
    --------
    >>> check_address("tcp://127.0.0.1:8786")
    >>> check_address("tls://10.0.0.1:8786")
    >>> check_address("tcp://10.0.0.1:8786")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    ppdf_dask.errors.ClusterError: tcp://10.0.0.1:8786 is on another machine and not encrypted: whoever ...
    """
    if insecure or urlsplit(address).scheme in ENCRYPTED or _is_loopback(address):
        return
    raise ClusterError(
        f"{address} is on another machine and not encrypted: whoever reaches that port can run code there. "
        "Use a tls:// scheduler, or --insecure if its network is closed"
    )


def scheduler_file(path: str) -> str:
    """Return the address that a scheduler file holds.

    Raises
    ------
    ClusterError
        When it holds none: the scheduler may still be starting.
    """
    try:
        return str(json.loads(Path(path).read_text(encoding="utf-8"))["address"])
    except (ValueError, KeyError, TypeError) as error:
        raise ClusterError(f"{path} holds no scheduler's address ({error}); does the scheduler run already?") from error


def dashboard(client: Client, environ: Mapping[str, str] = os.environ) -> list[str]:
    """Return where a client's dashboard is, in lines to show; see `dashboard_lines`."""
    return dashboard_lines(client.dashboard_link, environ)


def dashboard_lines(link: str, environ: Mapping[str, str] = os.environ) -> list[str]:
    """Return where a dashboard is, in lines to show.

    Parameters
    ----------
    link : str
        As Dask tells it, from the scheduler's address; it does not tell on which address the dashboard listens.
    environ : mapping
        ``JUPYTERHUB_SERVICE_PREFIX`` and ``SSH_CONNECTION`` are looked at; default the process's own.

    Returns
    -------
    list of str
        The link as a browser needs it: behind JupyterHub the proxied one, over SSH followed by the tunnel's command. Of
        a dashboard that other machines cannot reach (it listens on its scheduler's loopback, as it should), the tunnel
        to that machine. Empty where there is no dashboard.
    """
    if not link:
        return []
    parts = urlsplit(link)
    if parts.scheme in ("http", "https") and parts.port and not _is_loopback(link) and not _answers(parts):
        return [
            f"dashboard on {parts.hostname} only: ssh -N -L {parts.port}:127.0.0.1:{parts.port} {parts.hostname}, "
            f"then http://127.0.0.1:{parts.port}/status"
        ]
    prefix = environ.get("JUPYTERHUB_SERVICE_PREFIX")
    if prefix and parts.scheme in ("http", "https") and parts.port:
        place = str(parts.port) if _is_loopback(link) else f"{parts.hostname}:{parts.port}"
        return [f"dashboard {prefix.rstrip('/')}/proxy/{place}/status"]
    lines = [f"dashboard {link}"]
    if "SSH_CONNECTION" in environ and parts.port:
        there = f"{environ.get('USER') or getpass.getuser()}@{socket.getfqdn()}"
        lines.append(
            f"  from your own machine: ssh -N -L {parts.port}:{parts.hostname}:{parts.port} {there}, "
            f"then http://127.0.0.1:{parts.port}/status"
        )
    return lines


def _answers(place: SplitResult) -> bool:
    """Tell whether somebody listens there."""
    try:
        with socket.create_connection((place.hostname, place.port), timeout=1.0):
            return True
    except OSError:
        return False


def _is_loopback(address: str) -> bool:
    host = urlsplit(address if "://" in address else f"tcp://{address}").hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_key() -> None:
    """Refuse a private key that others can read."""
    import dask

    key = dask.config.get("distributed.comm.tls.client.key", default=None)
    if not key:
        raise ClusterError(
            "a tls:// scheduler needs this side's certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, "
            "DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT and DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY"
        )
    try:
        mode = stat.S_IMODE(os.stat(key).st_mode)
    except OSError as error:
        raise ClusterError(f"the private key {key} cannot be read: {error.strerror}") from error
    if mode & 0o077:
        raise ClusterError(f"the private key {key} has mode {mode:04o}: others can read it; chmod 600 {key}")


def _no_answer(address: str, error: BaseException) -> str:
    chain, cause = [str(error)], error.__cause__ or error.__context__
    while cause is not None and len(chain) < 8:
        chain.append(str(cause))
        cause = cause.__cause__ or cause.__context__
    text = " ".join(chain)
    if "certificate" in text.lower():
        why = next(part for part in chain if "certificate" in part.lower())
        return f"{address} and this side do not trust each other's certificates ({why}); both need the same CA file"
    hint = ", and whether it wants tls://" if address.startswith("tcp://") else ""
    first = str(error) or type(error).__name__
    return f"no scheduler answers at {address} ({first}); check the address, that it runs{hint}"


def _port(wanted: int) -> int:
    """Return the wanted port, or 0 (any) when it is taken."""
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return 0
    return wanted
