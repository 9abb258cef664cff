"""Ground points to the blocks of one global raster, each block provably the same however the survey was cut.

The raster
    Pixels are squares (pixel is area) whose edges lie at absolute multiples of the resolution, a whole number of
    millimetres. Rows count *downward* as in an array with north up: pixel (row, column) covers
    ``column * r <= x < (column + 1) * r`` and ``-(row + 1) * r <= y < -row * r``; its height is that of its centre.
    A `Block` is a square of `BLOCK` pixels; block (row, column) starts at pixel (row * BLOCK, column * BLOCK).

The surface
    The Delaunay triangulation of all ground points (of several at one place the lowest) is unique, ties included
    (`_delaunay`). A triangle counts when its longest edge and the radius of its circle are at most `max_edge`;
    a pixel takes the height of the counting triangle that holds its centre, else NaN. The rule for the radius is what
    makes the question local: along a shore or the survey's edge a flat triangle of short edges may have a circle of
    kilometres, and then whether it is Delaunay at all would be decided kilometres away.

The proof
    Let L be the limit and W the area whose points are loaded. A triangle whose circle lies in W (or beyond the survey's
    extent, which is known to be empty) is Delaunay among the loaded points exactly when it is among all points, for
    only points in the circle could object, and those on it, which decide ties, are known too. A triangle that counts
    and holds pixel p has its whole circle within 2 L of p. So once W holds the surroundings of 2 L of p, its counting
    triangles are the global ones. Most pixels need less: if the circles of all local triangles that hold p lie in W,
    these are global triangles, and their verdict, height or NaN, stands. `rasterize_block` starts with a small margin,
    lets the kernels collect the area that each pixel still asks for, loads it and looks again until nothing is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppdf_dask._delaunay import Triangulation
from ppdf_dask._scan import crop, distances, heights
from ppdf_dask.errors import ParameterError, PlanError
from ppdf_dask.grid import MM, Rect
from ppdf_dask.params import DtmParams

BLOCK = 512
"""Pixels along a block's edge; a block is one Zarr shard with one writer."""

MAX_PIXELS = 40_000_000_000
"""A raster with more pixels is refused: a stray point, not a survey, makes such an extent."""

FIRST_MARGIN = 16 * MM
"""First guess of the margin, mm: in forest it is about what gaps in the ground ask for; see `rasterize_block`."""

WINDOW = 512 * MM
"""A block is worked on in windows of at most this edge, mm, so that coarse pixels do not ask for more memory."""

MAX_POINTS = 3_000_000
"""A window with more points is cut in four: 100 bytes per point are needed."""


@dataclass(frozen=True)
class Part:
    """Ground points counted from a place of their own: `points` (3, n) int32, mm, x and y from (`x`, `y`)."""

    x: int
    y: int
    points: NDArray[np.int32]

    @classmethod
    def of(cls, points: NDArray[Any]) -> Part:
        """Make a part of absolute points, mm, (n, 3)."""
        x, y = (int(v) for v in points[:, :2].min(axis=0)) if len(points) else (0, 0)
        return cls(x, y, np.ascontiguousarray((points - [x, y, 0]).T, dtype=np.int32))


Load = Callable[[Rect], Iterable[Part]]
"""Gives parts that hold at least the ground points inside a rectangle."""


@dataclass(frozen=True, order=True, slots=True)
class Block:
    """A square of `BLOCK` x `BLOCK` pixels; `row` counts downward, `col` to the right, from absolute zero."""

    row: int
    col: int
    rect: Rect

    @property
    def id(self) -> str:
        """A name for a place: ``b_m0106_0014``; an ``m`` marks a negative index."""
        return "b_" + "_".join(f"{i:04d}" if i >= 0 else f"m{-i:04d}" for i in (self.row, self.col))


@dataclass(frozen=True)
class DtmGrid:
    """The global raster of one resolution.

    Parameters
    ----------
    resolution : int
        Pixel size, mm.

    Examples
    --------
    >>> grid = DtmGrid.from_params(DtmParams(resolution=0.5))
    >>> grid.block(-1, 2).rect
    Rect(x0=512000, y0=0, x1=768000, y1=256000)
    >>> [b.id for b in grid.over(Rect(255_999, 255_999, 256_001, 256_001))]
    ['b_m0002_0000', 'b_m0002_0001', 'b_m0001_0000', 'b_m0001_0001']
    """

    resolution: int

    @classmethod
    def from_params(cls, params: DtmParams) -> DtmGrid:
        """Make the raster of the parameters' resolution, which must be a whole number of millimetres."""
        return cls(_millimetres(params.resolution, "resolution"))

    def block(self, row: int, col: int) -> Block:
        """Return the block of this row (counted downward) and column."""
        s = self.resolution * BLOCK
        return Block(row, col, Rect(col * s, -(row + 1) * s, (col + 1) * s, -row * s))

    def over(self, rect: Rect) -> Iterator[Block]:
        """Yield the blocks that share a point with `rect`, row by row from the north."""
        raster = Raster.over(self, rect)
        for row in range(raster.row, raster.row + raster.rows):
            for col in range(raster.col, raster.col + raster.cols):
                yield self.block(row, col)


@dataclass(frozen=True)
class Raster:
    """The part of the global raster that a survey occupies: whole blocks, upper left block (`row`, `col`).

    Examples
    --------
    >>> raster = Raster.over(DtmGrid(1000), Rect(1_000, 1_000, 600_000, 2_000))
    >>> raster.shape, raster.rect.metres()
    ((512, 1024), (0.0, 0.0, 1024.0, 512.0))
    >>> raster.offset(DtmGrid(1000).block(-1, 1))
    (0, 512)
    """

    grid: DtmGrid
    row: int
    col: int
    rows: int
    cols: int

    @classmethod
    def over(cls, grid: DtmGrid, rect: Rect) -> Raster:
        """Return the smallest raster of whole blocks around `rect`.

        Raises
        ------
        PlanError
            If it had more than `MAX_PIXELS` pixels.
        """
        s = grid.resolution * BLOCK
        snapped = rect.snap(s)
        rows, cols = snapped.height // s, snapped.width // s
        if rows * cols * BLOCK * BLOCK > MAX_PIXELS:
            x0, y0, x1, y1 = rect.metres()
            raise PlanError(
                f"the terrain model of x {x0:.0f} to {x1:.0f} m, y {y0:.0f} to {y1:.0f} m would have "
                f"{rows * cols * BLOCK * BLOCK:.2g} pixels of {grid.resolution / MM} m, more than {MAX_PIXELS:.2g}; "
                "look for a stray tile or point far from the others, or choose a coarser --resolution"
            )
        return cls(grid, -snapped.y1 // s, snapped.x0 // s, rows, cols)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns in pixels."""
        return self.rows * BLOCK, self.cols * BLOCK

    @property
    def rect(self) -> Rect:
        """The area covered, mm."""
        s = self.grid.resolution * BLOCK
        return Rect(self.col * s, -(self.row + self.rows) * s, (self.col + self.cols) * s, -self.row * s)

    def offset(self, block: Block) -> tuple[int, int]:
        """Return the array row and column of a block's upper left pixel."""
        return (block.row - self.row) * BLOCK, (block.col - self.col) * BLOCK

    def centres(self, unit_xy: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pixel centres (x ascending, y descending) in units of `unit_xy` metres, the CRS's own."""
        r, rect = self.grid.resolution, self.rect
        x = (2 * (rect.x0 + r * np.arange(self.shape[1], dtype=np.int64)) + r) / (2 * MM * unit_xy)
        y = (2 * (rect.y1 - r * np.arange(self.shape[0], dtype=np.int64)) - r) / (2 * MM * unit_xy)
        return x, y


@dataclass(frozen=True)
class BlockResult:
    """One block of the terrain model; arrays are north up, (`BLOCK`, `BLOCK`) float32.

    Parameters
    ----------
    height : ndarray
        Height of the ground in the survey's vertical unit, NaN where nothing is known.
    distance : ndarray
        Metres from the pixel's centre to the nearest ground point in the plane: exact up to `max_edge` (`fill_edge`
        where that is given), inf beyond.
    filled : ndarray or None
        As `height`, with `fill_edge` in place of `max_edge`.
    points : int
        Ground points read, those read for several windows counted each time.
    margin : int
        The widest margin, mm, that the proof took.
    """

    height: NDArray[np.float32]
    distance: NDArray[np.float32]
    filled: NDArray[np.float32] | None
    points: int
    margin: int


@dataclass(frozen=True)
class _Window:
    """Pixels of a block: rows r0..r1 and columns c0..c1, half-open, and the area they cover."""

    r0: int
    r1: int
    c0: int
    c1: int
    rect: Rect


def rasterize_block(
    block: Block,
    load: Load,
    params: DtmParams,
    *,
    extent: Rect | None = None,
    unit_z: float = 1.0,
    first_margin: int | None = None,
) -> BlockResult:
    """Interpolate one block of the terrain model.

    Parameters
    ----------
    block : Block
        The block; see `DtmGrid`.
    load : callable
        ``load(rect)`` gives parts with all ground points with ``x0 <= x < x1`` and ``y0 <= y < y1``, in any order,
        others too if that is easier; it is called with rectangles in and around the block, up to 2 `max_edge` away.
    params : DtmParams
        Resolution and limits, metres.
    extent : Rect, optional
        Where ground can be at all; outside is known to be empty. None: nothing is known.
    unit_z : float
        Metres per unit of the heights that are returned, for surveys in feet.
    first_margin : int, optional
        First guess of the margin, mm; it changes the time, never the result. Default: 16 m, and at least 8 pixels.

    Returns
    -------
    BlockResult
        Heights, distances and what the proof took.

    Raises
    ------
    ParameterError
        If a length is not a whole number of millimetres.

    Examples
    --------
    >>> points = np.array([[0, 0, 1000], [100_000, 0, 1000], [0, 100_000, 2000], [100_000, 100_000, 2000]])
    >>> grid = DtmGrid.from_params(DtmParams(max_edge=150.0))
    >>> result = rasterize_block(grid.block(-1, 0), lambda rect: [Part.of(points)], DtmParams(max_edge=150.0))
    >>> float(result.height[511, 0]), float(result.height[511 - 99, 99]), float(result.height[0, 0])
    (1.0049999952316284, 1.9950000047683716, nan)
    """
    limits = [_millimetres(params.max_edge, "max_edge")]
    if params.fill_edge is not None:
        limits.append(_millimetres(params.fill_edge, "fill_edge"))
    resolution = DtmGrid.from_params(params).resolution
    if first_margin is None:
        first_margin = max(FIRST_MARGIN, 8 * resolution)
    layers = np.full((len(limits), BLOCK, BLOCK), np.nan, dtype=np.float32)
    distance = np.empty((BLOCK, BLOCK), dtype=np.float32)
    points, margin = 0, 0
    todo = _windows(block, resolution, max(1, WINDOW // resolution))
    while todo:
        window = todo.pop()
        loaded = window.rect.grow(min(first_margin, 2 * limits[-1]))
        tin = _Tin(window.rect, limits[-1], first_margin)
        cloud = tin.localise(load(loaded), loaded)
        side = max(window.r1 - window.r0, window.c1 - window.c0)
        if len(cloud) > MAX_POINTS and side > 1:
            todo += _windows(block, resolution, -(-side // 2), window)
            continue
        tin.insert(cloud)
        z, d, loaded = _prove(tin, window, load, loaded, (resolution, limits, extent))
        layers[:, window.r0 : window.r1, window.c0 : window.c1] = z / (MM * unit_z)
        distance[window.r0 : window.r1, window.c0 : window.c1] = d / MM
        points += tin.points
        margin = max(margin, *(abs(a) for a in _sides(loaded, window.rect)))
    return BlockResult(layers[0], distance, layers[1] if len(limits) > 1 else None, points, margin)


def _millimetres(metres: float, name: str) -> int:
    value = round(metres * MM)
    if abs(value - metres * MM) > 1e-6 or value < 1:
        raise ParameterError(f"{name} = {metres} m is not a whole number of millimetres; the grid of all jobs is 1 mm")
    return value


def _windows(block: Block, resolution: int, side: int, inside: _Window | None = None) -> list[_Window]:
    """Cut a block, or a window of it, into windows of at most `side` pixels along an edge."""
    r0, r1, c0, c1 = (0, BLOCK, 0, BLOCK) if inside is None else (inside.r0, inside.r1, inside.c0, inside.c1)
    windows = []
    for r in range(r0, r1, side):
        for c in range(c0, c1, side):
            re, ce = min(r + side, r1), min(c + side, c1)
            x, y = block.rect.x0, block.rect.y1
            rect = Rect(x + c * resolution, y - re * resolution, x + ce * resolution, y - r * resolution)
            windows.append(_Window(r, re, c, ce, rect))
    return windows


def _sides(outer: Rect, inner: Rect) -> tuple[int, int, int, int]:
    return inner.x0 - outer.x0, inner.y0 - outer.y0, outer.x1 - inner.x1, outer.y1 - inner.y1


class _Tin:
    """A window's triangulation, with coordinates counted from the window's centre."""

    def __init__(self, rect: Rect, limit: int, margin: int) -> None:
        self.x, self.y = (rect.x0 + rect.x1) // 2, (rect.y0 + rect.y1) // 2
        self.points = 0
        # The corners must lie outside every circle that counts and every disk of the distance: 2 limits from a pixel.
        self._mesh = Triangulation(max(rect.width, rect.height) // 2 + max(2 * limit, margin) + MM)

    @property
    def arrays(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        return self._mesh.vertices, self._mesh.triangles

    def localise(self, parts: Iterable[Part], inside: Rect) -> NDArray[np.int32]:
        """Return those of the points that lie inside a rectangle, from the window's centre."""
        box, pieces = self.box(inside), [np.empty((0, 3), dtype=np.int32)]
        for part in parts:
            # As large as if all were inside: what is never written costs nothing. Piece by piece, so that a loader need
            # not keep all its parts at once.
            piece = np.empty((part.points.shape[1], 3), dtype=np.int32)
            pieces.append(piece[: crop(part.points, part.x - self.x, part.y - self.y, box, piece)])
        return np.concatenate(pieces)

    def insert(self, local: NDArray[np.int32]) -> None:
        """Insert points counted from the window's centre."""
        self.points += len(local)
        self._mesh.insert(local)

    def box(self, rect: Rect) -> NDArray[np.int64]:
        """Return a half-open rectangle as a closed box (x0, y0, x1, y1) around the window's centre."""
        return np.array([rect.x0 - self.x, rect.y0 - self.y, rect.x1 - 1 - self.x, rect.y1 - 1 - self.y], np.int64)

    def rect(self, box: NDArray[np.int64]) -> Rect:
        """Return the rectangle of a closed box."""
        x0, y0, x1, y1 = (int(v) for v in box)
        return Rect(x0 + self.x, y0 + self.y, x1 + 1 + self.x, y1 + 1 + self.y)


def _prove(
    tin: _Tin, window: _Window, load: Load, loaded: Rect, rules: tuple[int, list[int], Rect | None]
) -> tuple[NDArray[np.float64], NDArray[np.float64], Rect]:
    """Widen the loaded area until no pixel asks for more; return heights and distances, mm, and that area."""
    resolution, limits, extent = rules
    shape = (window.r1 - window.r0, window.c1 - window.c0)
    first = np.array(
        [2 * (window.rect.x0 - tin.x) + resolution, 2 * (window.rect.y1 - tin.y) - resolution], dtype=np.int64
    )
    everywhere = window.rect.grow(4 * limits[-1])
    known = tin.box(everywhere if extent is None else extent)
    home = np.empty(shape, np.int32)
    while True:
        z = np.full((len(limits), *shape), np.nan)
        d = np.full(shape, np.inf)
        need = tin.box(window.rect)
        heights(*tin.arrays, first, 2 * resolution, np.array(limits, np.int64), known, z, home, need)
        if loaded.contains(tin.rect(need)):
            distances(*tin.arrays, home, first, 2 * resolution, limits[-1], known, d, need)
            if loaded.contains(tin.rect(need)):
                return z, d, loaded
        wider = loaded.union(tin.rect(need))
        for strip in _difference(wider, loaded):
            tin.insert(tin.localise(load(strip), strip))
        loaded = wider


def _difference(outer: Rect, inner: Rect) -> Iterator[Rect]:
    """Yield up to four rectangles that make up `outer` without `inner`, which lies inside."""
    strips = (
        Rect(outer.x0, outer.y0, outer.x1, inner.y0),
        Rect(outer.x0, inner.y1, outer.x1, outer.y1),
        Rect(outer.x0, inner.y0, inner.x0, inner.y1),
        Rect(inner.x1, inner.y0, outer.x1, inner.y1),
    )
    return (s for s in strips if s.width > 0 and s.height > 0)
