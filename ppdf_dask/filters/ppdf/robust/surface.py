"""The reference surface at a place: nearest references in four quadrants and a plane through them (paper, 2.5)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from ppdf_dask.filters.ppdf.compiled import leaf
from ppdf_dask.filters.ppdf.robust.cells import REF, UNPROVEN

NONE = 60_000
"""Cells: no reference in this direction; farther than any search."""


def room_for_index(cells: int) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16], npt.NDArray[np.int32]]:
    """Return the arrays that `index_references` fills: 8 bytes per cell."""
    return np.empty(cells, np.uint16), np.empty(cells, np.uint16), np.empty(cells, np.int32)


@njit(nogil=True, cache=True)
def index_references(width: Any, state: Any, right: Any, left: Any, unproven: Any) -> None:
    """Index a grid for `nearest` and `count_within`.

    `right` and `left` (uint16) get the number of cells to the next reference of the row, the cell itself included,
    or `NONE`; `unproven` (int32) the summed-area table of unproven cells.
    """
    for row in range(len(state) // width):
        start = row * width
        gap = NONE
        for k in range(start + width - 1, start - 1, -1):
            gap = 0 if state[k] & REF else min(gap + 1, NONE)
            right[k] = gap
        gap = NONE
        total = 0
        for k in range(start, start + width):
            gap = 0 if state[k] & REF else min(gap + 1, NONE)
            left[k] = gap
            total += (state[k] & UNPROVEN) != 0
            unproven[k] = total + (unproven[k - width] if row > 0 else 0)


@leaf
def count_within(table: Any, width: Any, k: Any, ring: Any) -> Any:
    """Return the sum over the square of `ring` cells around cell `k` from a summed-area table."""
    a = k - (ring + 1) * width - ring - 1
    b = k + ring * width - ring - 1
    wide = 2 * ring + 1
    return table[b + wide] - table[a + wide] - table[b] + table[a]


@leaf
def _nearest_in(
    gap: Any,
    pos: Any,
    width: Any,
    cell: Any,
    k: Any,
    x: Any,
    y: Any,
    fx: Any,
    fy: Any,
    along: Any,
    up: Any,
    found: Any,
    q: Any,
) -> None:
    """Look in one quadrant for a nearer reference than `found` has.

    `along` and `up` are 1 or -1, `gap` is the index that way. Row by row outwards, from reference to reference, as
    long as a row or a column can still hold a nearer one.
    """
    wide = cell - fx if along > 0 else fx + 1
    high = cell - fy if up > 0 else fy + 1
    best, which = found[4 + q], found[q]
    row, far2 = k, np.int64(0)
    for r in range(NONE):
        o = np.int64(gap[row])
        u2 = np.int64(0) if o == 0 else (wide + (o - 1) * cell) ** 2
        while u2 + far2 <= best:
            j = row + o * along
            u = (np.int64(pos[j, 0]) - x) * along
            v = (np.int64(pos[j, 1]) - y) * up
            d2 = u * u + v * v
            inside = (u >= 0) & (v >= 0) & ((u if along == up else v) > 0)
            if inside and (d2 < best or (d2 == best and (which < 0 or before(pos, j, which)))):
                best = d2
                which = j
            o += 1 + np.int64(gap[j + along])
            u2 = (wide + (o - 1) * cell) ** 2
        row += width * up
        far2 = (high + r * cell) ** 2
        if far2 > best:
            break
    found[q] = which
    found[4 + q] = best


@leaf
def nearest(
    right: Any,
    left: Any,
    pos: Any,
    width: Any,
    cell: Any,
    k: Any,
    x: Any,
    y: Any,
    fx: Any,
    fy: Any,
    limit2: Any,
    found: Any,
) -> None:
    """Find the nearest reference in each quadrant around (`x`, `y`), none at that very place.

    The place lies `fx`, `fy` within cell `k`. `found` (int64, 8) gets the four cells or -1, and the four squared
    distances or `limit2`. The quadrants are half-open, so that a point on an axis belongs to one of them, and numbered
    right + 2 up. First the cells around, where it mostly is; then quadrant by quadrant what they leave open.
    """
    for q in range(4):
        found[q] = -1
        found[4 + q] = limit2
    for dr in range(-1, 2):
        for j in range(k + dr * width - 1, k + dr * width + 2):
            if right[j] != 0:
                continue
            dx = np.int64(pos[j, 0]) - x
            dy = np.int64(pos[j, 1]) - y
            d2 = dx * dx + dy * dy
            is_right = (dx > 0) | ((dx == 0) & (dy < 0))
            is_up = (dy > 0) | ((dy == 0) & (dx > 0))
            quadrant = np.int64(is_right) + 2 * np.int64(is_up)
            if d2 > found[4 + quadrant] or d2 == 0:
                continue
            if d2 < found[4 + quadrant] or found[quadrant] < 0 or before(pos, j, found[quadrant]):
                found[4 + quadrant] = d2
                found[quadrant] = j
    for q in range(4):
        to_side = 2 * cell - fx if q & 1 else cell + fx
        to_end = 2 * cell - fy if q & 2 else cell + fy
        if found[4 + q] >= min(to_side, to_end) ** 2:
            way, along = (right, 1) if q & 1 else (left, -1)
            _nearest_in(way, pos, width, cell, k, x, y, fx, fy, along, 1 if q & 2 else -1, found, q)


@leaf
def reach(found: Any, fx: Any, fy: Any, cell: Any, rings: Any) -> Any:
    """Return how many rings of cells decide what `nearest` found: beyond them nothing could be nearer.

    `fx`, `fy` is the place within its cell; `rings` where a quadrant is empty.
    """
    for q in range(4):
        if found[q] < 0:
            return rings
    for ring in range(rings):
        right = (ring + 1) * cell - fx
        left = ring * cell + fx
        top = (ring + 1) * cell - fy
        bottom = ring * cell + fy
        if (
            found[7] < min(right, top) ** 2
            and found[6] < min(left, top) ** 2
            and found[4] < min(left, bottom) ** 2
            and found[5] < min(right, bottom) ** 2
        ):
            return ring
    return rings


@leaf
def before(pos: Any, j: Any, k: Any) -> Any:
    """Tell whether the low point of cell `j` comes before that of `k` in the order (z, x, y)."""
    if pos[j, 2] != pos[k, 2]:
        return pos[j, 2] < pos[k, 2]
    if pos[j, 0] != pos[k, 0]:
        return pos[j, 0] < pos[k, 0]
    return pos[j, 1] < pos[k, 1]


@leaf
def height_above(pos: Any, x: Any, y: Any, z: Any, found: Any, soft: Any) -> Any:
    """Return (count, height above the surface, slope, distance and height above the nearest reference), metres."""
    n = 0
    near = np.int64(-1)
    near2 = np.int64(1) << 60
    for q in range(4):
        j = found[q]
        if j < 0:
            continue
        n += 1
        dx = np.int64(pos[j, 0]) - x
        dy = np.int64(pos[j, 1]) - y
        d2 = dx * dx + dy * dy
        if d2 < near2 or (d2 == near2 and before(pos, j, near)):
            near2 = d2
            near = j
    if n == 0:
        return 0, 0.0, 0.0, 0.0, 0.0
    d = np.sqrt(near2 * 1e-6)
    step = (z - np.int64(pos[near, 2])) * 1e-3
    ws = 0.0
    xm = ym = zm = 0.0
    weak = 1e-4 if n < 3 else soft
    for q in range(4):
        j = found[q]
        if j >= 0:
            dx = (pos[j, 0] - np.int64(x)) * 1e-3
            dy = (pos[j, 1] - np.int64(y)) * 1e-3
            w = 1.0 / (dx * dx + dy * dy + weak)
            ws += w
            xm += w * dx
            ym += w * dy
            zm += w * ((pos[j, 2] - np.int64(z)) * 1e-3)
    xm /= ws
    ym /= ws
    zm /= ws
    if n < 3:
        return n, -zm, 0.0, d, step
    scale = n / ws
    sxx = syy = soft
    sxy = sxz = syz = 0.0
    for q in range(4):
        j = found[q]
        if j >= 0:
            dx = (pos[j, 0] - np.int64(x)) * 1e-3
            dy = (pos[j, 1] - np.int64(y)) * 1e-3
            w = scale / (dx * dx + dy * dy + weak)
            dz = (pos[j, 2] - np.int64(z)) * 1e-3 - zm
            dx -= xm
            dy -= ym
            sxx += w * dx * dx
            sxy += w * dx * dy
            syy += w * dy * dy
            sxz += w * dx * dz
            syz += w * dy * dz
    det = sxx * syy - sxy * sxy
    a = (sxz * syy - syz * sxy) / det
    b = (syz * sxx - sxz * sxy) / det
    slope = np.sqrt(a * a + b * b)
    if slope > 3.0:
        a *= 3.0 / slope
        b *= 3.0 / slope
        slope = 3.0
    return n, a * xm + b * ym - zm, slope, d, step
