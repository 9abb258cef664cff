"""Points under the forest canopy (section 2.3, Eq. 1)."""

from __future__ import annotations

import numpy as np
from numba import njit

from ppdf_dask.filters.cloud import Bools, Cloud, Ints
from ppdf_dask.filters.ppdf.paper.squares import Longs, Squares, cut_by_edge


def under_canopy(cloud: Cloud, squares: Squares, cell: int, height: int) -> tuple[Bools, Bools]:
    """Find the points that lie less than `height` above the lowest point of their absolute cell.

    Parameters
    ----------
    cloud : Cloud
        Gives the origin and the known area.
    squares : Squares
        Its points, sorted.
    cell, height : int
        Edge of the cells and strict limit of the height difference, mm.

    Returns
    -------
    under : ndarray of bool, shape (n,)
        In the order of `squares`; at least one point of each occupied cell.
    undecided : ndarray of bool, shape (n,)
        True in the cells cut by the edge of the known area, whose lowest point may lie outside.

    Notes
    -----
    Cai, Liang, Yu 2023, section 2.3: fixed cells, not a moving window ("the lowest points in each cell").

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> from ppdf_dask.filters.ppdf.paper.squares import sort_by_square
    >>> cloud = cloud_from_xyz([[0.1, 0, 100.0], [0.2, 0, 104.999], [0.3, 0, 105.0], [2.1, 0, 130.0]])
    >>> under_canopy(cloud, sort_by_square(cloud, 10_000), 2000, 5000)[0].tolist()
    [True, True, False, True]
    """
    i = (squares.x.astype(np.int64) + cloud.origin[0]) // cell
    j = (squares.y.astype(np.int64) + cloud.origin[1]) // cell
    if len(i) == 0:
        return np.empty(0, bool), np.empty(0, bool)
    key = (i - i.min()) * (int(j.max()) - int(j.min()) + 1) + (j - j.min())
    return _below(np.argsort(key), key, squares.z, height), cut_by_edge(cloud, i, j, cell)


@njit(nogil=True, cache=True)
def _below(order: Longs, key: Longs, z: Ints, height: int) -> Bools:
    under = np.empty(len(z), np.bool_)
    first = 0
    while first < len(order):
        last, lowest = first, np.int64(z[order[first]])
        while last < len(order) and key[order[last]] == key[order[first]]:
            lowest = min(lowest, np.int64(z[order[last]]))
            last += 1
        for k in range(first, last):
            under[order[k]] = z[order[k]] - lowest < height
        first = last
    return under
