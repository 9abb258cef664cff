"""Pure geometry: the job grid, rectangles, chunks.

Every length inside the package is an integer number of millimetres on **one grid for all jobs, anchored at absolute
zero**. A coordinate is rounded to that grid once, when a point is decoded; from then on all arithmetic is exact, so two
files with different scales and offsets agree to the last bit and nothing depends on where a survey was cut. (Written
tiles keep their own integers: the grid serves the decision only.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from ppdf_dask.errors import ParameterError

MM = 1000
"""Grid steps per metre."""

DENSITY_CELL = 5 * MM
"""Edge of the absolute cells over which the point density is counted; chunk edges are multiples of it."""


@dataclass(frozen=True, order=True, slots=True)
class Rect:
    """A half-open rectangle in absolute millimetres: ``x0 <= x < x1`` and ``y0 <= y < y1``."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        """Extent along x, mm."""
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        """Extent along y, mm."""
        return self.y1 - self.y0

    def grow(self, by: int) -> Rect:
        """Return the rectangle widened by `by` mm on each side."""
        return Rect(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)

    def snap(self, step: int) -> Rect:
        """Return the smallest rectangle around this one with edges at multiples of `step` mm."""
        return Rect(
            self.x0 // step * step,
            self.y0 // step * step,
            -(-self.x1 // step) * step,
            -(-self.y1 // step) * step,
        )

    def intersects(self, other: Rect) -> bool:
        """Tell whether the two share a point."""
        return self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1

    def contains(self, other: Rect) -> bool:
        """Tell whether `other` lies inside, edges included."""
        return self.x0 <= other.x0 and self.y0 <= other.y0 and other.x1 <= self.x1 and other.y1 <= self.y1

    def union(self, other: Rect) -> Rect:
        """Return the bounding box of both."""
        return Rect(min(self.x0, other.x0), min(self.y0, other.y0), max(self.x1, other.x1), max(self.y1, other.y1))

    def metres(self) -> tuple[float, float, float, float]:
        """Return ``(x0, y0, x1, y1)`` in metres."""
        return self.x0 / MM, self.y0 / MM, self.x1 / MM, self.y1 / MM


@dataclass(frozen=True, order=True, slots=True)
class Chunk:
    """A unit of work: the square of a `ChunkGrid` with column `ix` and row `iy`."""

    ix: int
    iy: int
    core: Rect

    @property
    def id(self) -> str:
        """A name that sorts and names a place: ``c_0500_5400``; an ``m`` marks a negative index."""
        return chunk_id(self.ix, self.iy)


def chunk_id(ix: int, iy: int) -> str:
    """Return the id of the chunk of column `ix` and row `iy`."""
    return f"c_{_label(ix)}_{_label(iy)}"


def _label(i: int) -> str:
    return f"{i:04d}" if i >= 0 else f"m{-i:04d}"


def parse_id(chunk: str) -> tuple[int, int]:
    """Return column and row of the chunk with this id.

    Examples
    --------
    >>> parse_id(chunk_id(12, -34))
    (12, -34)
    """
    try:
        kind, a, b = chunk.split("_")
        if kind != "c":
            raise ValueError(kind)
        ix, iy = (-int(t[1:]) if t.startswith("m") else int(t) for t in (a, b))
    except ValueError:
        raise ParameterError(f"{chunk!r} is not a chunk id; one looks like c_0012_0034") from None
    return ix, iy


@dataclass(frozen=True)
class ChunkGrid:
    """Squares of `size` mm anchored at absolute multiples of `size`.

    Examples
    --------
    >>> grid = ChunkGrid.from_metres(250.0)
    >>> grid.at(1_000_000, -1).id
    'c_0004_m0001'
    >>> [c.id for c in grid.over(Rect(0, 0, 250_001, 10))]
    ['c_0000_0000', 'c_0001_0000']
    """

    size: int

    @classmethod
    def from_metres(cls, size: float) -> ChunkGrid:
        """Make a grid of `size` metres, rounded up to a multiple of 5 m so that a density cell has one owner."""
        if not (math.isfinite(size) and size > 0):
            raise ParameterError(f"chunk_size = {size} m must be a positive number of metres")
        return cls(math.ceil(round(size * MM, 3) / DENSITY_CELL) * DENSITY_CELL)

    def chunk(self, ix: int, iy: int) -> Chunk:
        """Return the chunk of column `ix` and row `iy`."""
        s = self.size
        return Chunk(ix, iy, Rect(ix * s, iy * s, (ix + 1) * s, (iy + 1) * s))

    def at(self, x: int, y: int) -> Chunk:
        """Return the one chunk that owns the place (`x`, `y`), mm."""
        return self.chunk(x // self.size, y // self.size)

    def parse(self, chunk: str) -> Chunk:
        """Return the chunk with this id."""
        return self.chunk(*parse_id(chunk))

    def over(self, rect: Rect) -> Iterator[Chunk]:
        """Yield the chunks that share a point with `rect`, ordered by column and row."""
        s = self.size
        for ix in range(rect.x0 // s, -(-rect.x1 // s)):
            for iy in range(rect.y0 // s, -(-rect.y1 // s)):
                yield self.chunk(ix, iy)
