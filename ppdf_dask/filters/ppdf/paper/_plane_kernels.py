"""Compiled loops of `planes`: RANSAC, refit, reliability and the cutting of squares. Lengths are millimetres.

All decisions use integer differences held in float64 (exact below 2**53), sums in the canonical order of the points and
IEEE operations only, so that every machine decides alike.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.hashing import below, cell_seed

LEVELS = 6
"""How often a square may be halved: down to a 64th of its edge, a guard for very dense or duplicated points."""
FEWEST_TRIALS, MOST_TRIALS = 50, 1000
MISS = 0.01
"""Accepted probability that no trial drew three inliers (confidence 0.99)."""
STEEPEST = 0.087
"""Smallest vertical part of a unit normal: planes steeper than 85 degrees are walls."""


@njit(nogil=True, cache=True)
def trials_needed(support: int, n: int) -> int:
    """Return the smallest k with (1 - w^3)^k <= 0.01, w = support / n, between 50 and 1000.

    By repeated multiplication: a logarithm may differ in its last bit between machines.
    """
    share = support / n
    miss = 1.0 - share * share * share
    left, k = miss, 1
    while left > MISS and k < MOST_TRIALS:
        left *= miss
        k += 1
    return max(k, FEWEST_TRIALS)


@njit(nogil=True, cache=True)
def _triple(seed: Any, trial: int, n: int) -> tuple[int, int, int]:
    """Draw three different indices below n."""
    i = below(seed, 3 * trial, n)
    j = below(seed, 3 * trial + 1, n - 1)
    if j >= i:
        j += 1
    k = below(seed, 3 * trial + 2, n - 2)
    if k >= min(i, j):
        k += 1
    if k >= max(i, j):
        k += 1
    return i, j, k


@njit(nogil=True, cache=True)
def _support(points: Any, n: int, plane: Any, limit: float) -> int:
    a, b, c = plane[0], plane[1], plane[2]
    count = 0
    for i in range(n):
        dx = (points[0, i] - plane[3]) - plane[6]
        dy = (points[1, i] - plane[4]) - plane[7]
        dz = (points[2, i] - plane[5]) - plane[8]
        if abs(a * dx + b * dy + c * dz) < limit:
            count += 1
    return count


@njit(nogil=True, cache=True)
def _misfit(points: Any, n: int, plane: Any, limit: float) -> float:
    """Return the sum of the inliers' distances."""
    total = 0.0
    for i in range(n):
        s = abs(distance(points[0, i], points[1, i], points[2, i], plane))
        if s < limit:
            total += s
    return total


@njit(nogil=True, cache=True)
def distance(x: float, y: float, z: float, plane: Any) -> float:
    """Return the signed perpendicular distance, positive above.

    `plane` holds the unit normal (a, b, c > 0), a base point of whole millimetres and the centroid's offset from it.
    """
    dx, dy, dz = (x - plane[3]) - plane[6], (y - plane[4]) - plane[7], (z - plane[5]) - plane[8]
    return float(plane[0] * dx + plane[1] * dy + plane[2] * dz)


@njit(nogil=True, cache=True)
def ransac(points: Any, n: int, seed: Any, limit: float, best: Any) -> int:
    """Write the best plane of hashed triples into `best`; return its support, 0 if every triple was rejected.

    More inliers win, then the smaller sum of their distances, then the earlier trial. A rejected triple is a trial too.
    """
    support, misfit = 0, 0.0
    plane = np.zeros(9)
    most = min(MOST_TRIALS, n * (n - 1) * (n - 2) // 6)
    trial, planned = 0, most
    while trial < planned:
        i, j, k = _triple(seed, trial, n)
        trial += 1
        ax, ay, az = points[0, j] - points[0, i], points[1, j] - points[1, i], points[2, j] - points[2, i]
        bx, by, bz = points[0, k] - points[0, i], points[1, k] - points[1, i], points[2, k] - points[2, i]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if norm == 0.0 or abs(nz) < STEEPEST * norm:
            continue
        if nz < 0.0:
            norm = -norm
        plane[0], plane[1], plane[2] = nx / norm, ny / norm, nz / norm
        plane[3], plane[4], plane[5] = points[0, i], points[1, i], points[2, i]
        count = _support(points, n, plane, limit)
        if count < support:
            continue
        sum_ = _misfit(points, n, plane, limit)
        if count > support:
            planned = min(most, trials_needed(count, n))
        elif sum_ >= misfit:
            continue
        support, misfit = count, sum_
        best[:] = plane
    return support


@njit(nogil=True, cache=True)
def refit(points: Any, n: int, support: int, limit: float, plane: Any) -> int:
    """Replace `plane` by the least-squares plane of its inliers unless that has fewer; return the support."""
    mx, my, mz = 0.0, 0.0, 0.0
    for i in range(n):
        if abs(distance(points[0, i], points[1, i], points[2, i], plane)) < limit:
            mx += points[0, i] - plane[3]
            my += points[1, i] - plane[4]
            mz += points[2, i] - plane[5]
    mx, my, mz = mx / support, my / support, mz / support
    sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        if abs(distance(points[0, i], points[1, i], points[2, i], plane)) < limit:
            dx = (points[0, i] - plane[3]) - mx
            dy = (points[1, i] - plane[4]) - my
            dz = (points[2, i] - plane[5]) - mz
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
            sxz += dx * dz
            syz += dy * dz
    det = sxx * syy - sxy * sxy
    # Inliers on nearly one line in plan carry no slope across it.
    if det <= 1e-6 * (sxx + syy) * (sxx + syy):
        return support
    p = (sxz * syy - syz * sxy) / det
    q = (syz * sxx - sxz * sxy) / det
    norm = math.sqrt(1.0 + p * p + q * q)
    if STEEPEST * norm > 1.0:
        return support
    fitted = plane.copy()
    fitted[0], fitted[1], fitted[2] = -p / norm, -q / norm, 1.0 / norm
    fitted[6], fitted[7], fitted[8] = mx, my, mz
    count = _support(points, n, fitted, limit)
    if count < support:
        return support
    plane[:] = fitted
    return count


@njit(nogil=True, cache=True)
def _depth(points: Any, n: int, plane: Any) -> float:
    """Return how far the deepest point lies below the plane, 0 if none does."""
    deepest = 0.0
    for i in range(n):
        deepest = max(deepest, -distance(points[0, i], points[1, i], points[2, i], plane))
    return deepest


@njit(nogil=True, cache=True)
def _quarter(x: Any, y: Any, index: Any, spare: Any, bounds: Any, cell: Any, edge: int) -> None:
    """Sort `index` by quarter of the cell, keeping the order inside each; write the five bounds.

    `cell` is (level, first, last, left, bottom); a position p of the square lies in column floor(p * 2^level / edge).
    """
    level, first, last = cell[0] + 1, cell[1], cell[2]
    at = first
    for quarter in range(4):
        bounds[quarter] = at
        for k in range(first, last):
            i = index[k]
            column = (((x[i] - cell[3]) << level) // edge) & 1
            row = (((y[i] - cell[4]) << level) // edge) & 1
            if column + 2 * row == quarter:
                spare[at] = i
                at += 1
    bounds[4] = at
    index[first:last] = spare[first:last]


@njit(nogil=True, cache=True)
def detect(x: Any, y: Any, z: Any, under: Any, starts: Any, ix: Any, iy: Any, origin: Any, edge: int,
           min_inliers: int, distances: Any, seeds: Any, planes: Any, cells: Any) -> int:  # fmt: skip
    """Find the planes of all squares; mark the seeds; return the number of planes.

    Parameters
    ----------
    x, y, z : ndarray of int32, shape (n,)
        Points sorted by square, then (x, y, z), relative to `origin` (z absolute).
    under : ndarray of bool, shape (n,)
        Points under the canopy: only they make and refute planes.
    starts, ix, iy : ndarray of int64
        Bounds and absolute addresses of the squares.
    origin : ndarray of int64, shape (2,)
        Absolute place of x = y = 0.
    edge, min_inliers : int
        Of the largest squares; of a plane.
    distances : ndarray of float64, shape (3,)
        Inlier, division and seed distance.
    seeds : ndarray of bool, shape (n,)
        Out: True for every point of an accepted plane's square within the seed distance.
    planes : ndarray of float64, shape (m, 9)
        Out: see `distance`; base and offset relative to the largest square's corner.
    cells : ndarray of int64, shape (m, 5)
        Out: absolute column and row at the plane's own level, level, support, largest square's index.
    """
    widest = 0
    for s in range(len(ix)):
        widest = max(widest, starts[s + 1] - starts[s])
    index, spare = np.empty(widest, np.int64), np.empty(widest, np.int64)
    points = np.empty((3, widest))
    stack, bounds = np.empty((3 * LEVELS + 4, 5), np.int64), np.empty(5, np.int64)
    frame, plane = np.empty(5, np.int64), np.zeros(9)
    found, fewest = 0, max(3, min_inliers)
    for s in range(len(ix)):
        left, bottom = ix[s] * edge - origin[0], iy[s] * edge - origin[1]
        count = starts[s + 1] - starts[s]
        for k in range(count):
            index[k] = starts[s] + k
        stack[0] = np.array([0, 0, count, 0, 0])
        top = 1
        while top > 0:
            top -= 1
            level, first, last = stack[top, 0], stack[top, 1], stack[top, 2]
            column, row = stack[top, 3], stack[top, 4]
            n = 0
            for k in range(first, last):
                i = index[k]
                if under[i]:
                    points[0, n], points[1, n], points[2, n] = x[i] - left, y[i] - bottom, z[i]
                    n += 1
            if n < fewest:
                continue
            column_, row_ = (ix[s] << level) + column, (iy[s] << level) + row
            plane[:] = 0.0
            support = ransac(points, n, cell_seed(column_, row_, (64 * edge) >> level), distances[0], plane)
            if support > 0:
                support = refit(points, n, support, distances[0], plane)
            if support < fewest:
                continue
            if _depth(points, n, plane) < distances[1]:
                planes[found] = plane
                cells[found] = np.array([column_, row_, level, support, s])
                found += 1
                for k in range(first, last):
                    i = index[k]
                    if abs(distance(x[i] - left, y[i] - bottom, z[i], plane)) < distances[2]:
                        seeds[i] = True
            elif level < LEVELS:
                frame[:] = np.array([level, first, last, left, bottom])
                _quarter(x, y, index, spare, bounds, frame, edge)
                for quarter in range(4):
                    half = np.array([level + 1, bounds[quarter], bounds[quarter + 1],
                                     2 * column + quarter % 2, 2 * row + quarter // 2])  # fmt: skip
                    stack[top] = half
                    top += 1
    return found


@njit(nogil=True, cache=True)
def lowest(z: Any, starts: Any, seeds: Any) -> None:
    """Mark the lowest point of each square; the canonical order makes the first of equals the lowest by (z, x, y)."""
    for s in range(len(starts) - 1):
        best = starts[s]
        for i in range(starts[s], starts[s + 1]):
            if z[i] < z[best]:
                best = i
        seeds[best] = True
