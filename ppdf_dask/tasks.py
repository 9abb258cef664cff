"""What a worker runs: one function per stage.

Each takes the store's path and a small job, does its work, publishes its record last, and returns the record. Points
never leave the worker.
"""

from __future__ import annotations

import errno
import functools
import resource
import shutil
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ppdf_dask import raster
from ppdf_dask.errors import DiskFullError
from ppdf_dask.heap import give_back
from ppdf_dask.ledger import Ledger
from ppdf_dask.merge import MergeJob, crc32_of, write_tile
from ppdf_dask.mosaic import export_cog
from ppdf_dask.raster import RasterJob
from ppdf_dask.repeats import repeats
from ppdf_dask.solve import ClassifyJob, solve
from ppdf_dask.store import RunStore
from ppdf_dask.tiler import TileJob, cut

NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}
"""What the operating system says when nothing more can be written."""


def peak_mb() -> float:
    """Return the largest resident size of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1e6 if sys.platform == "darwin" else 1e3), 1)


class _Clock:
    """Measures a task for its record; nothing is decided by it."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def stamp(self) -> dict[str, float]:
        return {
            "seconds": round(time.perf_counter() - self._wall, 3),
            "cpu_seconds": round(time.process_time() - self._cpu, 3),
            "peak_mb": peak_mb(),
        }


Task = Callable[[str, Any, str], dict[str, Any]]


def _task(function: Task) -> Task:
    """Turn any error of a full or closed disk into the one that ends the run early, and let go of freed memory."""

    @functools.wraps(function)
    def run(url: str, job: Any, fingerprint: str) -> dict[str, Any]:
        try:
            return function(url, job, fingerprint)
        except Exception as error:
            reason = _no_room(error, Path(url).parent)
            if reason is None:
                raise
            raise DiskFullError(
                f"cannot write below {Path(url).parent} or the temporary folder {tempfile.gettempdir()}: {reason}; "
                "free some space (`ppdf-dask plan` says how much a run needs) and give the same command again"
            ) from error
        finally:
            give_back()

    return run


def _no_room(error: BaseException | None, folder: Path) -> str | None:
    while error is not None:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            return f"{error.strerror}{f' ({error.filename})' if error.filename else ''}"
        # GDAL and the LAZ library report a failed write in their own ways.
        if isinstance(error, RuntimeError | OSError) and shutil.disk_usage(folder).free < 1 << 16:
            return f"no space left ({error})"
        error = error.__cause__ or error.__context__
    return None


@_task
def tile(url: str, job: TileJob, fingerprint: str) -> dict[str, Any]:
    """Cut one source file into fragments."""
    clock, store = _Clock(), RunStore(url, fingerprint)
    record = {"status": "done", **cut(store, job), **clock.stamp()}
    Ledger(store).publish("tile", job.source, fingerprint, record)
    return record | {"fingerprint": fingerprint}


@_task
def classify(url: str, job: ClassifyJob, fingerprint: str) -> dict[str, Any]:
    """Classify the core of one chunk and write mask and ground points."""
    clock, store = _Clock(), RunStore(url, fingerprint)
    found = solve(store, job)
    n = len(found.ground)
    repeated, shared = repeats(found.core, found.counts)
    store.write_classification(job.chunk.id, found.ground, found.counts)
    store.write_ground(job.chunk.id, found.core[:3, found.ground])
    record = {
        "status": "done" if n else "empty",
        "points": n,
        "loaded": sum(found.loaded),
        "loaded_first": found.loaded_first,
        "loaded_most": max(found.loaded),
        "ground": int(found.ground.sum()),
        "unproven": int(found.unproven.sum()),
        "repeated": repeated,
        "shared": shared,
        "buffer_m": found.width / 1000,
        "tries": found.tries,
        "full": found.full,
        "crc32": zlib.crc32(found.ground.tobytes()),
        **clock.stamp(),
    }
    Ledger(store).publish("classify", job.chunk.id, fingerprint, record)
    return record | {"fingerprint": fingerprint}


@_task
def merge(url: str, job: MergeJob, fingerprint: str) -> dict[str, Any]:
    """Write one source file again, classified."""
    clock, store = _Clock(), RunStore(url)
    record = {"status": "done", **write_tile(store, job), **clock.stamp()}
    Ledger(store).publish("merge", job.tile.source, fingerprint, record)
    return record


@_task
def rasterize(url: str, job: RasterJob, fingerprint: str) -> dict[str, Any]:
    """Compute one block of the terrain model."""
    clock, store = _Clock(), RunStore(url)
    record = {**raster.rasterize(store, job), **clock.stamp()}
    Ledger(store).publish("dtm", job.block.id, fingerprint, record)
    return record


@_task
def export(url: str, target: str, fingerprint: str) -> dict[str, Any]:
    """Export the terrain model as a Cloud-Optimized GeoTIFF."""
    clock, store = _Clock(), RunStore(url)
    path = Path(target)
    export_cog(store, path)
    record = {"status": "done", "bytes": path.stat().st_size, "crc32": crc32_of(path), **clock.stamp()}
    Ledger(store).publish("cog", path.name, fingerprint, record)
    return record
