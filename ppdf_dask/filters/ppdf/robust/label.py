"""The label of every core point (step 11)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.robust.cells import HIGH, LOW, REF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.cliffs import BLOCK, at_cliff
from ppdf_dask.filters.ppdf.robust.growth import NOT_KNOWN
from ppdf_dask.filters.ppdf.robust.surface import count_within, height_above, index_references, nearest, reach

FAR_ABOVE = 5_000
"""Millimetres above its cell's low point from where a point is sought nowhere but at cliffs."""


@njit(nogil=True, cache=True)
def label(
    x: Any,
    y: Any,
    z: Any,
    fixed: Any,
    n_core: Any,
    x0: Any,
    y0: Any,
    of_point: Any,
    floor: Any,
    known: Any,
    rough: Any,
    parts: Any,
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    rings: Any,
    limit2: Any,
    tolerance: Any,
    rough_factor: Any,
    spread: Any,
    slope_factor: Any,
    tops: Any,
    index: Any,
    ground: Any,
    unproven: Any,
) -> None:
    """Set `ground` and `unproven` of the core points.

    `of_point`, `floor`, `known` (their states) and `rough` speak of the coarse cells; `width`, `cell`, `pos` and
    `state` of the fine ones, `parts` x `parts` to a coarse one; `tops` is of `cliff_tops`, `index` room for
    `index_references`.
    """
    right, left, open_ = index
    index_references(width, state, right, left, open_)
    all_known = open_[len(open_) - 1] == 0
    found = np.empty(8, np.int64)
    soft = 0.1 * (cell * 1e-3) ** 2
    for i in range(n_core):
        ground[i] = False
        unproven[i] = False
        if len(fixed) > 0 and fixed[i]:
            ground[i] = True
            continue
        big = of_point[i]
        if not known[big] & LOW:
            unproven[i] = (known[big] & UNPROVEN) != 0
            continue
        if z[i] <= floor[big]:
            continue
        xi, yi, zi = np.int64(x[i]) - x0, np.int64(y[i]) - y0, np.int64(z[i])
        k = big
        if parts > 1:
            k = yi // cell * width + xi // cell
        is_low = zi == pos[k, 2] and xi == pos[k, 0] and yi == pos[k, 1]
        unknown = is_low and (state[k] & UNPROVEN) != 0
        only_cliff = is_low or zi - pos[k, 2] >= FAR_ABOVE or (state[k] & HIGH) != 0
        if only_cliff:
            b = k // width // BLOCK * (width // BLOCK) + k % width // BLOCK
            ground[i] = is_low and (state[k] & REF) != 0
            if ground[i] or zi > tops[b, 0]:
                unproven[i] = unknown
                continue
            unknown |= tops[b, 1] != 0
        fx, fy = xi % cell, yi % cell
        nearest(right, left, pos, width, cell, k, xi, yi, fx, fy, limit2, found)
        if not all_known:
            ring = reach(found, fx, fy, cell, rings)
            unknown |= count_within(open_, width, k, ring) > 0
        n, r, slope, d, _step = height_above(pos, xi, yi, zi, found, soft)
        if n > 0 and r > -(3.0 + slope * d):
            if at_cliff(pos, zi, found, slope):
                ground[i] = True
            elif not only_cliff:
                rise = (spread + slope_factor * slope) * d
                if rough[big] == NOT_KNOWN:
                    ground[i] = r < tolerance + rise
                    unknown |= ground[i] != (r < 4.0 * tolerance + rise)
                else:
                    ground[i] = r < min(4.0 * tolerance, tolerance + rough_factor * rough[big] * 1e-3) + rise
        unproven[i] = unknown
