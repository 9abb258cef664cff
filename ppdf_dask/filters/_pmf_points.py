"""PMF on the points themselves, without a raster between: squares centred on every point, as in the PCL.

The squares are searched through absolute cells. Whole cells inside a square are looked up as one block, in a raster of
the extremes of all blocks of that size; of the cells that the square's edge cuts only those are opened whose extreme
would matter. That changes the speed, not the answer: it is the lowest, and then the highest, of the points inside.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import minimum_filter1d

from ppdf_dask.filters.cloud import Bools, Cloud
from ppdf_dask.filters.raster import EMPTY, Raster, lowest, rasterize

Doubles = npt.NDArray[np.float64]


def below(cloud: Cloud, cell: float, steps: list[tuple[int, float]]) -> Bools:
    """Tell which points stay below every opened surface, each surface made of the points that were left.

    Parameters
    ----------
    cloud : Cloud
        All points shape the surfaces.
    cell : float
        Edge of the cells, m.
    steps : list of (int, float)
        Half width of the window in cells, less half a cell, and the height tolerance in mm, window by window.

    Returns
    -------
    ndarray of bool, shape (cloud.n_core,)
        True where ``z - opened < tolerance`` in every window.
    """
    raster = rasterize(cloud, cell)
    order = np.argsort(raster.cell, kind="stable")
    corner = cloud.origin[0] - raster.column * raster.step, cloud.origin[1] - raster.row * raster.step
    x, y = cloud.x[order].astype(np.int64) + corner[0], cloud.y[order].astype(np.int64) + corner[1]
    z, of = cloud.z[order], raster.cell[order]
    for radius, tolerance in steps:
        width = (2 * radius + 1) * raster.step
        eroded = _extreme(x, y, z, of, raster, width, 2 * radius)
        opened = -_extreme(x, y, -eroded, of, raster, width, 2 * radius)
        keep = z - opened < tolerance
        order, x, y, z, of = order[keep], x[keep], y[keep], z[keep], of[keep]
    ground = np.zeros(cloud.n, np.bool_)
    ground[order] = True
    return ground[: cloud.n_core]


def _extreme(
    x: npt.NDArray[np.int64],
    y: npt.NDArray[np.int64],
    values: npt.NDArray[np.int32],
    of: npt.NDArray[np.int32],
    raster: Raster,
    width: int,
    size: int,
) -> npt.NDArray[np.int32]:
    """Return the lowest value in the closed square of `width` mm around each point; `size` cells always fit inside."""
    rows, columns = raster.shape
    low = lowest(Raster(raster.step, raster.column, raster.row, raster.shape, of), values)
    # A block's value stands at its first cell; a frame holds the blocks that begin outside the raster.
    framed = np.full((rows + 2 * size, columns + 2 * size), EMPTY, np.int32)
    framed[size : size + rows, size : size + columns] = low
    blocks = framed
    for axis in (0, 1):
        blocks = minimum_filter1d(blocks, size, axis=axis, mode="constant", cval=EMPTY, origin=-(size // 2))
    starts = np.searchsorted(of, np.arange(rows * columns + 1))
    out = np.empty(len(values), np.int32)
    _squares(x, y, values, starts, low, blocks, raster.step, width, size, out)
    return out


@njit(nogil=True, cache=True)
def _squares(x, y, values, starts, low, blocks, step, width, size, out):  # type: ignore[no-untyped-def]
    rows, columns = low.shape
    half = width // 2
    for k in range(len(values)):
        # The closed square holds 2 |dx| <= width: for an odd width of w mm the integers |dx| <= (w - 1) / 2.
        left, right, bottom, top = x[k] - half, x[k] + half, y[k] - half, y[k] + half
        c, r = -(-left // step), -(-bottom // step)
        best = blocks[r + size, c + size]
        for rr in range(max(0, bottom // step), min(rows - 1, top // step) + 1):
            inside = r <= rr < r + size
            cc = max(0, left // step)
            last = min(columns - 1, right // step)
            while cc <= last:
                if inside and c <= cc < c + size:
                    cc = c + size
                    continue
                if low[rr, cc] < best:
                    for j in range(starts[rr * columns + cc], starts[rr * columns + cc + 1]):
                        if values[j] < best and left <= x[j] <= right and bottom <= y[j] <= top:
                            best = values[j]
                cc += 1
        out[k] = best
