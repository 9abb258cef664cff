"""Growth of the references over low points and one cleaning round (steps 7, 8 and 10)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.compiled import leaf
from ppdf_dask.filters.ppdf.robust.cells import DROPPED, FIXED, HIGH, LOW, MAYBE_DROPPED, REF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.surface import count_within, height_above, index_references, nearest, reach

NOT_KNOWN = np.int32(-(2**31))
"""A residual or roughness that does not exist or is not proven."""

TOO_HIGH = 4.0
"""Metres above the surface of its references, and as much more as that rises in a cell, from where a low point is HIGH.

A shortcut: what stands as high as a house is not tried again, and nor is what lies above it in its cell."""


@leaf
def _look_around(
    state: Any, pos: Any, width: Any, cell: Any, k: Any, x: Any, y: Any, rings: Any, limit2: Any, index: Any, found: Any
) -> Any:
    """Find the nearest references around a low point in cell `k`, itself left out; return the rings that decide them.

    The second value tells whether an unproven cell lies within, other than by the low point itself.
    """
    right, left, open_ = index
    fx, fy = x % cell, y % cell
    nearest(right, left, pos, width, cell, k, x, y, fx, fy, limit2, found)
    ring = reach(found, fx, fy, cell, rings)
    itself = (state[k] & UNPROVEN) != 0 and pos[k, 0] == x and pos[k, 1] == y
    return ring, count_within(open_, width, k, ring) > itself


@njit(nogil=True, cache=True)
def grow(
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    rings: Any,
    limit2: Any,
    base: Any,
    spread: Any,
    slope_factor: Any,
    step_limit: Any,
    step_spread: Any,
    highest: Any,
    skip: Any,
    rough: Any,
    rough_factor: Any,
    rough_most: Any,
    parts: Any,
    first: Any,
    seek_pos: Any,
    seek_state: Any,
    fold: Any,
    looked: Any,
    news: Any,
    index: Any,
    after: Any,
) -> Any:
    """Do one synchronous pass: `after` gets the new state; return how many changed by more than `HIGH`.

    A low point with one of the flags `skip` is passed over.

    References are sought among `seek_state`, `rings` cells around: those of this grid, or of the coarser one with
    `fold` x `fold` cells in one, where only its low points are references yet and lie closer together, in cells.

    After the first pass a cell is tested again only where something changed within the rings (`looked`) its search
    visited; `news` is the summed-area table of the changes of the pass before, and of this one in the end. `rough`
    holds the roughness (mm) of the coarse cells, `parts` x `parts` of these cells make one of them; an empty array
    stands for none; `index` is room for `index_references`.
    """
    seek_width = width // fold
    index_references(seek_width, seek_state, index[0], index[1], index[2])
    found = np.empty(8, np.int64)
    soft = 0.1 * (cell * 1e-3) ** 2
    changed = 0
    for k in range(len(state)):
        s = state[k]
        after[k] = s
        if not s & LOW or s & skip or s & (REF | UNPROVEN) == REF:
            continue
        if not first and count_within(news, width, k, np.int64(looked[k])) == 0:
            continue
        x, y, z = np.int64(pos[k, 0]), np.int64(pos[k, 1]), np.int64(pos[k, 2])
        q = k // width // fold * seek_width + k % width // fold
        ring, unknown = _look_around(
            seek_state, seek_pos, seek_width, cell * fold, q, x, y, rings, limit2, index, found
        )
        looked[k] = fold * ring + fold - 1
        n, r, slope, d, step = height_above(seek_pos, x, y, z, found, soft)
        least = most = 0.0
        if len(rough) > 0:
            here = rough[k // width // parts * (width // parts) + k % width // parts]
            least = rough_factor * (0.0 if here == NOT_KNOWN else here * 1e-3)
            most = rough_factor * (rough_most if here == NOT_KNOWN else here * 1e-3)
        above = -(8.0 + 0.15 * d) < r
        rise = base + (spread + slope_factor * slope) * d
        by_plane = n > 0 and above and r < min(highest, rise + least)
        perhaps = n > 0 and above and r < min(highest, rise + most)
        by_step = n > 0 and r > 0.0 and step < step_limit + step_spread * d and not s & DROPPED
        s &= ~HIGH
        if by_plane or by_step:
            s = (s | REF) & ~UNPROVEN
            if unknown or s & MAYBE_DROPPED:
                s |= UNPROVEN
        elif unknown or perhaps:
            s |= UNPROVEN
        elif not s & UNPROVEN and n >= 3 and r > TOO_HIGH + slope * (cell * 1e-3):
            s |= HIGH
        after[k] = s
        changed += ((s ^ state[k]) & ~HIGH) != 0
    height = len(state) // width
    for row in range(height):
        total = 0
        for k in range(row * width, row * width + width):
            total += ((state[k] ^ after[k]) & ~HIGH) != 0
            news[k] = total + (news[k - width] if row > 0 else 0)
    return changed


@njit(nogil=True, cache=True)
def clean(
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    rings: Any,
    limit2: Any,
    drop: Any,
    residuals: Any,
    index: Any,
    after: Any,
) -> None:
    """Re-test every reference without itself.

    `after` gets the new state, `residuals` the heights (mm) of those that stay. Without `drop` only the residuals are
    taken.
    """
    index_references(width, state, index[0], index[1], index[2])
    found = np.empty(8, np.int64)
    soft = 0.1 * (cell * 1e-3) ** 2
    for k in range(len(state)):
        s = state[k]
        after[k] = s
        residuals[k] = NOT_KNOWN
        if not s & REF:
            continue
        x, y, z = np.int64(pos[k, 0]), np.int64(pos[k, 1]), np.int64(pos[k, 2])
        _ring, unknown = _look_around(state, pos, width, cell, k, x, y, rings, limit2, index, found)
        n, r, slope, d, _step = height_above(pos, x, y, z, found, soft)
        if n >= 3:
            if drop and not s & FIXED and r > 0.3 + (0.2 + 1.2 * slope) * d:
                after[k] = s & ~REF
            else:
                residuals[k] = np.int32(np.rint(min(max(r, -1000.0), 1000.0) * 1000.0))
        if unknown:
            after[k] |= UNPROVEN
