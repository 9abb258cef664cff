"""How time and memory grow with a survey: whole jobs on synthetic surveys beside a plain copy of the same files.

Scheduler, nannies and workers are processes of their own, so that each one's processor time and peak can be told. The
copy runs on the same workers, before and after the job; a tiny job comes first, so that imports and compilation do not
count.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask.experiments.processes import Usage, Watch, cluster
from ppdf_dask.grid import MM, Rect
from ppdf_dask.heap import give_back
from ppdf_dask.params import RunParams
from ppdf_dask.synthetic import SyntheticParams

if TYPE_CHECKING:
    from distributed import Client

    from ppdf_dask.reader import Labels
    from ppdf_dask.tiler import TileJob

LANDSCAPE = SyntheticParams()
"""A wooded valley of 8.8 points/m2."""

PER_M2 = 8.8
"""Points per square metre of that landscape, measured."""

TILE = 500
"""Edge of a tile, m: 2.2 million points."""

EDGE = (500_000, 5_400_000)
"""South-west corner of every survey, m."""

WARM_UP = (EDGE[0], EDGE[1], EDGE[0] + 500, EDGE[1] + 250)
"""Extent of the job that comes first: 8 small tiles and at least two of anything else, so that all workers are warm."""

Tick = Callable[[str], None]


def extent_of(points: float) -> tuple[float, float, float, float]:
    """Return an extent of whole tiles with about so many points, nearly square.

    Examples
    --------
    >>> extent_of(10e6)
    (500000.0, 5400000.0, 501000.0, 5401000.0)
    """
    tiles = max(1.0, points / (PER_M2 * TILE**2))
    columns = math.ceil(math.sqrt(tiles) - 0.25)
    rows = max(1, round(tiles / columns))
    x, y = EDGE
    return float(x), float(y), float(x + columns * TILE), float(y + rows * TILE)


def make_survey(
    client: Client, folder: Path, extent: tuple[float, float, float, float], tile: int = TILE
) -> list[Path]:
    """Generate a survey's tiles on the workers unless they are there: smaller surveys are parts of larger ones."""
    from ppdf_dask.synthetic.tiles import tile_rects

    made = [
        client.submit(_make_tile, str(folder), rect, key=f"generate-{folder.name}-{rect.x0}-{rect.y0}")
        for rect in tile_rects(extent, tile)
    ]
    return [Path(path) for path in client.gather(made)]


def _make_tile(folder: str, rect: Rect) -> str:
    from ppdf_dask.synthetic.tiles import write_tile

    path = Path(folder) / "tiles" / f"x{rect.x0 // MM:07d}_y{rect.y0 // MM:07d}.laz"
    if not path.exists():
        write_tile(rect, LANDSCAPE, [(path, False)], "EPSG:25832")
    return str(path)


@dataclass(frozen=True)
class Copy:
    """A plain copy of all tiles: seconds by the wall and of the processor, workers only."""

    seconds: float
    cpu_seconds: float


def copy_all(client: Client, tiles: list[Path], folder: Path) -> Copy:
    """Copy tiles with laspy, one task per tile, the largest first as in a run."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    begin = time.perf_counter()
    todo = sorted(tiles, key=lambda path: -path.stat().st_size)
    token = f"{folder.name}-{begin}"
    flying = [
        client.submit(copy_tile, str(p), str(folder / p.name), key=f"copy-{p.stem}-{token}", pure=False) for p in todo
    ]
    cpu = sum(client.gather(flying))
    seconds = time.perf_counter() - begin
    shutil.rmtree(folder)
    return Copy(round(seconds, 2), round(cpu, 2))


def copy_tile(source: str, target: str) -> float:
    """Read and write one tile with laspy, a million points at a time; return the processor seconds."""
    import laspy

    begin = time.process_time()
    backend = laspy.LazBackend.Lazrs
    with (
        laspy.open(source, laz_backend=backend) as reader,
        laspy.open(target, "w", header=reader.header, laz_backend=backend, do_compress=True) as writer,
    ):
        for points in reader.chunk_iterator(1_000_000):
            writer.write_points(points)
    return time.process_time() - begin


@dataclass
class Measured:
    """One survey, one number of workers.

    Attributes
    ----------
    points, workers : int
        Size of the survey, number of workers.
    seconds : float
        The whole job, start-up aside.
    copies : list of Copy
        The plain copy, before and after.
    stages : dict
        Tasks, wall and processor seconds and peak of each stage, and its first and last second in the job.
    idle : float
        Share of the workers' wall time without a task.
    usage : dict
        `Usage` by role.
    work : dict
        Shares of the workers' processor time that have a name of their own; see `shares`.
    store_mb, input_mb : float
        Disk used by ``run.zarr`` and the input.
    objects, chunks, fragments : int
        Files in ``run.zarr``, chunks and fragments of the run.
    plan, load : dict, tuple
        The plan's facts; the machine's load average at the end.
    """

    points: int
    workers: int
    seconds: float
    copies: list[Copy]
    stages: dict[str, dict[str, Any]]
    idle: float
    usage: dict[str, Usage]
    work: dict[str, float]
    store_mb: float
    input_mb: float
    objects: int
    chunks: int
    fragments: int
    plan: dict[str, Any]
    load: tuple[float, ...] = field(default_factory=os.getloadavg)

    @property
    def ratio(self) -> float:
        """Seconds of the job over those of the copies."""
        return self.seconds / (sum(c.seconds for c in self.copies) / len(self.copies))

    @property
    def cpu_ratio(self) -> float:
        """The same of the workers' processor time, which other programs on the machine disturb less."""
        return self.usage["workers"].cpu_seconds / (sum(c.cpu_seconds for c in self.copies) / len(self.copies))


def measure(client: Client, pids: dict[str, list[int]], tiles: list[Path], folder: Path, params: RunParams) -> Measured:
    """Run the whole job on tiles, between two copies.

    Parameters
    ----------
    client, pids : Client, dict
        As `cluster` gives them.
    tiles : list of Path
        The survey.
    folder : Path
        For copy and run; the run stays there.
    params : RunParams
        Of the job.
    """
    from ppdf_dask.cluster import memory_per_worker
    from ppdf_dask.events import Event
    from ppdf_dask.plan import plan
    from ppdf_dask.survey import scan

    workers = len(pids["workers"])
    survey = scan([str(p) for p in tiles])
    made = plan(survey, params, out=folder / "run", memory=memory_per_worker(workers))
    copies = [copy_all(client, tiles, folder / "copy")]
    client.run(give_back)  # What the copy has freed is not the job's.
    begin, spans = time.perf_counter(), dict[str, list[float]]()

    def hear(event: Event) -> None:
        spans.setdefault(event.stage, []).append(time.perf_counter() - begin)

    with Watch(pids) as watch:
        begin = time.perf_counter()
        made.run(client, on_event=hear, overwrite=True)
        seconds = time.perf_counter() - begin
    copies.append(copy_all(client, tiles, folder / "copy"))
    report = json.loads((folder / "run" / "run.json").read_text())
    stages = {
        name: {**total, "from": round(spans[name][0], 2), "to": round(spans[name][-1], 2)}
        for name, total in sorted(report["stages"].items(), key=lambda item: spans[item[0]][0])
    }
    busy = sum(total["seconds"] for total in stages.values())
    files = [f for f in (folder / "run" / "run.zarr").rglob("*") if f.is_file()]
    fragments = sum(1 for _ in (folder / "run" / "run.zarr" / "chunks").glob("*/*/*/zarr.json"))
    # Not in this process: what a tile leaves behind would count as the client's memory in the next row.
    work = client.submit(
        shares, folder / "run", tiles[0], survey.point_count, watch.usage["workers"].cpu_seconds, pure=False
    ).result()
    return Measured(
        points=survey.point_count,
        workers=workers,
        seconds=round(seconds, 2),
        copies=copies,
        stages=stages,
        idle=round(1 - busy / (workers * seconds), 3),
        usage=watch.usage,
        work=work,
        store_mb=round(sum(f.stat().st_size for f in files) / 1e6, 1),
        input_mb=round(sum(t.size for t in survey.tiles) / 1e6, 1),
        objects=len(files),
        chunks=report["counts"]["chunks"],
        fragments=fragments,
        plan=made.facts(),
    )


def shares(run: Path, tile: Path, points: int, total: float) -> dict[str, float]:
    """Estimate which share of the workers' processor time goes where, from one tile and the ledger.

    Returns
    -------
    dict
        ``decode`` (once), ``encode`` (the layer of classes), ``verify`` (reading the written file again): of the tiles;
        ``buffers``, ``retries``: of the classification, the first over points around the cores, the second with wider
        buffers; each as a share of `total`.
    """
    from ppdf_dask.saved import load_plan
    from ppdf_dask.stages import Inputs
    from ppdf_dask.store import RunStore

    inputs = Inputs(load_plan(run))
    job = next(j for j in map(inputs.tile_job, inputs.sources) if j.tile.path == str(tile))
    decode, encode, verify = _tile_work(job)
    scale = points / job.tile.point_count / total
    records = [record for _, record in RunStore(str(run / "run.zarr")).records("classify")]
    spent = sum(r["cpu_seconds"] for r in records) / total
    core, first = sum(r["points"] for r in records), sum(r["loaded_first"] for r in records)
    loaded = sum(r["loaded"] for r in records)
    return {
        "decode": round(decode * scale, 3),
        "encode": round(encode * scale, 3),
        "verify": round(verify * scale, 3),
        "buffers": round(spent * (first - core) / loaded, 3),
        "retries": round(spent * (loaded - first) / loaded, 3),
    }


def _cpu(function: Callable[[], object]) -> float:
    begin = time.process_time()
    function()
    return time.process_time() - begin


def _tile_work(job: TileJob) -> tuple[float, float, float]:
    """Return the processor seconds of decoding a tile, of writing it with new classes and of reading that again."""
    from ppdf_dask.lasheader import read_header
    from ppdf_dask.merge import class_counts
    from ppdf_dask.relabel import differs, relabel, whole_chunks

    path = job.tile.path
    header = read_header(path)
    labels: list[Labels] = []
    decode = _cpu(lambda: labels.extend(b.labels for b in job.batches(whole_chunks(header))))
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "again.laz"
        encode = _cpu(lambda: relabel(path, header, target, ((part, part.classification) for part in labels)))
        verify = _cpu(lambda: (differs(path, header, target), class_counts(target)))
    return decode, encode, verify


@dataclass(frozen=True)
class ScaleTable:
    """All that was measured."""

    rows: tuple[Measured, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            "rows": [
                {**asdict(row), "ratio": round(row.ratio, 2), "cpu_ratio": round(row.cpu_ratio, 2)} for row in self.rows
            ]
        }

    def markdown(self) -> str:
        """Return tables."""
        lines = [
            "| points | workers | s | us/point | copy s | ratio | cpu ratio | idle | worker MB | client MB | "
            "scheduler MB | run.zarr / input | objects/chunk |",
            "|---:" * 13 + "|",
        ]
        for r in self.rows:
            copies = sum(c.seconds for c in r.copies) / len(r.copies)
            lines.append(
                f"| {r.points:,} | {r.workers} | {r.seconds:.1f} | {r.seconds / r.points * 1e6:.2f} | {copies:.1f} | "
                f"{r.ratio:.2f} | {r.cpu_ratio:.2f} | {r.idle:.0%} | {r.usage['workers'].peak_mb:.0f} | "
                f"{r.usage['client'].peak_mb:.0f} | {r.usage['scheduler'].peak_mb:.0f} | "
                f"{r.store_mb / r.input_mb:.2f} | {r.objects / r.chunks:.1f} |"
            )
        names = list(self.rows[0].stages) if self.rows else []
        lines += ["", "Processor seconds per million points:", ""]
        lines += ["| points | workers | " + " | ".join([*names, "scheduler", "client", "nannies"]) + " |"]
        lines += ["|---:" * (len(names) + 5) + "|"]
        for r in self.rows:
            spent = [r.stages[n]["cpu_seconds"] for n in names]
            spent += [r.usage[role].cpu_seconds for role in ("scheduler", "client", "nannies")]
            values = " | ".join(f"{s / r.points * 1e6:.3f}" for s in spent)
            lines.append(f"| {r.points:,} | {r.workers} | {values} |")
        lines += ["", "Shares of the workers' processor time, estimated:", ""]
        for r in self.rows:
            lines.append(f"- {r.points:,}: " + ", ".join(f"{k} {v:.0%}" for k, v in r.work.items()))
        return "\n".join([*lines, "", *self._efficiency()])

    def _efficiency(self) -> Iterator[str]:
        """Compare rows of one size with those of one worker."""
        alone = {r.points: r for r in self.rows if r.workers == 1}
        for r in self.rows:
            if r.workers > 1 and r.points in alone:
                gain = alone[r.points].seconds / r.seconds
                yield f"{r.points:,} points: {r.workers} workers are {gain:.2f} times as fast as one"


def study(sizes: list[float], workers: list[int], folder: Path, params: RunParams, tick: Tick) -> ScaleTable:
    """Measure all sizes with all numbers of workers; tiles and runs stay in `folder`."""
    places = {points: folder / f"{points / 1e6:g}M" for points in sizes}
    # By workers of their own: what generating and compiling leave in a process would count as memory of the job.
    with cluster(max(workers)) as (client, pids):
        warm = make_survey(client, folder / "warm", WARM_UP, 125)
        tiles = {points: make_survey(client, folder, extent_of(points)) for points in sizes}
        measure(client, pids, warm, folder / "warm", params)
    rows = []
    for count, (points, place) in product(workers, places.items()):
        # And so would what a smaller survey leaves.
        with cluster(count) as (client, pids):
            for _ in range(2):
                measure(client, pids, warm, folder / "warm", params)
            rows.append(measure(client, pids, tiles[points], place, params))
            tick(f"{points / 1e6:g} million points, {count} workers")
    return ScaleTable(tuple(sorted(rows, key=lambda r: (r.points, r.workers))))
