"""Planning and scheduling at the size of a country: real plans, ledgers and schedules, tasks that do nothing.

Tiles are made up, 10 chunks each; every record a real task would publish is published by the pretended one.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask.dtm import MAX_PIXELS
from ppdf_dask.execute import Stage, Work, execute
from ppdf_dask.experiments.processes import Usage, Watch, cluster
from ppdf_dask.grid import MM, Rect
from ppdf_dask.ledger import Ledger
from ppdf_dask.params import ChunkParams, DtmParams, RunParams
from ppdf_dask.quarantine import Failure
from ppdf_dask.stages import Cutting, Inputs, Kept, Records, brief
from ppdf_dask.store import RunStore
from ppdf_dask.survey import Survey
from ppdf_dask.tiles import Tile

if TYPE_CHECKING:
    from distributed import Client

CHUNK = 500
"""Edge of a chunk, m."""

PER_TILE = 10
"""Chunks of a tile, side by side."""

PER_CHUNK = 1_000_000
"""Eligible points of a chunk."""


@dataclass(frozen=True)
class Simulated:
    """What planning and scheduling took.

    Attributes
    ----------
    chunks, tiles, tasks : int
        Sizes.
    plan_seconds, index_seconds : float
        For the plan, and for the index after tiling.
    stages : dict
        Seconds and tasks per second of each stage.
    usage : dict
        `Usage` by role.
    """

    chunks: int
    tiles: int
    tasks: int
    plan_seconds: float
    index_seconds: float
    stages: dict[str, dict[str, float]]
    usage: dict[str, Usage]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            **{k: v for k, v in vars(self).items() if k != "usage"},
            "usage": {role: vars(u) for role, u in self.usage.items()},
        }

    def markdown(self) -> str:
        """Return a table."""
        lines = [
            f"{self.chunks:,} chunks, {self.tiles:,} tiles: plan {self.plan_seconds:.1f} s, "
            f"index {self.index_seconds:.1f} s",
            "",
            "| stage | tasks | s | tasks/s |",
            "|---|---:|---:|---:|",
        ]
        for name, stage in self.stages.items():
            lines.append(f"| {name} | {stage['tasks']:.0f} | {stage['seconds']:.1f} | {stage['per_second']:.0f} |")
        lines += ["", "| process | peak MB | processor s |", "|---|---:|---:|"]
        lines += [f"| {role} | {u.peak_mb:.0f} | {u.cpu_seconds:.1f} |" for role, u in self.usage.items()]
        return "\n".join(lines)


def country(chunks: int) -> Survey:
    """Return a survey of made-up tiles that gives so many chunks, or a few more.

    Examples
    --------
    >>> survey = country(25)
    >>> len(survey.tiles), survey.point_count
    (3, 30000000)
    """
    tiles = -(-chunks // PER_TILE)
    columns = max(1, round((tiles / PER_TILE) ** 0.5))
    return Survey(tuple(_tile(k, columns) for k in range(columns * -(-tiles // columns))), "/pretended", None, 1.0, 1.0)


def resolution(chunks: int) -> float:
    """Return the least whole metres at which so many chunks have a terrain model that is not refused, a tenth to spare.

    Examples
    --------
    >>> resolution(20_000), resolution(1_000_000)
    (1.0, 3.0)
    """
    # Whole blocks are counted, and the country is made of whole rows.
    return float(math.ceil((1.1 * chunks * CHUNK**2 / MAX_PIXELS) ** 0.5))


def _tile(k: int, columns: int) -> Tile:
    x, y = k % columns * PER_TILE * CHUNK * MM, k // columns * CHUNK * MM
    return Tile(
        path=f"/pretended/{k:07d}.laz",
        name=f"{k:07d}.laz",
        size=1,
        mtime_ns=k,
        version="1.4",
        point_format=6,
        record_length=30,
        point_count=PER_TILE * PER_CHUNK,
        scales=(0.001, 0.001, 0.001),
        offsets=(0.0, 0.0, 0.0),
        first_returns=PER_TILE * PER_CHUNK,
        bounds=Rect(x, y, x + PER_TILE * CHUNK * MM, y + CHUNK * MM),
        z_range=(0.0, 100.0),
        crs=None,
        compressed=True,
        copc=False,
        evlr_count=0,
        guid="0" * 32,
    )


def simulate(chunks: int, folder: Path, workers: int) -> Simulated:
    """Plan a survey of so many chunks and run all its stages with tasks that only publish their records.

    The store stays in `folder`.
    """
    from ppdf_dask.plan import plan

    out = folder / "simulated"
    shutil.rmtree(out, ignore_errors=True)
    stages: dict[str, dict[str, float]] = {}
    with cluster(workers) as (client, pids), Watch(pids) as watch:
        begin = time.perf_counter()
        params = RunParams(chunks=ChunkParams(chunk_size=CHUNK), dtm=DtmParams(resolution=resolution(chunks)))
        made = plan(country(chunks), params, out=out, memory=4e9)
        expected = len(made.chunks)
        planned = time.perf_counter() - begin
        store = RunStore(str(out / "run.zarr"))
        store.create({})
        inputs = Inputs(made)
        tiles = _stage(client, store, "tile", inputs.tile_works(), Records(), stages)
        begin = time.perf_counter()
        cutting = Cutting(inputs, store, tiles)
        cutting.index.publish(store)
        indexed = time.perf_counter() - begin
        found = _stage(client, store, "classify", cutting.classify_works(), cutting.chunk_records(), stages)
        _stage(client, store, "merge", cutting.merge_works(found)[0], Records(), stages)
        _stage(client, store, "dtm", cutting.dtm_works(found)[0], Records(), stages)
    tasks = sum(int(s["tasks"]) for s in stages.values())
    if len(found) != expected:
        raise AssertionError(f"{expected} chunks were planned, {len(found)} done")
    return Simulated(expected, len(inputs.sources), tasks, round(planned, 2), round(indexed, 2), stages, watch.usage)


def _stage(
    client: Client,
    store: RunStore,
    name: str,
    works: Iterable[Work],
    records: Kept,
    stages: dict[str, dict[str, float]],
) -> Kept:
    begin = time.perf_counter()
    for work, outcome in execute(client, Stage(name, pretend, store.url, "pretended"), works, lambda event: None):
        if isinstance(outcome, Failure):
            raise AssertionError(outcome.detail)
        records[work.ident] = brief(name, outcome)
    seconds = time.perf_counter() - begin
    stages[name] = {"tasks": len(records), "seconds": round(seconds, 2), "per_second": round(len(records) / seconds, 1)}
    return records


def pretend(url: str, job: Any, fingerprint: str) -> dict[str, Any]:
    """Publish the record a real task would."""
    from ppdf_dask.merge import MergeJob
    from ppdf_dask.raster import RasterJob
    from ppdf_dask.tiler import TileJob

    common: dict[str, Any] = {"status": "done", "seconds": 0.0, "cpu_seconds": 0.0, "peak_mb": 0.0}
    ledger = Ledger(RunStore(url))
    if isinstance(job, TileJob):
        box = job.tile.bounds
        cores = {c.id: [PER_CHUNK, 2500, 0] for c in job.grid.over(box)}
        record = {"points": job.tile.point_count, "eligible": job.tile.point_count, "chunks": cores}
        record |= {"bounds": [box.x0, box.y0, box.x1, box.y1], "z": [0, 100_000], "classes": {}}
        record |= {"no_returns": 0, "odd_returns": 0, "labels": 1}
        ledger.publish("tile", job.source, fingerprint, record | common)
    elif isinstance(job, MergeJob):
        record = {"points": job.tile.tile.point_count, "changed": 0, "classes": {}, "crc32": 0, "bytes": 1}
        ledger.publish("merge", job.tile.source, fingerprint, record | common)
    elif isinstance(job, RasterJob):
        record = {"pixels": 1, "ground_read": 1, "margin_m": 16.0}
        ledger.publish("dtm", job.block.id, fingerprint, record | common)
    else:
        record = {"points": PER_CHUNK, "loaded": PER_CHUNK, "ground": PER_CHUNK // 2, "unproven": 0, "crc32": 0}
        record |= {"buffer_m": 56.0, "tries": 1, "full": False, "repeated": 0, "shared": {}}
        ledger.publish("classify", job.chunk.id, fingerprint, record | common)
    return {**record, **common, "fingerprint": fingerprint}
