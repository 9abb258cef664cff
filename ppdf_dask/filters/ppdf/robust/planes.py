"""Progressive RANSAC planes over the low points and the seeds they give (steps 4 and 5)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.compiled import kernel, leaf
from ppdf_dask.filters.ppdf.hashing import below, cell_seed
from ppdf_dask.filters.ppdf.robust.cells import FIXED, LOW, MAYBE_DROPPED, REF, SQUARE, UNPROVEN, Cells
from ppdf_dask.filters.ppdf.robust.params import RobustParams

NOT_KNOWN_PATCH = np.int32(-2)
"""Patch of a fixed low point, itself proven, whose square is not known as a whole; other negative: no patch."""


@leaf
def _fit(xs: Any, ys: Any, zs: Any, n: Any, seed: Any, trials: Any, t_in: Any, best: Any) -> Any:
    """Find the plane with the best score; return whether there is one, `best` gets (a, b, height at 0, 0)."""
    best_score = -(1 << 30)
    for t in range(trials):
        i = below(seed, 3 * t, n)
        j = below(seed, 3 * t + 1, n)
        k = below(seed, 3 * t + 2, n)
        if i in (j, k) or j == k:
            continue
        ux, uy, uz = xs[j] - xs[i], ys[j] - ys[i], zs[j] - zs[i]
        vx, vy, vz = xs[k] - xs[i], ys[k] - ys[i], zs[k] - zs[i]
        cross = ux * vy - uy * vx
        if abs(cross) < 1e-3:
            continue
        a = (uz * vy - vz * uy) / cross
        b = (ux * vz - vx * uz) / cross
        tilt = a * a + b * b
        if tilt > 1.0:
            continue
        h = zs[i] - a * xs[i] - b * ys[i]
        limit = t_in * np.sqrt(1.0 + tilt)
        score = 0
        for m in range(n):
            r = zs[m] - (h + a * xs[m] + b * ys[m])
            # Without a branch the compiler takes several points at once.
            score += int(r <= limit) - 2 * int(r < -limit)
        if score > best_score:
            best_score = score
            best[0], best[1], best[2] = a, b, h
    return best_score > -(1 << 30)


@leaf
def _low_points(
    c0: Any, r0: Any, size: Any, width: Any, cell: Any, pos: Any, state: Any, xs: Any, ys: Any, zs: Any, who: Any
) -> Any:
    """Take the low points of a square, metres from its corner and the first of them; return how many, and its z."""
    n = base = np.int64(0)
    for r in range(r0, r0 + size):
        for k in range(r * width + c0, r * width + c0 + size):
            if state[k] & LOW:
                if n == 0:
                    base = np.int64(pos[k, 2])
                xs[n] = (pos[k, 0] - c0 * cell) * 1e-3
                ys[n] = (pos[k, 1] - r0 * cell) * 1e-3
                zs[n] = (pos[k, 2] - base) * 1e-3
                who[n] = k
                n += 1
    return n, base


class Patches(NamedTuple):
    """The planes found and the low points that lie in them, their seeds.

    Attributes
    ----------
    of_cell : numpy.ndarray
        The patch of the low point of each cell, int32; negative: none.
    planes : numpy.ndarray
        (n, 3): slopes along x and y, and height at the corner of the square.
    squares : numpy.ndarray
        (n, 4), int32: column, row and size in cells, and the height (mm) from which heights count.
    """

    of_cell: npt.NDArray[np.int32]
    planes: npt.NDArray[np.float64]
    squares: npt.NDArray[np.int32]


def find_planes(cells: Cells, params: RobustParams) -> Patches:
    """Fit planes in all squares and set REF of the seeds.

    A square of which a cell is not known is left alone, and what it holds stays unproven.
    """
    state = cells.state
    of_cell = np.full(len(state), -1, np.int32)
    by_square = (cells.height // SQUARE, SQUARE, cells.width // SQUARE, SQUARE)
    flags = np.bitwise_or.reduce(np.bitwise_or.reduce(state.reshape(by_square), axis=1), axis=2)
    rows, cols = np.nonzero(flags & UNPROVEN)
    inside = state.reshape(by_square)[rows, :, cols]
    of_cell.reshape(by_square)[rows, :, cols] = np.where(inside & FIXED, NOT_KNOWN_PATCH, np.int32(-1))
    inside[(inside & (LOW | FIXED)) == LOW] |= UNPROVEN | MAYBE_DROPPED
    state.reshape(by_square)[rows, :, cols] = inside
    todo = np.flatnonzero((flags & (LOW | UNPROVEN)) == LOW)
    lows = int(np.count_nonzero(state & LOW))
    planes, squares = np.empty((lows, 3)), np.empty((lows, 4), np.int32)
    cap = SQUARE * SQUARE
    xs, ys, zs, who, best, stack = (
        *np.empty((3, cap)),
        np.empty(cap, np.int64),
        np.empty(3),
        np.empty((64, 3), np.int64),
    )
    count = _find_planes(
        todo,
        cells.width,
        cells.cell,
        cells.pos,
        state,
        of_cell,
        planes,
        squares,
        params.trials,
        params.inlier_distance,
        params.inlier_share,
        xs,
        ys,
        zs,
        who,
        best,
        stack,
    )
    return Patches(of_cell, planes[:count], squares[:count])


@kernel
def _find_planes(
    todo: Any,
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    patch: Any,
    planes: Any,
    squares: Any,
    trials: Any,
    t_in: Any,
    share: Any,
    xs: Any,
    ys: Any,
    zs: Any,
    who: Any,
    best: Any,
    stack: Any,
) -> Any:
    """Fit planes in the squares `todo`, from the whole square to quarters; return the number of patches."""
    count = 0
    for s in range(len(todo)):
        row0, col0 = todo[s] // (width // SQUARE) * SQUARE, todo[s] % (width // SQUARE) * SQUARE
        top = 1
        stack[0, 0], stack[0, 1], stack[0, 2] = col0, row0, SQUARE
        while top:
            top -= 1
            c0, r0, size = stack[top, 0], stack[top, 1], stack[top, 2]
            n, base = _low_points(c0, r0, size, width, cell, pos, state, xs, ys, zs, who)
            if n < 4:
                continue
            split = True
            seed = cell_seed(c0 - col0, r0 - row0, size)
            if _fit(xs, ys, zs, n, seed, trials, t_in, best):
                a, b, h = best[0], best[1], best[2]
                norm = np.sqrt(1.0 + a * a + b * b)
                inside = 0
                for m in range(n):
                    inside += abs(zs[m] - (h + a * xs[m] + b * ys[m])) / norm <= t_in
                if inside >= 4 and inside >= share * n:
                    split = bool(inside < 0.9 * n)
                    taken = 0
                    for m in range(n):
                        k = who[m]
                        if patch[k] < 0 and abs(zs[m] - (h + a * xs[m] + b * ys[m])) / norm <= t_in:
                            patch[k] = count
                            state[k] |= REF
                            taken += 1
                    if taken:
                        planes[count, 0], planes[count, 1], planes[count, 2] = a, b, h
                        squares[count, 0], squares[count, 1], squares[count, 2] = c0, r0, size
                        squares[count, 3] = base
                        count += 1
            if split and size > 2:
                half = size // 2
                for q in range(4):
                    stack[top, 0] = c0 + (q & 1) * half
                    stack[top, 1] = r0 + (q >> 1) * half
                    stack[top, 2] = half
                    top += 1
    return count
