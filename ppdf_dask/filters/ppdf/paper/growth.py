"""Ground points from seeds: the nearest ground point of each quadrant carries the reference plane (section 2.5)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Ints
from ppdf_dask.filters.ppdf.paper import _growth_kernels as kernels
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.grid import MM, Rect

GROUND, UNPROVEN = kernels.GROUND, kernels.UNPROVEN
MOST_PASSES = 200
"""Passes after which growth stops even if points are still being added."""
PER_BUCKET = 4
"""Aim for the points of a bucket; it decides the speed only."""

_FAR = 2**40


def grow(
    points: tuple[Ints, Ints, Ints],
    state: npt.NDArray[np.uint8],
    density: float,
    known: Rect | None,
    params: PaperParams,
) -> tuple[npt.NDArray[np.uint8], int]:
    """Add to the ground, pass by pass, every point near the plane through its neighbouring ground points.

    In each pass every point that is not ground looks for the nearest ground point (horizontally; ties by z, x, y) in
    each of the quadrants ``dx > 0, dy >= 0``; ``dx <= 0, dy > 0``; ``dx < 0, dy <= 0``; ``dx >= 0, dy < 0``. Three or
    four carry a least-squares plane; one or two, neighbours on a line and planes steeper than 80 degrees give their
    inverse-distance mean height instead. The point is accepted when it is nearer than `classification_distance`,
    perpendicularly, above or below. A pass reads the ground of the pass before only.

    Parameters
    ----------
    points : tuple of ndarray of int32, shape (n,)
        Distinct x, y (relative to any place) and z, mm.
    state : ndarray of uint8, shape (n,)
        1 ground, 2 unproven and thought non-ground, 3 unproven and thought ground, 0 not ground so far.
    density : float
        About how many points lie on a square metre; decides the speed only.
    known : Rect or None
        The known area in the coordinates of `points`; None: everything is known.
    params : PaperParams
        `search_limit`, `classification_distance`, `min_neighbours` and `neighbours`.

    Returns
    -------
    state : ndarray of uint8, shape (n,)
        The same codes at the end. A state without 2 equals that of any cloud that agrees within the known area.
    passes : int
        Passes run, the last idle one counted; -1 when `MOST_PASSES` did not suffice.

    Notes
    -----
    Cai, Liang, Yu 2023, section 2.5 and Eq. 3; half-open quadrants so that gridded coordinates have a place.

    Examples
    --------
    >>> x = np.array([0, 2000, 2000, 0, 1000], np.int32)
    >>> y = np.array([0, 0, 2000, 2000, 1000], np.int32)
    >>> z = np.array([0, 0, 0, 0, 1400], np.int32)
    >>> grow((x, y, z), np.array([1, 1, 1, 1, 0], np.uint8), 1.0, None, PaperParams())[0].tolist()
    [1, 1, 1, 1, 1]
    """
    if len(state) == 0:
        return state.copy(), 1
    x, y, z = points
    reach = round(params.search_limit * MM)
    edge = max(1, round(math.sqrt(PER_BUCKET / density) * MM), reach // 256)
    left, bottom = int(x.min()), int(y.min())
    order, keys, starts = _buckets(x, y, left, bottom, edge)
    table = np.full(1 << (2 * len(keys) - 1).bit_length(), -1, np.int32)
    near = np.empty((len(keys), 9), np.int32)
    kernels.fill_table(keys, table)
    kernels.neighbours_of(keys, table, near)
    area = (-_FAR, -_FAR, _FAR, _FAR) if known is None else (known.x0, known.y0, known.x1, known.y1)
    sorted_state = state[order]
    passes = kernels.grow(
        x[order], y[order], z[order], sorted_state, np.array([edge, left, bottom], np.int64), starts, keys, table, near,
        reach, params.classification_distance * MM, params.min_neighbours, params.neighbours == "nearest",
        np.array(area, np.int64), MOST_PASSES,
    )  # fmt: skip
    out = np.empty_like(state)
    out[order] = sorted_state
    return out, passes


def _buckets(
    x: Ints, y: Ints, left: int, bottom: int, edge: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Sort points by block and bucket: their order, the occupied blocks' keys, the bounds of the buckets."""
    side = kernels.SIDE
    i, j = (x.astype(np.int64) - left) // edge, (y.astype(np.int64) - bottom) // edge
    rows = int(j.max()) // side + 1
    key = i // side * rows
    key += j // side
    key *= side * side
    i %= side
    i *= side
    key += i
    j %= side
    key += j
    del i, j
    order = np.argsort(key)
    key = key[order]
    block = key // (side * side)
    fresh = np.ones(len(block), bool)
    fresh[1:] = np.diff(block) != 0
    unique = block[fresh]
    keys = (unique // rows << 32) + unique % rows
    # Renumber the blocks: only the occupied ones have buckets.
    key -= block * side * side
    key += (np.cumsum(fresh) - 1) * (side * side)
    starts = np.zeros(side * side * len(keys) + 1, np.int32)
    np.cumsum(np.bincount(key, minlength=side * side * len(keys)), out=starts[1:])
    return order, keys, starts
