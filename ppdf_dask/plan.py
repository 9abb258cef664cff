"""Survey and parameters to a plan: chunks, points, memory, disk; from headers alone, no point is touched."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask import filters
from ppdf_dask.classes import check_writable
from ppdf_dask.errors import PlanError
from ppdf_dask.estimate import ChunkEstimates, eligible, estimate
from ppdf_dask.filters.cloud import Density
from ppdf_dask.grid import MM, ChunkGrid
from ppdf_dask.params import RunParams
from ppdf_dask.survey import Survey, Tile
from ppdf_dask.tiles import shown

if TYPE_CHECKING:
    from distributed import Client
    from matplotlib.axes import Axes

    from ppdf_dask.events import Event
    from ppdf_dask.result import Result
    from ppdf_dask.submit import Submission

WORKER_MB = 310.0
"""Resident size of a worker that has imported everything and compiled its kernels, measured."""

TILE_BYTES = 130.0
"""Bytes per point of the batch in flight while a tile is decoded or written, measured."""

BATCH_POINTS = 1_000_000
"""Points decoded at a time."""

STORED_BYTES = 5.5
"""Bytes per stored point in Zarr, between the 4 and 6.3 measured on clouds of 0.3 to 15 points/m2."""

CHUNK_SIZES = (50, 100, 150, 200, 250, 300, 400, 500, 750, 1000, 1250, 1500, 2000, 2500, 3000, 4000, 5000, 7500, 10_000)
"""Edges in metres the planner chooses from."""

FEW_POINTS = 500_000
"""A chunk below this is not worth cutting further to feed more workers."""

MOST_POINTS = 1_500_000
"""Points of a core above which larger chunks save little buffer work, while memory and the tail of a run grow."""

MANY_BUFFERS = 4
"""A chunk is at least so many buffers wide where memory allows: then buffers are at most 5/4 of the core's points."""


@dataclass(frozen=True)
class Plan:
    """What a run will do and take; `run` does it.

    Attributes
    ----------
    survey : Survey
        The tiles.
    params : RunParams
        What shapes the result.
    out : Path
        Folder of the run.
    grid : ChunkGrid
        The chunks.
    buffer : int
        First guess of the buffer, mm.
    memory : float
        Bytes a worker may use.
    """

    survey: Survey
    params: RunParams
    out: Path
    grid: ChunkGrid
    buffer: int
    memory: float

    @property
    def stored_buffer(self) -> int:
        """Width of the buffer stored with each chunk, mm: none when it is wider than a chunk (neighbours serve)."""
        return self.buffer if self.buffer <= self.grid.size else 0

    @cached_property
    def chunks(self) -> ChunkEstimates:
        """The chunks, densest first, with their expected numbers of eligible points."""
        return estimate(self.survey, self.grid, self.buffer, self.params.returns == "last")

    @cached_property
    def bytes_per_point(self) -> float:
        """Memory a task needs for each point it loads, in bytes: as read, as joined, and the filter's own."""
        return _bytes_per_point(self.params, self.density)

    @property
    def most_points(self) -> float:
        """Points a task may load at once; a chunk with more is worked on in quarters."""
        return max(0.0, self.memory - WORKER_MB * 1e6) / self.bytes_per_point

    @property
    def task_mb(self) -> float:
        """Expected peak of the largest task, MB, the worker itself included."""
        loaded = float(self.chunks.loaded.max(initial=0.0))
        return WORKER_MB + max(loaded * self.bytes_per_point, BATCH_POINTS * TILE_BYTES) / 1e6

    @property
    def disk_mb(self) -> dict[str, float]:
        """Expected size of the store, the LAZ files and the raster, MB."""
        stored = float(self.chunks.points.sum()) * _share(self.grid.size, self.stored_buffer) * STORED_BYTES
        pixels = _area_mm2(self.survey) / (self.params.dtm.resolution * MM) ** 2
        return {
            "run.zarr": round((stored + pixels * 5) / 1e6, 1),
            "laz": round(sum(t.size for t in self.survey.tiles) / 1e6, 1),
            "dtm.tif": round(pixels * 5 / 1e6, 1),
        }

    @cached_property
    def density(self) -> Density:
        """Expected density of the eligible points; the run itself counts it."""
        return _density(self.survey, self.params)

    def check(self) -> None:
        """Refuse what cannot work.

        Raises
        ------
        PlanError
            A task would exceed the memory of a worker, or the disk would run full; with both numbers.
        ParameterError
            The ground class does not fit a tile's point format.
        """
        for tile in self.survey.tiles:
            check_writable(self.params.classes, tile.point_format, shown(tile.path))
        if self.task_mb * 1e6 > self.memory:
            raise PlanError(
                f"the largest chunk needs about {self.task_mb:.0f} MB but a worker has {self.memory / 1e6:.0f} MB; "
                f"give a smaller --chunk-size than {self.grid.size / MM:g} m or fewer workers with more memory each"
            )
        need, place = sum(self.disk_mb.values()) * 1e6, self.out
        while not place.exists():
            place = place.parent
        free = shutil.disk_usage(place).free
        if need > free:
            raise PlanError(
                f"the run needs about {need / 1e6:.0f} MB but {place} has {free / 1e6:.0f} MB free; "
                "free some space or choose another --out"
            )

    def run(
        self,
        client: Client,
        *,
        on_event: Callable[[Event], None] | None = None,
        overwrite: bool = False,
        accept_changes: bool = False,
        force_unlock: bool = False,
    ) -> Result:
        """Ask all workers whether they can do it, then run; an interrupted run goes on where it stopped.

        Parameters
        ----------
        client : distributed.Client
            Any client; the library never makes a cluster.
        on_event : callable, optional
            Receives each `Event`.
        overwrite, accept_changes : bool
            Start anew; go on with changed inputs or parameters, redoing what they touch.
        force_unlock : bool
            Take the folder's lock from a run that is surely gone (see `ppdf_dask.lock`).

        Returns
        -------
        Result
            The finished run.

        Raises
        ------
        PlanError, ResumeError
            Before any work is done.
        ClusterError
            Before any work when a worker cannot do its part (see `preflight`); later when the cluster is lost.
        PartialRunError
            Some chunks or tiles failed; the others are done.
        """
        from ppdf_dask import preflight
        from ppdf_dask.runner import run

        self.check()
        preflight.check(client, self)
        return run(
            self,
            client,
            on_event=on_event,
            overwrite=overwrite,
            accept_changes=accept_changes,
            force_unlock=force_unlock,
        )

    def submit(self, client: Client, *, overwrite: bool = False, accept_changes: bool = False) -> Submission:
        """Hand the plan to a cluster that outlives this process and return at once; see `submit.submit`."""
        from ppdf_dask.submit import submit

        return submit(self, client, overwrite=overwrite, accept_changes=accept_changes)

    def facts(self) -> dict[str, Any]:
        """Return the plan as plain JSON."""
        return {
            "tiles": len(self.survey.tiles),
            "points": self.survey.point_count,
            "chunks": len(self.chunks),
            "chunk_size_m": self.grid.size / MM,
            "buffer_m": self.buffer / MM,
            "points_per_chunk_max": round(self.chunks.points.max(initial=0.0)),
            "points_loaded_max": round(self.chunks.loaded.max(initial=0.0)),
            "density_per_m2": round(self.density.per_m2, 3),
            "task_mb": round(self.task_mb),
            "disk_mb": self.disk_mb,
            "params": self.params.as_dict(),
        }

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the chunks over the tiles, see `plot.plan_map`; returns the axes."""
        from ppdf_dask.plot import plan_map

        return plan_map(self, ax)

    def __repr__(self) -> str:
        f = self.facts()
        name = filters.of(self.params.filter).name
        return "\n".join(
            (
                f"Plan: {f['tiles']} tiles, {f['points']:,} points -> {f['chunks']} chunks of {f['chunk_size_m']:g} m",
                f"  filter       {name} ({type(self.params.filter).__name__}), {self.params.returns} returns, "
                f"about {f['density_per_m2']:g} eligible points/m2",
                f"  buffer       {f['buffer_m']:g} m at first, up to {self.params.chunks.max_buffer:g} m where needed",
                f"  largest task {f['points_per_chunk_max']:,} points ({f['points_loaded_max']:,} with buffer), "
                f"about {f['task_mb']:,} MB of {self.memory / 1e6:,.0f} MB",
                "  disk         " + ", ".join(f"{k} {v:,.0f} MB" for k, v in f["disk_mb"].items()),
                f"  raster       {self.params.dtm.resolution:g} m pixels",
                f"  output       {self.out}",
            )
        )

    def _repr_html_(self) -> str:
        from ppdf_dask.maps import plan_html

        return plan_html(self)


def plan(
    survey: Survey,
    params: RunParams | None = None,
    *,
    out: str | Path = "ppdf-run",
    memory: float = 4e9,
) -> Plan:
    """Plan a run.

    Parameters
    ----------
    survey : Survey
        From `scan`.
    params : RunParams, optional
        Default: the robust profile of PPDF, a 1 m raster, chunks chosen from the densities.
    out : str or Path
        Folder of the run, made when it starts.
    memory : float
        Bytes each worker may use; default 4 GB.

    Returns
    -------
    Plan
        Cheap to make and to look at; nothing is read but what `scan` read.
    """
    params = params or RunParams()
    chosen = filters.of(params.filter)
    if params.chunks.buffer is None:
        buffer = chosen.required_buffer(chosen.resolve(params.filter, _density(survey, params)))
    else:
        buffer = params.chunks.buffer
        if not chosen.exact and buffer < chosen.required_buffer(params.filter):
            raise PlanError(
                f"--buffer {buffer:g} m is less than the reach of filter {chosen.name}, "
                f"{chosen.required_buffer(params.filter):g} m; leave it out or widen it"
            )
    width = math.ceil(buffer * MM)
    if params.chunks.chunk_size is not None:
        grid = ChunkGrid.from_metres(params.chunks.chunk_size)
    else:
        grid = _choose(survey, params, width, memory)
    return Plan(survey, params, Path(out).absolute(), grid, width, memory)


def _bytes_per_point(params: RunParams, density: Density) -> float:
    own = filters.of(params.filter).bytes_per_point
    return 24.0 + (own(params.filter, density) if callable(own) else own)


def _density(survey: Survey, params: RunParams) -> Density:
    points = sum(eligible(t, params.returns == "last") for t in survey.tiles)
    return Density(round(points), max(1, round(_area_mm2(survey) / MM**2 / 25)))


def _extent(tile: Tile) -> int:
    return tile.bounds.width * tile.bounds.height


def _area_mm2(survey: Survey) -> int:
    return sum(_extent(t) for t in survey.tiles)


def _share(size: int, buffer: int) -> float:
    return ((size + 2 * buffer) / size) ** 2


def _choose(survey: Survey, params: RunParams, buffer: int, memory: float) -> ChunkGrid:
    """Take the largest edge whose densest chunk fits the memory and has points enough, but not more.

    Enough does not grow with the survey, so that the memory of a worker and the time per point do not either.
    """
    fits = (0.6 * memory - WORKER_MB * 1e6) / _bytes_per_point(params, _density(survey, params))
    last = params.returns == "last"
    total = sum(eligible(t, last) for t in survey.tiles)
    densest = max((eligible(t, last) / max(_extent(t), 1) for t in survey.tiles), default=0.0)
    enough = max(min(max(total / 3, FEW_POINTS), MOST_POINTS), densest * (MANY_BUFFERS * buffer) ** 2)
    chosen = CHUNK_SIZES[0]
    for size in CHUNK_SIZES:
        edge = size * MM
        if densest * edge**2 > enough or densest * (edge + 2 * buffer) ** 2 > fits:
            break
        chosen = size
    return ChunkGrid.from_metres(chosen)
