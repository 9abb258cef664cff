"""What the headers of a survey let expect of each chunk: its points, and those it is loaded with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.chunktable import columns_and_rows, places
from ppdf_dask.grid import ChunkGrid, Rect
from ppdf_dask.survey import Survey, Tile

Int64 = npt.NDArray[np.int64]
Float = npt.NDArray[np.float64]
Spread = tuple[Int64, Float, Float]
"""Places of chunks, points of their cores, points with the buffer."""

TOGETHER = 1_000_000
"""Pairs of a chunk and a tile after which an estimate sums up: 24 MB, however many there are."""


@dataclass(frozen=True, slots=True)
class ChunkEstimate:
    """What the headers let expect of one chunk; its place is worked out when asked for, a plan may have a million."""

    grid: ChunkGrid
    ix: int
    iy: int
    points: float
    loaded: float

    @property
    def id(self) -> str:
        """The chunk's id."""
        return self.grid.chunk(self.ix, self.iy).id

    @property
    def core(self) -> Rect:
        """The chunk's core."""
        return self.grid.chunk(self.ix, self.iy).core


class ChunkEstimates:
    """The chunks of a plan, 24 bytes each.

    Attributes
    ----------
    points, loaded : ndarray of float64, shape (n,)
        Eligible points expected in the cores, and with the buffer around them.
    """

    def __init__(self, grid: ChunkGrid, places: Int64, points: Float, loaded: Float) -> None:
        self._grid, self._places, self.points, self.loaded = grid, places, points, loaded

    def __iter__(self) -> Iterator[ChunkEstimate]:
        for ix, iy, n, loaded in zip(*columns_and_rows(self._places), self.points, self.loaded, strict=True):
            yield ChunkEstimate(self._grid, int(ix), int(iy), float(n), float(loaded))

    def __len__(self) -> int:
        return len(self._places)


def eligible(tile: Tile, last: bool) -> float:
    """Points a tile offers: last and only returns are as many as the pulses, which the header counts."""
    pulses = tile.first_returns
    return float(pulses if last and 0 < pulses < tile.point_count else tile.point_count)


def estimate(survey: Survey, grid: ChunkGrid, buffer: int, last: bool) -> ChunkEstimates:
    """Spread each tile's points evenly over its bounds, and again over the bounds grown by the buffer."""
    rows: list[Spread] = [(np.empty(0, np.int64), np.empty(0), np.empty(0))]
    waiting = 0
    for tile in survey.tiles:
        rows.append(_spread(tile.bounds, eligible(tile, last), grid, buffer))
        waiting += len(rows[-1][0])
        if waiting > TOGETHER:
            rows, waiting = [_united(rows)], 0
    where, points, loaded = _united(rows)
    order = np.lexsort((where, -loaded))
    order = order[points[order] > 0]
    return ChunkEstimates(grid, where[order], points[order], loaded[order])


def _spread(bounds: Rect, points: float, grid: ChunkGrid, buffer: int) -> Spread:
    """Spread points evenly over a rectangle; return the chunks around it, their points, and those with the buffer."""
    x0, x1 = bounds.x0 - buffer, bounds.x1 + buffer
    y0, y1 = bounds.y0 - buffer, bounds.y1 + buffer
    ix = np.arange(x0 // grid.size, -(-x1 // grid.size))
    iy = np.arange(y0 // grid.size, -(-y1 // grid.size))
    per_area = points / max(bounds.width * bounds.height, 1)

    def shared(grow: int) -> Float:
        wide = _overlap(ix * grid.size - grow, grid.size + 2 * grow, bounds.x0, bounds.x1)
        high = _overlap(iy * grid.size - grow, grid.size + 2 * grow, bounds.y0, bounds.y1)
        found: Float = ((per_area * wide)[:, np.newaxis] * high).reshape(-1)
        return found

    return places(np.repeat(ix, len(iy)), np.tile(iy, len(ix))), shared(0), shared(buffer)


def _overlap(begin: Int64, length: int, first: int, last: int) -> Float:
    """Return how much of each interval lies between two ends."""
    shared: Float = np.maximum(np.minimum(begin + length, last) - np.maximum(begin, first), 0).astype(np.float64)
    return shared


def _united(rows: list[Spread]) -> Spread:
    """Sum up what belongs to the same chunk."""
    every, points, loaded = (np.concatenate(column) for column in zip(*rows, strict=True))
    found, row = np.unique(every, return_inverse=True)
    sums = [np.bincount(row, values, len(found)).astype(np.float64) for values in (points, loaded)]
    return found, sums[0], sums[1]
