"""What a worker runs: one function per stage.

Each takes the store's path and a small job, does its work, publishes its record last, and returns the record. Points
never leave the worker.
"""

from __future__ import annotations

import resource
import sys
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ppdf_dask import filters, raster
from ppdf_dask.grid import Chunk
from ppdf_dask.ledger import Ledger
from ppdf_dask.merge import MergeJob, write_tile
from ppdf_dask.mosaic import open_dtm, write_cog
from ppdf_dask.neighbourhood import Cut, load
from ppdf_dask.params import Parameters
from ppdf_dask.raster import RasterJob
from ppdf_dask.store import RunStore
from ppdf_dask.tiler import TileJob, cut


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


def tile(url: str, job: TileJob, fingerprint: str) -> dict[str, Any]:
    """Cut one source file into fragments."""
    clock, store = _Clock(), RunStore(url)
    record = {"status": "done", **cut(store, job), **clock.stamp()}
    Ledger(store).publish("tile", job.source, fingerprint, record)
    return record


@dataclass(frozen=True)
class ClassifyJob:
    """What a worker needs to classify one chunk.

    Attributes
    ----------
    chunk : Chunk
        The chunk.
    cut : Cut
        How the survey lies in the store.
    filter : Parameters
        The filter's parameters, nothing left to derive.
    buffer, max_buffer : int
        First guess and limit of the buffer, mm.
    """

    chunk: Chunk
    cut: Cut
    filter: Parameters
    buffer: int
    max_buffer: int


def classify(url: str, job: ClassifyJob, fingerprint: str) -> dict[str, Any]:
    """Classify the core of one chunk, with as wide a buffer as its proof needs."""
    clock, store = _Clock(), RunStore(url)
    chosen = filters.of(job.filter)
    width, tries, loaded = job.buffer, 0, 0
    while True:
        cloud, counts = load(store, job.cut, job.chunk, width)
        verdict = chosen.classify(cloud, job.filter)
        tries, loaded = tries + 1, cloud.n
        unproven = int(verdict.unproven.sum())
        if unproven == 0 or cloud.known is None or width >= job.max_buffer:
            break
        width = min(2 * max(width, job.cut.buffer, 10_000), job.max_buffer)
    ground = verdict.ground
    if cloud.fixed is not None:
        ground = ground | cloud.fixed[: cloud.n_core]
    store.write_classification(job.chunk.id, ground, counts)
    points = np.stack([v[: cloud.n_core][ground] for v in (cloud.x, cloud.y, cloud.z)])
    store.write_ground(job.chunk.id, points)
    record = {
        "status": "done" if cloud.n_core else "empty",
        "points": cloud.n_core,
        "loaded": loaded,
        "ground": int(ground.sum()),
        "unproven": unproven,
        "buffer_m": width / 1000,
        "tries": tries,
        "crc32": zlib.crc32(ground.tobytes()),
        **clock.stamp(),
    }
    Ledger(store).publish("classify", job.chunk.id, fingerprint, record)
    return record


def merge(url: str, job: MergeJob, fingerprint: str) -> dict[str, Any]:
    """Write one source file again, classified."""
    clock, store = _Clock(), RunStore(url)
    record = {"status": "done", **write_tile(store, job), **clock.stamp()}
    Ledger(store).publish("merge", job.tile.source, fingerprint, record)
    return record


def rasterize(url: str, job: RasterJob, fingerprint: str) -> dict[str, Any]:
    """Compute one block of the terrain model."""
    clock, store = _Clock(), RunStore(url)
    record = {**raster.rasterize(store, job), **clock.stamp()}
    Ledger(store).publish("dtm", job.block.id, fingerprint, record)
    return record


def export(url: str, target: str, fingerprint: str) -> dict[str, Any]:
    """Export the terrain model as a Cloud-Optimized GeoTIFF."""
    clock, store = _Clock(), RunStore(url)
    path = Path(target)
    write_cog(open_dtm(url, dask=False), path)
    record = {"status": "done", "bytes": path.stat().st_size, **clock.stamp()}
    Ledger(store).publish("cog", "dtm", fingerprint, record)
    return record
