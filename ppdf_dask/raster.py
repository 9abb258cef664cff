"""The terrain model of a run: which blocks to compute, from which chunks, into which arrays of the store."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.dtm import BLOCK, Block, Part, Raster, rasterize_block
from ppdf_dask.grid import MM, Rect
from ppdf_dask.index import owns_points
from ppdf_dask.mosaic import raster_attributes, spatial_ref
from ppdf_dask.neighbourhood import Cut, Kept
from ppdf_dask.params import DtmParams
from ppdf_dask.store import RunStore
from ppdf_dask.survey import Survey


@dataclass(frozen=True)
class RasterJob:
    """What a worker needs to compute one block.

    Attributes
    ----------
    block : Block
        The block.
    raster : Raster
        The run's raster, which tells where the block lies in the arrays.
    cut : Cut
        How the survey lies in the store.
    params : DtmParams
        Resolution and limits.
    unit_z : float
        Metres per unit of the heights to write.
    """

    block: Block
    raster: Raster
    cut: Cut
    params: DtmParams
    unit_z: float


def create(store: RunStore, raster: Raster, params: DtmParams, survey: Survey) -> None:
    """Create the arrays of the terrain model in the survey's own CRS and units."""
    x, y = raster.centres(survey.unit_xy)
    store.create_raster(
        y, x, BLOCK, spatial_ref(raster, survey.crs, survey.unit_xy), raster_attributes(params, survey.unit_z)
    )


def jobs(raster: Raster, ground: Iterable[tuple[Rect, int]], params: DtmParams) -> Iterator[tuple[Block, int]]:
    """Yield the blocks that can hold a height, with the ground points they stand for, most first.

    Parameters
    ----------
    raster : Raster
        The run's raster.
    ground : iterable of (Rect, int)
        The chunks' cores and their ground points.
    params : DtmParams
        A triangle reaches `max_edge` (`fill_edge`) beyond its points at most.
    """
    reach = round(max(params.max_edge, params.fill_edge or 0.0) * MM)
    points: dict[Block, float] = {}
    for core, count in ground:
        for block in raster.grid.over(_clip(core.grow(reach), raster.rect)):
            shared = _clip(core, block.rect)
            share = max(0, shared.width) * max(0, shared.height) / (core.width * core.height)
            points[block] = points.get(block, 0.0) + count * share
    for block, n in sorted(points.items(), key=lambda item: (-item[1], item[0])):
        yield block, max(1, round(n))


def rasterize(store: RunStore, job: RasterJob, into: RunStore | None = None) -> dict[str, Any]:
    """Compute one block and write its shards, into another store if one is given (`debug`)."""
    into, ground = into or store, _Ground(store, job.cut)
    found = rasterize_block(job.block, ground.around, job.params, extent=job.cut.extent, unit_z=job.unit_z)
    row, column = job.block.row - job.raster.row, job.block.col - job.raster.col
    into.write_block("height", row, column, found.height)
    into.write_block("distance", row, column, found.distance)
    if found.filled is not None:
        into.write_block("filled", row, column, found.filled)
    known = ~np.isnan(found.height)
    layers = [v for v in (found.height, found.distance, found.filled) if v is not None]
    return {
        "status": "done" if known.any() else "empty",
        "pixels": int(known.sum()),
        "crc32": checksum(layers),
        "ground_read": found.points,
        "margin_m": found.margin / MM,
    }


class _Ground:
    """The ground points around a block, each chunk's decoded once as long as `Kept` has room."""

    def __init__(self, store: RunStore, cut: Cut) -> None:
        self._cut = cut
        nothing = np.empty((3, 0), np.int32)
        self._kept = Kept(lambda chunk: store.read_ground(chunk) if owns_points(store, chunk) else nothing)

    def around(self, rect: Rect) -> Iterator[Part]:
        """Yield the points of all chunks that share something with a rectangle."""
        for chunk in self._cut.grid.over(_clip(rect, self._cut.extent)):
            yield Part(chunk.core.x0, chunk.core.y0, self._kept.of(chunk.id))


def checksum(layers: list[npt.NDArray[np.float32]]) -> int:
    """Return a checksum of a block's layers in which all NaN are alike."""
    found = 0
    for values in layers:
        found = zlib.crc32(np.where(np.isnan(values), np.float32("nan"), values).tobytes(), found)
    return found


def _clip(a: Rect, b: Rect) -> Rect:
    x0, y0 = max(a.x0, b.x0), max(a.y0, b.y0)
    return Rect(x0, y0, max(x0, min(a.x1, b.x1)), max(y0, min(a.y1, b.y1)))
