"""What a run consists of: for each stage the pieces of work, their fingerprints and what they wait for.

Pure bookkeeping over the plan and the ledger's records: nothing here runs anything, so that the runner, `verify`,
`status` and `debug` all speak of the same work.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ppdf_dask import __version__, filters
from ppdf_dask.chunktable import ChunkRecords, chunk_at
from ppdf_dask.codeprint import code
from ppdf_dask.dropped import are_dropped, kept_density
from ppdf_dask.dtm import Block, DtmGrid, Raster
from ppdf_dask.execute import Work
from ppdf_dask.filters.cloud import Density
from ppdf_dask.grid import MM, Rect
from ppdf_dask.index import Index, packed
from ppdf_dask.ledger import digest
from ppdf_dask.merge import MergeJob
from ppdf_dask.neighbourhood import Cut
from ppdf_dask.params import Parameters
from ppdf_dask.plan import WORKER_MB, Plan
from ppdf_dask.raster import RasterJob, jobs
from ppdf_dask.solve import ClassifyJob
from ppdf_dask.store import RunStore
from ppdf_dask.survey import Tile
from ppdf_dask.tiler import TileJob, unpack_cells

Records = dict[str, dict[str, Any]]

Kept = TypeVar("Kept", Records, ChunkRecords)
"""Where the records of a stage are kept."""

ChunkFacts = Mapping[str, Mapping[str, Any]]
"""What is known of the chunks that are classified, by id; of each its number of ground points at least."""

KEPT = {
    "tile": ("fingerprint", "bounds", "eligible", "no_returns", "odd_returns", "chunks", "labels"),
    "classify": ("ground", "unproven", "repeated", "shared"),
    "merge": ("points",),
    "dtm": (),
}
"""What a driver keeps of the records of the stages with many pieces, until the end of a run."""

SMALL = 2_000_000.0
"""Points of a cloud that take so little memory that cutting it for that would be a waste of time."""


def brief(stage: str, record: dict[str, Any]) -> dict[str, Any]:
    """Return what a driver still asks of a record when its stage is over.

    Examples
    --------
    >>> brief("merge", {"points": 3, "crc32": 1, "seconds": 0.5})
    {'points': 3}
    """
    kept = KEPT.get(stage)
    found = record if kept is None else {name: record[name] for name in kept if name in record}
    return found | {"chunks": packed(found["chunks"])} if stage == "tile" else found


@dataclass
class Total:
    """What a stage took, summed up as its records come."""

    tasks: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0

    def add(self, record: dict[str, Any]) -> None:
        """Count a record."""
        self.tasks += 1
        self.seconds += record["seconds"]
        self.cpu_seconds += record["cpu_seconds"]
        self.peak_mb = max(self.peak_mb, record["peak_mb"])

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        seconds, cpu = round(self.seconds, 3), round(self.cpu_seconds, 3)
        return {"tasks": self.tasks, "seconds": seconds, "cpu_seconds": cpu, "peak_mb": self.peak_mb}


@dataclass(frozen=True, slots=True)
class Waiting:
    """A piece of work that cannot be done because another one failed."""

    stage: str
    ident: str
    because: str


class Works:
    """Pieces of work that are made whenever they are looked at, for the stage that has a piece for each chunk.

    Parameters
    ----------
    items : ndarray of int64
        One number for each, in the order of the work.
    make : callable
        Makes the piece of a number.
    """

    def __init__(self, items: npt.NDArray[np.int64], make: Callable[[int], Work]) -> None:
        self._items, self._make = items, make

    def __iter__(self) -> Iterator[Work]:
        return (self._make(int(item)) for item in self._items)

    def __len__(self) -> int:
        return len(self._items)


@dataclass(frozen=True)
class Inputs:
    """The run before any point is read.

    Attributes
    ----------
    plan : Plan
        The plan.
    """

    plan: Plan

    @cached_property
    def sources(self) -> dict[str, Tile]:
        """Source id to tile."""
        return {f"s_{k:06d}": tile for k, tile in enumerate(self.plan.survey.tiles)}

    def facts(self) -> dict[str, Any]:
        """Return what a run is bound to: when any of it changes, the run is another one."""
        p = self.plan
        return {
            "version": __version__,
            "code": code(),
            "inputs": {t.name: [t.path, t.size, t.mtime_ns, t.sha256] for t in self.sources.values()},
            "crs": p.survey.crs,
            "units": [p.survey.unit_xy, p.survey.unit_z],
            "params": p.params.as_dict(),
            "chunk_size_m": p.grid.size / MM,
            "buffer_m": p.buffer / MM,
        }

    @cached_property
    def tile_keys(self) -> dict[str, str]:
        """Fingerprint of each tile's fragments: the tile itself and how it is cut, not the other tiles."""
        p = self.plan
        how = digest(
            [
                __version__,
                code(),
                p.params.classes.as_dict() | {"returns": p.params.returns},
                p.grid.size,
                p.stored_buffer,
                [p.survey.unit_xy, p.survey.unit_z],
            ]
        )
        return {s: digest([how, t.path, t.name, t.size, t.mtime_ns, t.sha256]) for s, t in self.sources.items()}

    def tile_job(self, source: str) -> TileJob:
        """Return what a worker needs to cut a tile."""
        p = self.plan
        return TileJob(
            source, self.sources[source], p.survey.unit_xy, p.survey.unit_z, p.params, p.grid, p.stored_buffer
        )

    def tile_works(self) -> list[Work]:
        """Return the work of the tile stage, largest first."""
        make = self.tile_job
        works = [Work(s, t.point_count, s, self.tile_keys[s], make) for s, t in self.sources.items()]
        return sorted(works, key=lambda w: (-w.points, w.ident))


@dataclass(frozen=True)
class Cutting:
    """The run once its tiles are cut.

    Attributes
    ----------
    inputs : Inputs
        The run before.
    store : RunStore
        Where the fragments are.
    tiles : dict
        Records of the tiles that were cut; the places of all others are unknown.
    """

    inputs: Inputs
    store: RunStore
    tiles: Records

    @cached_property
    def index(self) -> Index:
        """Which chunk consists of what."""
        return Index.of(self.tiles)

    @cached_property
    def unknown(self) -> tuple[Rect, ...]:
        """Places of the tiles that were left out or could not be cut, as their headers give them."""
        lost = (t for s, t in self.inputs.sources.items() if s not in self.tiles and t.point_count)
        return tuple(sorted([*(t.bounds for t in lost), *self.inputs.plan.survey.lost]))

    @cached_property
    def extent(self) -> Rect:
        """Box around all eligible points and all that is unknown."""
        boxes = [Rect(*r["bounds"]) for r in self.tiles.values() if r["bounds"] and r["eligible"]]
        boxes += self.unknown
        # Nothing to look at still makes a terrain model: one without a height.
        boxes = boxes or [Rect(*r["bounds"]) for r in self.tiles.values() if r["bounds"]] or [Rect(0, 0, 1, 1)]
        found = boxes[0]
        for box in boxes[1:]:
            found = found.union(box)
        return found

    @cached_property
    def density(self) -> Density:
        """Points and occupied cells of the survey; cells that several tiles share are united."""
        kept = kept_density(self.store, self.tiles)
        if kept is not None:
            return kept
        cells, shared = self.index.cells()
        for chunk, sources in shared:
            bits = [unpack_cells(self.store.fragment_attributes(chunk, "core", s)["density_cells"]) for s in sources]
            united = bits[0].copy()
            for other in bits[1:]:
                united |= other
            cells += int.from_bytes(united.tobytes(), "big").bit_count()
        return Density(int(self.index.points.counts.sum()), cells)

    @cached_property
    def filter(self) -> Parameters:
        """The filter's parameters with all that is derived from the density made explicit."""
        params = self.inputs.plan.params.filter
        return filters.of(params).resolve(params, self.density)

    @cached_property
    def cut(self) -> Cut:
        """How the survey lies in the store."""
        p = self.inputs.plan
        return Cut(p.grid, p.stored_buffer, self.extent, self.unknown)

    @cached_property
    def buffer(self) -> int:
        """The buffer a chunk begins with, mm: the plan's, or the reach of a filter that proves nothing if it is wider.

        The plan only estimates the density that a filter's lengths may follow from.
        """
        p, chosen = self.inputs.plan, filters.of(self.filter)
        return p.buffer if chosen.exact else max(p.buffer, math.ceil(chosen.required_buffer(self.filter) * MM))

    @cached_property
    def widest(self) -> int:
        """The widest buffer a chunk may try, mm."""
        asked = round(self.inputs.plan.params.chunks.max_buffer * MM)
        return max(self.buffer, asked) if filters.of(self.filter).exact else self.buffer

    # -- classify -------------------------------------------------------------------------------------------------

    @cached_property
    def classify_key(self) -> str:
        """Fingerprint of every classification: all tiles, the filter, and what is unknown."""
        exact = filters.of(self.filter).exact
        keys = {s: self.inputs.tile_keys[s] for s in self.tiles}
        unknown = [[r.x0, r.y0, r.x1, r.y1] for r in self.unknown]
        return digest([keys, unknown, self.filter.as_dict(), None if exact else self.buffer])

    def classify_job(self, chunk: str) -> ClassifyJob:
        """Return what a worker needs to classify a chunk."""
        p = self.inputs.plan
        return ClassifyJob(
            p.grid.parse(chunk), self.cut, self.filter, self.buffer, self.widest, self.most_points, self.usual_points
        )

    @cached_property
    def most_points(self) -> float:
        """Points for which a worker has memory."""
        return self.inputs.plan.most_points

    @cached_property
    def usual_points(self) -> float:
        """Points above which a cloud with a wider buffer is cut: those of the largest first one."""
        return float(self.index.loaded.counts.max(initial=round(SMALL)))

    def classify_works(self) -> Works:
        """Return the work of the classify stage, densest chunk first."""
        chunks = self.index.points
        key, make = self.classify_key, self.classify_job

        def work(row: int) -> Work:
            chunk = chunk_at(int(chunks.places[row]))
            return Work(chunk, int(chunks.counts[row]), chunk, key, make)

        return Works(np.argsort(-chunks.counts, kind="stable"), work)

    def chunk_records(self) -> ChunkRecords:
        """Return room for what is kept of the records of the classify stage."""
        *numbers, shared = KEPT["classify"]
        return ChunkRecords(self.index.points, tuple(numbers), shared)

    def still_proven(self, record: dict[str, Any]) -> bool:
        """Tell whether a chunk's record is the best that can be had: proven, or as wide as is allowed."""
        widest = record["full"] or record["buffer_m"] * MM >= self.widest
        return record["unproven"] == 0 or widest or bool(self.unknown)

    def need_mb(self, chunk: str) -> float:
        """Return the memory a worker needs for a chunk with its first buffer, MB."""
        return round(WORKER_MB + self.index.loaded[chunk] * self.inputs.plan.bytes_per_point / 1e6)

    # -- merge ----------------------------------------------------------------------------------------------------

    def merge_key(self, source: str) -> str:
        """Fingerprint of a classified tile."""
        return digest([self.classify_key, self.inputs.tile_keys[source]])

    def target(self, source: str) -> str:
        """Return the path of a classified tile."""
        return str(self.inputs.plan.out / "laz" / self.inputs.sources[source].name)

    def merge_works(self, chunks: ChunkFacts) -> tuple[list[Work], list[Waiting]]:
        """Return the tiles whose chunks are all classified, largest first, and those that wait."""
        works: list[Work] = []
        waiting: list[Waiting] = []
        make = partial(self._merge_job, dropped=are_dropped(self.store))
        missing: dict[str, str] = {}
        for chunk in self._lost(chunks):
            for source in self.index.parts(chunk)["core"]:
                missing.setdefault(source, chunk)
        for source, tile in self.inputs.sources.items():
            if source not in self.tiles:
                continue
            if source in missing:
                waiting.append(Waiting("merge", source, f"chunk {missing[source]} is not classified"))
                continue
            works.append(Work(source, tile.point_count, source, self.merge_key(source), make))
        return sorted(works, key=lambda w: (-w.points, w.ident)), waiting

    def _lost(self, chunks: ChunkFacts) -> Iterator[str]:
        """Yield the chunks that are not classified."""
        return (chunk for chunk in self.index.points if chunk not in chunks)

    def _merge_job(self, source: str, *, dropped: bool) -> MergeJob:
        labels = 0 if dropped else self.index.labels[source]
        key = self.inputs.tile_keys[source]
        return MergeJob(self.inputs.tile_job(source), self.target(source), self.classify_key, labels, key)

    # -- terrain model --------------------------------------------------------------------------------------------

    @cached_property
    def raster(self) -> Raster:
        """The raster of the terrain model."""
        return Raster.over(DtmGrid.from_params(self.inputs.plan.params.dtm), self.extent)

    @cached_property
    def raster_key(self) -> str:
        """Fingerprint of the raster's arrays and blocks."""
        p = self.inputs.plan
        return digest([self.classify_key, p.params.dtm.as_dict(), p.survey.unit_z, p.survey.crs])

    def dtm_works(self, chunks: ChunkFacts) -> tuple[list[Work], list[Waiting]]:
        """Return the blocks all of whose surroundings are classified, fullest first, and those that wait."""
        p = self.inputs.plan
        lost = {p.grid.parse(c).core: self.index.points[c] for c in self._lost(chunks)}
        lost |= dict.fromkeys(self.unknown, 1)
        ground = ((p.grid.parse(c).core, r["ground"]) for c, r in chunks.items() if r["ground"])
        # A block's proof reads ground up to two limits around it.
        reach = 2 * round(max(p.params.dtm.max_edge, p.params.dtm.fill_edge or 0.0) * MM)
        make = self._raster_job
        works: list[Work] = []
        waiting: list[Waiting] = []
        for block, points in jobs(self.raster, chain(ground, lost.items()), p.params.dtm):
            around = block.rect.grow(reach)
            if any(around.intersects(place) for place in lost):
                waiting.append(Waiting("dtm", block.id, "ground around it is not known"))
            else:
                works.append(Work(block.id, points, block, self.raster_key, make))
        return works, waiting

    def _raster_job(self, block: Block) -> RasterJob:
        p = self.inputs.plan
        return RasterJob(block, self.raster, self.cut, p.params.dtm, p.survey.unit_z)

    def cog_work(self, works: list[Work], waiting: list[Waiting]) -> Work:
        """Return the export: ``dtm.tif``, or ``dtm.partial.tif`` while blocks are missing."""
        name = "dtm.partial.tif" if waiting else "dtm.tif"
        key = digest([self.raster_key, sorted(w.ident for w in works)])
        return Work(name, sum(w.points for w in works), str(self.inputs.plan.out / name), key)
