"""Kernels on columns sorted by (column, row): clusters in horizontal profiles, local medians, one dilation.

Every kernel walks the columns in order and keeps, for each neighbouring column index, a pointer that only moves
forward, so that no grid over the extent is needed.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(nogil=True, cache=True)
def _forward(ix, iy, j, i_target, j_target):  # type: ignore[no-untyped-def]
    """Return the first position from `j` on that is not before (`i_target`, `j_target`)."""
    while j < len(ix) and (ix[j] < i_target or (ix[j] == i_target and iy[j] < j_target)):
        j += 1
    return j


@numba.njit(nogil=True, cache=True)
def _root(parent, a):  # type: ignore[no-untyped-def]
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@numba.njit(nogil=True, cache=True)
def window_clusters(ix, iy, layer, cx, cy, reach, tolerance, half):  # type: ignore[no-untyped-def]
    """Cluster the centroids of each window of layers by single linkage in the plane.

    Parameters
    ----------
    ix, iy : ndarray of int64, shape (m,)
        Column and row index, sorted by both.
    layer : ndarray of int64, shape (m,)
        Layer of each centroid.
    cx, cy : ndarray of int64, shape (m,)
        Centroids, mm.
    reach : int
        Columns beyond which no centroid can lie within the tolerance.
    tolerance : int
        Two centroids of one window at most this far apart, mm, belong together.
    half : int
        A window holds the layers from ``k - half`` to ``k + half``.

    Returns
    -------
    ndarray of int64, shape (m, 2 half + 1)
        ``[i, o]``: a name of the cluster of centroid i in the window around layer ``layer[i] - half + o``. Two
        centroids have the same name in one window if and only if they belong together.
    """
    m, windows = len(ix), 2 * half + 1
    parent = np.arange(m * windows)
    ahead = np.zeros(reach + 1, np.int64)
    for i in range(m):
        for d in range(reach + 1):
            ahead[d] = i + 1 if d == 0 else _forward(ix, iy, ahead[d], ix[i] + d, iy[i] - reach)
            j = ahead[d]
            while j < m and ix[j] == ix[i] + d and iy[j] <= iy[i] + reach:
                dx, dy = cx[j] - cx[i], cy[j] - cy[i]
                if abs(layer[j] - layer[i]) <= 2 * half and dx * dx + dy * dy <= tolerance * tolerance:
                    low, high = max(layer[i], layer[j]) - half, min(layer[i], layer[j]) + half
                    for k in range(low, high + 1):
                        a = _root(parent, i * windows + k - layer[i] + half)
                        b = _root(parent, j * windows + k - layer[j] + half)
                        parent[max(a, b)] = min(a, b)
                j += 1
    for a in range(m * windows):
        parent[a] = _root(parent, a)
    return parent.reshape(m, windows)


@numba.njit(nogil=True, cache=True)
def above_neighbours(ix, iy, cx, cy, cz, kept, reach, radius, excess):  # type: ignore[no-untyped-def]
    """Find kept centroids that stand out over the median height of the kept ones around them.

    Parameters
    ----------
    ix, iy, cx, cy : ndarray of int64, shape (m,)
        As in `window_clusters`.
    cz : ndarray of int64, shape (m,)
        Heights of the centroids, mm.
    kept : ndarray of bool, shape (m,)
        Centroids that count, and that are judged.
    reach : int
        Columns beyond which no centroid can lie within the radius.
    radius : int
        Neighbours lie at most this far in the plane, mm; the centroid itself is not one of them.
    excess : int
        It stands out when it is more than this above the median, mm.

    Returns
    -------
    ndarray of bool, shape (m,)
        True where a kept centroid stands out. The median of an even number is the mean of the middle two.
    """
    m = len(ix)
    out = np.zeros(m, np.bool_)
    first = np.zeros(2 * reach + 1, np.int64)
    heights = np.empty((2 * reach + 1) ** 2, np.int64)
    for i in range(m):
        n = 0
        for d in range(-reach, reach + 1):
            first[d + reach] = _forward(ix, iy, first[d + reach], ix[i] + d, iy[i] - reach)
            j = first[d + reach]
            while j < m and ix[j] == ix[i] + d and iy[j] <= iy[i] + reach:
                dx, dy = cx[j] - cx[i], cy[j] - cy[i]
                if kept[i] and kept[j] and j != i and dx * dx + dy * dy <= radius * radius:
                    heights[n] = cz[j]
                    n += 1
                j += 1
        if n:
            around = np.sort(heights[:n])
            out[i] = 2 * cz[i] > around[(n - 1) // 2] + around[n // 2] + 2 * excess
    return out


@numba.njit(nogil=True, cache=True)
def touching(ix, iy, layer, kept):  # type: ignore[no-untyped-def]
    """Count the kept centroids in the eight columns around each, in its own layer or the next one up or down.

    Parameters
    ----------
    ix, iy, layer : ndarray of int64, shape (m,)
        As in `window_clusters`.
    kept : ndarray of bool, shape (m,)
        Centroids that count.

    Returns
    -------
    ndarray of int64, shape (m,)
        Between 0 and 8.
    """
    m = len(ix)
    out = np.zeros(m, np.int64)
    first = np.zeros(3, np.int64)
    for i in range(m):
        for d in range(3):
            first[d] = _forward(ix, iy, first[d], ix[i] + d - 1, iy[i] - 1)
            j = first[d]
            while j < m and ix[j] == ix[i] + d - 1 and iy[j] <= iy[i] + 1:
                if j != i and kept[j] and abs(layer[j] - layer[i]) <= 1:
                    out[i] += 1
                j += 1
    return out
