"""The cloud in one order that no cut can change: by absolute square, then x, y, z."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Bools, Cloud, Ints

Longs = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Squares:
    """Points sorted by the absolute square they lie in, inside a square by (x, y, z).

    Attributes
    ----------
    order : ndarray of int64, shape (n,)
        Index in the cloud of each sorted point.
    x, y, z : ndarray of int32, shape (n,)
        The cloud's coordinates, sorted, mm.
    edge : int
        Edge of the squares, mm.
    ix, iy : ndarray of int64, shape (m,)
        Absolute address of each occupied square: it covers ``ix * edge <= x < (ix + 1) * edge`` in absolute mm.
    starts : ndarray of int64, shape (m + 1,)
        Sorted points ``starts[k]`` to ``starts[k + 1] - 1`` lie in square k.
    """

    order: Longs
    x: Ints
    y: Ints
    z: Ints
    edge: int
    ix: Longs
    iy: Longs
    starts: Longs

    def places(self) -> Ints:
        """Return a number from 0 for each distinct (x, y, z): int32 (n,), ascending, equal for exact duplicates."""
        fresh = np.ones(len(self.x), bool)
        fresh[1:] = np.diff(self.x) != 0
        fresh[1:] |= np.diff(self.y) != 0
        fresh[1:] |= np.diff(self.z) != 0
        return np.cumsum(fresh, dtype=np.int32) - np.int32(1)


def sort_by_square(cloud: Cloud, edge: int) -> Squares:
    """Sort a cloud by absolute squares of `edge` mm.

    Parameters
    ----------
    cloud : Cloud
        Any points in any order.
    edge : int
        Edge of the squares, mm.

    Returns
    -------
    Squares
        Memory goes with the points, never with the extent, however far apart they lie.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> squares = sort_by_square(cloud_from_xyz([[11, 1, 0], [3, 2, 1], [3, 1, 1]]), 10_000)
    >>> squares.order.tolist(), squares.ix.tolist(), squares.starts.tolist()
    ([2, 1, 0], [0, 1], [0, 2, 3])
    """
    ix, dx = np.divmod(cloud.x.astype(np.int64) + cloud.origin[0], edge)
    iy, dy = np.divmod(cloud.y.astype(np.int64) + cloud.origin[1], edge)
    order = _order(ix, iy, dx, dy, cloud.z, edge)
    del dx, dy
    ix, iy = ix[order], iy[order]
    fresh = np.flatnonzero((np.diff(ix) != 0) | (np.diff(iy) != 0)) + 1
    first = np.concatenate([np.zeros(min(1, cloud.n), np.int64), fresh])
    starts = np.append(first, cloud.n)
    return Squares(order, cloud.x[order], cloud.y[order], cloud.z[order], edge, ix[first], iy[first], starts)


def _order(ix: Longs, iy: Longs, dx: Longs, dy: Longs, z: Ints, edge: int) -> Longs:
    """Order by (ix, iy, x, y, z): through one integer key where the extent lets it fit, several times as fast."""
    if len(ix) == 0:
        return np.empty(0, np.int64)
    columns, rows = (int(i.max()) - int(i.min()) + 1 for i in (ix, iy))
    if columns * rows * edge * edge >= 2**63:
        return np.lexsort((z, dy, dx, iy, ix))
    key = ((((ix - ix.min()) * rows + (iy - iy.min())) * edge) + dx) * edge + dy
    order = np.argsort(key)
    key = key[order]
    # Points of one (x, y) are few: only they need the third coordinate.
    same = key[1:] == key[:-1]
    tied = np.zeros(len(key), bool)
    tied[1:] = same
    tied[:-1] |= same
    at = np.flatnonzero(tied)
    part = order[at]
    order[at] = part[np.lexsort((z[part], key[at]))]
    return order


def cut_by_edge(cloud: Cloud, ix: Longs, iy: Longs, edge: int) -> Bools:
    """Tell which absolute cells of `edge` mm reach outside the area the cloud knows: bool, shaped as `ix`."""
    known = cloud.known
    if known is None:
        return np.zeros(len(ix), bool)
    left, bottom = ix * edge, iy * edge
    return (left < known.x0) | (bottom < known.y0) | (left + edge > known.x1) | (bottom + edge > known.y1)
