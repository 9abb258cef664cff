"""A client without a cluster, and ways to kill, stop or starve a run at a chosen moment."""

from __future__ import annotations

import errno
import os
import signal
import sys
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from ppdf_dask.filters.ppdf import RobustParams
from ppdf_dask.merge import MergeJob
from ppdf_dask.objects import ObjectStore
from ppdf_dask.params import ChunkParams, DtmParams, RunParams
from ppdf_dask.plan import Plan, plan
from ppdf_dask.raster import RasterJob
from ppdf_dask.solve import ClassifyJob
from ppdf_dask.survey import scan
from ppdf_dask.tiler import TileJob


class Inline:
    """Runs each task at once, in this process, as a `distributed.Client` would elsewhere; counts what it runs."""

    status = "running"
    scheduler = SimpleNamespace(address="inline")

    def __init__(self, fault: Callable[[str, Any], None] | None = None) -> None:
        self.ran: list[str] = []
        self._fault = fault

    def wait_for_workers(self, n_workers: int, timeout: float) -> None:
        pass

    def run(self, function: Any, *args: Any, on_error: str) -> dict[str, Any]:
        return {"inline": function(*args)}

    def nthreads(self) -> dict[str, int]:
        return {"inline": 1}

    def map(self, call: Any, *arguments: list[Any], key: list[str], pure: bool) -> list[Any]:
        return [self._at_once(call, given, name) for *given, name in zip(*arguments, key, strict=True)]

    def _at_once(self, call: Any, given: list[Any], key: str) -> Any:
        function, *rest = given
        stage, future = key.partition("-")[0], _Future(key)

        def faulty(url: str, job: Any, fingerprint: str) -> dict[str, Any]:
            self.ran.append(f"{stage}-{_ident(job)}")
            if self._fault is not None:
                self._fault(self.ran[-1], job)
            return function(url, job, fingerprint)

        try:
            future.record = call(faulty, *rest)
        except Exception as error:
            future.error, future.status = error, "error"
        return future

    def gather(self, futures: dict[str, Any], errors: str) -> dict[str, Any]:
        return {key: future.record for key, future in futures.items()}

    def cancel(self, futures: Any, force: bool) -> None:
        pass


def _ident(job: Any) -> str:
    if isinstance(job, MergeJob):
        return job.tile.source
    if isinstance(job, ClassifyJob):
        return job.chunk.id
    if isinstance(job, RasterJob):
        return job.block.id
    return job.source if isinstance(job, TileJob) else Path(job).name


class _Future:
    def __init__(self, key: str) -> None:
        self.key, self.status, self.record, self.error = key, "finished", None, None

    def add_done_callback(self, call: Any) -> None:
        call(self)

    def exception(self) -> Any:
        return self.error

    def traceback(self) -> Any:
        return self.error.__traceback__

    def release(self) -> None:
        pass


class KilledWorker(Exception):
    """Stands for the scheduler's verdict of this name on a task whose workers died."""


def small_plan(tiles: Path, out: Path, *, skip_bad: bool = False, **changes: Any) -> Plan:
    """Return a plan of a few chunks with all that is derived fixed, so that a lost tile changes nothing far away."""
    params = RunParams(
        filter=RobustParams(cell_size=1.5),
        chunks=ChunkParams(chunk_size=25.0, buffer=20.0),
        dtm=DtmParams(resolution=1.0),
    )
    return plan(scan([tiles], skip_bad=skip_bad), params.replace(**changes), out=out)


def outputs(out: Path) -> dict[str, int]:
    """Return a checksum of every file a run leaves for its user."""
    return {
        str(p.relative_to(out)): zlib.crc32(p.read_bytes())
        for p in sorted(out.rglob("*"))
        if p.is_file() and "run.zarr" not in p.parts and p.name not in ("run.json", "puts.txt")
    }


def arrays(out: Path) -> dict[str, int]:
    """Return a checksum of every object of the store but the ledger's, which tells times."""
    store = out / "run.zarr"
    return {
        str(p.relative_to(store)): zlib.crc32(p.read_bytes())
        for p in sorted(store.rglob("*"))
        if p.is_file() and p.relative_to(store).parts[0] not in ("ledger", "zarr.json")
    }


def finished(out: Path) -> set[str]:
    """Return the pieces of work that the ledger calls done, as ``stage-id``."""
    ledger = out / "run.zarr" / "ledger"
    stages = ("tile", "classify", "merge", "dtm", "cog")
    return {f"{s}-{p.parent.name}" for s in stages for p in (ledger / s).glob("*/*/zarr.json")}


@contextmanager
def at_put(number: int, action: Callable[[str, bytes, Any], None]) -> Iterator[list[str]]:
    """Do something in place of the `number`-th put into any store, counted from 0; yields the keys put so far.

    The lock's beats come at their own times and do not count.
    """
    true, keys = ObjectStore.put, []

    def put(self: ObjectStore, key: str, value: bytes) -> None:
        if key.startswith("lock"):
            return true(self, key, value)
        keys.append(key)
        if len(keys) - 1 == number:
            return action(key, value, lambda: true(self, key, value))
        return true(self, key, value)

    ObjectStore.put = put
    try:
        yield keys
    finally:
        ObjectStore.put = true


def killed(key: str, value: bytes, put: Callable[[], None]) -> None:
    """Die as by SIGKILL, at once, with nothing cleaned up."""
    os.kill(os.getpid(), signal.SIGKILL)


def full(key: str, value: bytes, put: Callable[[], None]) -> None:
    """Find no room on the disk."""
    raise OSError(errno.ENOSPC, "No space left on device", key)


def in_child(call: Callable[[], Any]) -> int:
    """Run something in a child process; return its exit status, negative for a signal."""
    sys.stdout.flush()
    with warnings.catch_warnings():
        # Python warns of forking a process with threads: this child uses none of its parent's.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        status = 1
        try:
            call()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    _, raw = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(raw)


def same(out: Path, undisturbed: Path) -> bool:
    """Tell whether two runs left the same bytes, for their user and in their stores."""
    return outputs(out) == outputs(undisturbed) and arrays(out) == arrays(undisturbed)
