"""Growth of the references over the low points and one cleaning round (steps 7 and 8)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.robust.cells import DROPPED, FIXED, LOW, MAYBE_DROPPED, REF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.surface import height_above, nearest


@njit(nogil=True, cache=True)
def grow(width: Any, cell: Any, pos: Any, state: Any, rings: Any, limit2: Any, after: Any) -> Any:
    """One synchronous pass: `after` gets the new state; return how many states changed."""
    found = np.empty(4, np.int64)
    soft = 0.1 * (cell * 1e-3) ** 2
    changed = 0
    for k in range(len(state)):
        s = state[k]
        after[k] = s
        if not s & LOW or s & (REF | UNPROVEN) == REF:
            continue
        x, y, z = np.int64(pos[k, 0]), np.int64(pos[k, 1]), np.int64(pos[k, 2])
        unknown = nearest_others(state, pos, width, cell, k, x, y, rings, limit2, found)
        n, r, slope, d, step = height_above(pos, x, y, z, found, soft)
        by_plane = n > 0 and -(8.0 + 0.15 * d) < r < min(1.5, 0.3 + (0.15 + 0.4 * slope) * d)
        by_step = n > 0 and r > 0.0 and step < 0.3 + 0.15 * d and not s & DROPPED
        if by_plane or (by_step and not s & MAYBE_DROPPED):
            s = (s | REF) & ~UNPROVEN
            if unknown:
                s |= UNPROVEN
        elif by_step:
            s |= REF | UNPROVEN
        elif unknown:
            s |= UNPROVEN
        if s != state[k]:
            changed += 1
            after[k] = s
    return changed


@njit(nogil=True, cache=True)
def nearest_others(
    state: Any, pos: Any, width: Any, cell: Any, k: Any, x: Any, y: Any, rings: Any, limit2: Any, found: Any
) -> Any:
    """`nearest`, but blind to cell `k` itself."""
    own = state[k]
    state[k] = 0
    unknown = nearest(state, pos, width, cell, k, x, y, rings, limit2, found)
    state[k] = own
    return unknown


@njit(nogil=True, cache=True)
def clean(width: Any, cell: Any, pos: Any, state: Any, rings: Any, limit2: Any, after: Any) -> None:
    """Re-test every reference without itself: `after` gets the new state."""
    found = np.empty(4, np.int64)
    soft = 0.1 * (cell * 1e-3) ** 2
    for k in range(len(state)):
        s = state[k]
        after[k] = s
        if not s & REF or s & FIXED:
            continue
        x, y, z = np.int64(pos[k, 0]), np.int64(pos[k, 1]), np.int64(pos[k, 2])
        unknown = nearest_others(state, pos, width, cell, k, x, y, rings, limit2, found)
        n, r, slope, d, _step = height_above(pos, x, y, z, found, soft)
        if n >= 3 and r > 0.3 + (0.2 + 1.2 * slope) * d:
            after[k] = s & ~REF
        if unknown:
            after[k] |= UNPROVEN
