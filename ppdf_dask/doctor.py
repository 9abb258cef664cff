"""What a bug report needs, and nothing that should not be in one: no environment, no paths, no user's name."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from typing import TYPE_CHECKING, Any

from ppdf_dask.preflight import versions

if TYPE_CHECKING:
    from distributed import Client


def facts(dask_worker: Any = None) -> dict[str, Any]:
    """Return versions, machine, memory, disk and what can be imported, as plain JSON types.

    Parameters
    ----------
    dask_worker : distributed.Worker, optional
        Filled in by Dask when this runs on a worker.

    Examples
    --------
    >>> sorted(facts())
    ['filters', 'free disk', 'kernel cache', 'machine', 'memory', 'processors', 'versions']
    """
    from importlib.metadata import entry_points

    from distributed.system import MEMORY_LIMIT

    memory = f"{MEMORY_LIMIT / 1e9:.1f} GB"
    if dask_worker is not None:
        limit, threads = dask_worker.memory_manager.memory_limit, dask_worker.state.nthreads
        memory += f", worker {limit / 1e9:.1f} GB, {threads} threads" if limit else f", no limit, {threads} threads"
    return {
        "versions": versions(),
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}, Python {platform.python_version()}",
        "processors": os.cpu_count(),
        "memory": memory,
        "free disk": f"{shutil.disk_usage(tempfile.gettempdir()).free / 1e9:.1f} GB for temporary files",
        "kernel cache": "in a folder of its own" if os.environ.get("NUMBA_CACHE_DIR") else "beside the package",
        "filters": {e.name: "found" for e in sorted(entry_points(group="ppdf_dask.filters"), key=lambda e: e.name)},
    }


def cluster_facts(client: Client) -> dict[str, str]:
    """Return one line per worker: versions that differ from here, memory, threads, disk."""
    here, found = versions(), {}
    for worker, answer in sorted(client.run(facts, on_error="return").items()):
        if isinstance(answer, BaseException):
            found[worker] = f"{type(answer).__name__}: {answer}"
            continue
        other = [f"{k} {v}" for k, v in answer["versions"].items() if here.get(k) != v]
        line = [f"other versions: {', '.join(other)}" if other else "the same versions", answer["machine"]]
        found[worker] = "; ".join([*line, answer["memory"], answer["free disk"]])
    return found
