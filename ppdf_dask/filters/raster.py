"""Rasters of lowest points at absolute cells, and the morphology that the raster filters share.

Cells are half-open and anchored at absolute multiples of their edge, never at the cloud's corner, so that they do not
move when the cloud is cut. Heights are millimetres; means of eight of them are exact in float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from numba import njit

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters.cloud import Cloud, Ints
from ppdf_dask.grid import MM

Heights = npt.NDArray[np.float64]

MAX_CELLS = 60_000_000
"""Most cells of one raster: 7.7 km x 7.7 km at 1 m; some 2 GB for the filters' handful of rasters."""

NEARBY = 12
"""Radius, in cells, within which a gap's neighbours are looked up ring by ring; wider gaps are searched by rows."""

EMPTY = np.iinfo(np.int32).max
"""Marks a cell without points in a raster of integer heights."""


@dataclass(frozen=True)
class Raster:
    """Absolute cells over a cloud's bounding box.

    Attributes
    ----------
    step : int
        Edge of a cell, mm.
    column, row : int
        Absolute number of the first column and row: the cell covers ``column * step <= x < (column + 1) * step``.
    shape : tuple of int
        Rows (along y), columns (along x).
    cell : ndarray of int32, shape (cloud.n,)
        Each point's cell as a flat row-major index.
    """

    step: int
    column: int
    row: int
    shape: tuple[int, int]
    cell: Ints


def rasterize(cloud: Cloud, size: float) -> Raster:
    """Lay absolute cells of `size` metres (rounded to the millimetre) over a cloud that is not empty.

    Raises
    ------
    ParameterError
        When the raster would exceed `MAX_CELLS`.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> raster = rasterize(cloud_from_xyz([[0.5, 0.5, 9], [0.9, 0.1, 8], [2.5, 1.5, 7]]), 1.0)
    >>> raster.shape, raster.cell.tolist()
    ((2, 3), [0, 0, 5])
    """
    step = max(1, round(size * MM))
    spans = []
    for values, origin in zip((cloud.x, cloud.y), cloud.origin, strict=True):
        first = (int(values.min()) + origin) // step
        spans.append((first, (int(values.max()) + origin) // step - first + 1))
    (column, columns), (row, rows) = spans
    check_cells(columns, rows, size)
    cell = np.empty(cloud.n, np.int32)
    ox, oy = cloud.origin
    _cells(cloud.x, cloud.y, ox - column * step, oy - row * step, step, columns, cell)
    return Raster(step, column, row, (rows, columns), cell)


def check_cells(columns: int, rows: int, size: float, most: int = MAX_CELLS) -> None:
    """Refuse a raster of more than `most` cells with a message that names the remedy."""
    if columns * rows > most:
        raise ParameterError(
            f"a raster of {columns} x {rows} cells of {size} m exceeds the limit of {most} cells; use smaller chunks "
            "(--chunk-size) or a larger cell"
        )


def lowest(raster: Raster, z: Ints) -> Ints:
    """Return the lowest height of each cell, mm, `EMPTY` where there is no point; int32, of the raster's shape."""
    low = np.full(raster.shape[0] * raster.shape[1], EMPTY, np.int32)
    _lowest(raster.cell, z, low)
    return low.reshape(raster.shape)


def filled(heights: Heights, neighbours: int) -> Heights:
    """Fill the cells that are NaN with the mean of the nearest cells that are not.

    Parameters
    ----------
    heights : ndarray of float64, shape (rows, columns)
        Heights, NaN where empty; at least one is not NaN.
    neighbours : int
        How many cells enter the mean at least (fewer where the raster has fewer): 8 as SMRF's choice, 1 for the
        nearest. All cells as far as the last of them enter too: choosing among them by height would pull gaps on a
        slope down (or up), and by place would give them a direction.

    Returns
    -------
    ndarray of float64, shape (rows, columns)
        A copy without NaN.

    Examples
    --------
    >>> filled(np.array([[1.0, np.nan, np.nan, np.nan, 4.0]]), 1).tolist()
    [[1.0, 1.0, 2.5, 4.0, 4.0]]
    """
    rows, columns = heights.shape
    out = heights.copy()
    before = np.empty((rows, columns), np.int32)
    after = np.empty((rows, columns), np.int32)
    _filled_beside(heights, before, after)
    _fill(heights, before, after, neighbours, *_nearby(), out)
    return out


@cache
def _nearby() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Squared distance, row and column offset of the cells within `NEARBY` cells, nearest first."""
    dr, dc = (v.ravel() for v in np.mgrid[-NEARBY : NEARBY + 1, -NEARBY : NEARBY + 1].astype(np.int64))
    d2 = dr * dr + dc * dc
    order = np.lexsort((dc, dr, d2))
    order = order[(d2[order] > 0) & (d2[order] <= NEARBY * NEARBY)]
    return d2[order], dr[order], dc[order]


def eroded(heights: Heights, radius: int) -> Heights:
    """Return the lowest height within a diamond (``|dx| + |dy| <= radius`` cells), clipped at the raster's edge."""
    return -dilated(-heights, radius)


def dilated(heights: Heights, radius: int) -> Heights:
    """Return the highest height within a diamond (``|dx| + |dy| <= radius`` cells), clipped at the raster's edge.

    Examples
    --------
    >>> dilated(np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 0.0]]), 1).tolist()
    [[0.0, 5.0, 0.0], [5.0, 5.0, 5.0], [0.0, 5.0, 0.0]]
    """
    rows, columns = heights.shape
    # A frame of -inf spares the inner loop its edge cases.
    a = np.full((rows + 2, columns + 2), -np.inf)
    a[1:-1, 1:-1] = heights
    b = np.full_like(a, -np.inf)
    for _ in range(radius):
        _cross_maximum(a, b)
        a, b = b, a
    return a[1:-1, 1:-1].copy()


@njit(nogil=True, cache=True)
def _cells(x, y, dx, dy, step, columns, out):  # type: ignore[no-untyped-def]
    for k in range(len(x)):
        out[k] = (y[k] + dy) // step * columns + (x[k] + dx) // step


@njit(nogil=True, cache=True)
def _lowest(cell, z, low):  # type: ignore[no-untyped-def]
    for k in range(len(z)):
        if z[k] < low[cell[k]]:
            low[cell[k]] = z[k]


@njit(nogil=True, cache=True)
def _filled_beside(heights, before, after):  # type: ignore[no-untyped-def]
    """Column of the nearest filled cell at or left of (right of) each cell; -1 when there is none."""
    rows, columns = heights.shape
    for r in range(rows):
        last = -1
        for c in range(columns):
            if not np.isnan(heights[r, c]):
                last = c
            before[r, c] = last
        last = -1
        for c in range(columns - 1, -1, -1):
            if not np.isnan(heights[r, c]):
                last = c
            after[r, c] = last


@njit(nogil=True, cache=True)
def _offer(d2, z, wanted, ring_d2, ring_n, ring_sum, rings, total):  # type: ignore[no-untyped-def]
    """Add a cell to the rings of equal distance, nearest first; drop rings that `wanted` cells do not need.

    Returns the number of rings and of cells in them.
    """
    k = rings
    while k > 0 and ring_d2[k - 1] >= d2:
        k -= 1
    if k < rings and ring_d2[k] == d2:
        ring_n[k] += 1
        ring_sum[k] += z
    else:
        for p in range(rings, k, -1):
            ring_d2[p], ring_n[p], ring_sum[p] = ring_d2[p - 1], ring_n[p - 1], ring_sum[p - 1]
        ring_d2[k], ring_n[k], ring_sum[k] = d2, 1, z
        rings += 1
    total += 1
    while total - ring_n[rings - 1] >= wanted:
        rings -= 1
        total -= ring_n[rings]
    return rings, total


@njit(nogil=True, cache=True)
def _fill_nearby(heights, r, c, wanted, near_d2, near_r, near_c):  # type: ignore[no-untyped-def]
    """Sum and number of the nearest cells, ring by ring; the number is 0 when the offsets do not reach far enough."""
    rows, columns = heights.shape
    count = 0
    height = 0.0
    for k in range(len(near_d2)):
        if count >= wanted and near_d2[k] != near_d2[k - 1]:
            return height, count
        rr = r + near_r[k]
        cc = c + near_c[k]
        if rr >= 0 and rr < rows and cc >= 0 and cc < columns:
            z = heights[rr, cc]
            if not np.isnan(z):
                height += z
                count += 1
    return 0.0, 0


@njit(nogil=True, cache=True)
def _fill(heights, before, after, wanted, near_d2, near_r, near_c, out):  # type: ignore[no-untyped-def]
    """Fill from nearby offsets; in wide gaps search rows outward, hopping over their empty cells."""
    rows, columns = heights.shape
    ring_d2 = np.empty(wanted + 1, np.int64)
    ring_n = np.empty(wanted + 1, np.int64)
    ring_sum = np.empty(wanted + 1, np.float64)
    for r in range(rows):
        for c in range(columns):
            if not np.isnan(heights[r, c]):
                continue
            height, total = _fill_nearby(heights, r, c, wanted, near_d2, near_r, near_c)
            if total > 0:
                out[r, c] = height / total
                continue
            rings = 0
            total = 0
            for dr in range(max(r, rows - 1 - r) + 1):
                if total >= wanted and dr * dr > ring_d2[rings - 1]:
                    break
                for side in range(2):
                    rr = r - dr if side == 0 else r + dr
                    if rr < 0 or rr >= rows or (side == 1 and dr == 0):
                        continue
                    cc = before[rr, c]
                    while cc >= 0:
                        d2 = dr * dr + (c - cc) * (c - cc)
                        if total >= wanted and d2 > ring_d2[rings - 1]:
                            break
                        rings, total = _offer(d2, heights[rr, cc], wanted, ring_d2, ring_n, ring_sum, rings, total)
                        cc = before[rr, cc - 1] if cc > 0 else -1
                    cc = after[rr, c + 1] if c + 1 < columns else -1
                    while cc >= 0:
                        d2 = dr * dr + (cc - c) * (cc - c)
                        if total >= wanted and d2 > ring_d2[rings - 1]:
                            break
                        rings, total = _offer(d2, heights[rr, cc], wanted, ring_d2, ring_n, ring_sum, rings, total)
                        cc = after[rr, cc + 1] if cc + 1 < columns else -1
            for k in range(rings):
                height += ring_sum[k]
            out[r, c] = height / total


@njit(nogil=True, cache=True)
def _cross_maximum(a, b):  # type: ignore[no-untyped-def]
    rows, columns = a.shape
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            m = a[r, c]
            m = a[r - 1, c] if a[r - 1, c] > m else m
            m = a[r + 1, c] if a[r + 1, c] > m else m
            m = a[r, c - 1] if a[r, c - 1] > m else m
            m = a[r, c + 1] if a[r, c + 1] > m else m
            b[r, c] = m
