"""Kernels of the maximum slope filter. Distances are millimetres, squared distances integers."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def _below(x, y, z, a, b):  # type: ignore[no-untyped-def]
    """Tell whether point `a` comes before `b` by (z, x, y)."""
    return z[a] < z[b] or (z[a] == z[b] and (x[a] < x[b] or (x[a] == x[b] and y[a] < y[b])))


@njit(nogil=True, cache=True)
def lowest_points(x, y, z, cell, lowest):  # type: ignore[no-untyped-def]
    """Write the index of each cell's lowest point by (z, x, y)."""
    for k in range(len(z)):
        b = lowest[cell[k]]
        if b < 0 or _below(x, y, z, k, b):
            lowest[cell[k]] = k


@njit(nogil=True, cache=True)
def strict(x, y, z, cell, lowest, columns, step, limits, ground):  # type: ignore[no-untyped-def]
    """Vosselman's rule for the first ``len(ground)`` points; `limits`: radius, slope, largest height, tolerance."""
    radius, slope, most, tolerance = limits
    rows = len(lowest) // columns
    reach = int(radius // step) + 1
    for k in range(len(ground)):
        row, column = cell[k] // columns, cell[k] % columns
        passes = True
        for r in range(max(0, row - reach), min(rows, row + reach + 1)):
            for c in range(max(0, column - reach), min(columns, column + reach + 1)):
                j = lowest[r * columns + c]
                if j < 0:
                    continue
                rise = np.int64(z[k]) - z[j]
                if r == row and c == column:
                    if rise > tolerance:
                        passes = False
                        break
                    continue
                if rise <= 0:
                    continue
                dx, dy = np.int64(x[k]) - x[j], np.int64(y[k]) - y[j]
                d2 = dx * dx + dy * dy
                if d2 > radius * radius:
                    continue
                allowed = slope * math.sqrt(d2)
                if rise > (allowed if allowed < most else most):
                    passes = False
                    break
            if not passes:
                break
        ground[k] = passes


@njit(nogil=True, cache=True)
def _nearest(x, y, z, starts, columns, step, k, row, column, ground):  # type: ignore[no-untyped-def]
    """Return the nearest ground point by (squared distance, z, x, y), ring of cells by ring; -1 when there is none."""
    rows = (len(starts) - 1) // columns
    best = -1
    best2 = np.int64(-1)
    for ring in range(max(rows, columns)):
        # What lies beyond the rings seen so far is at least this far away: the point is inside its own cell.
        if best >= 0 and best2 < (ring - 1) * (ring - 1) * step * step:
            break
        for r in range(max(0, row - ring), min(rows, row + ring + 1)):
            hop = 1 if abs(r - row) == ring or ring == 0 else 2 * ring
            for c in range(column - ring, column + ring + 1, hop):
                if c < 0 or c >= columns:
                    continue
                for j in range(starts[r * columns + c], starts[r * columns + c + 1]):
                    if not ground[j]:
                        continue
                    dx, dy = np.int64(x[k]) - x[j], np.int64(y[k]) - y[j]
                    d2 = dx * dx + dy * dy
                    if best < 0 or d2 < best2:
                        best, best2 = j, d2
                    elif d2 == best2 and _below(x, y, z, j, best):
                        best = j
    return best, best2


@njit(nogil=True, cache=True)
def grow(x, y, z, starts, columns, step, offset, limits, ground):  # type: ignore[no-untyped-def]
    """Add in synchronous passes what its nearest ground point allows; points are sorted by cell.

    `limits`: slope, largest height, tolerance. A point is asked again only when ground came closer than its last judge.
    """
    slope, most, tolerance = limits
    n = len(x)
    news = np.zeros(len(starts) - 1, np.bool_)
    judge2 = np.full(n, -1, np.int64)
    first = True
    while True:
        accepted = np.zeros(n, np.bool_)
        for k in range(n):
            if ground[k]:
                continue
            row, column = (np.int64(y[k]) + offset[1]) // step, (np.int64(x[k]) + offset[0]) // step
            if not first and not _news_within(news, columns, row, column, judge2[k], step):
                continue
            j, d2 = _nearest(x, y, z, starts, columns, step, k, row, column, ground)
            judge2[k] = d2
            if j < 0:
                continue
            allowed = tolerance + slope * math.sqrt(d2)
            if np.int64(z[k]) - z[j] <= (allowed if allowed < most else most):
                accepted[k] = True
        news[:] = False
        any_new = False
        for k in range(n):
            if accepted[k]:
                ground[k] = True
                any_new = True
                news[(np.int64(y[k]) + offset[1]) // step * columns + (np.int64(x[k]) + offset[0]) // step] = True
        if not any_new:
            return
        first = False


@njit(nogil=True, cache=True)
def _news_within(news, columns, row, column, d2, step):  # type: ignore[no-untyped-def]
    """Tell whether a cell that a point's nearest ground point could now lie in has new ground."""
    rows = len(news) // columns
    reach = int(math.sqrt(d2) // step) + 1
    for r in range(max(0, row - reach), min(rows, row + reach + 1)):
        for c in range(max(0, column - reach), min(columns, column + reach + 1)):
            if news[r * columns + c]:
                return True
    return False
