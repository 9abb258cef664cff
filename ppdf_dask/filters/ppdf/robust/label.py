"""The label of every core point (step 9)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.robust.cells import LOW, REF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.surface import height_above, nearest


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
    width: Any,
    cell: Any,
    pos: Any,
    floor: Any,
    state: Any,
    rings: Any,
    limit2: Any,
    tolerance: Any,
    ground: Any,
    unproven: Any,
) -> None:
    """Set `ground` and `unproven` of the core points."""
    found = np.empty(4, np.int64)
    soft = 0.1 * (cell * 1e-3) ** 2
    for i in range(n_core):
        k = of_point[i]
        s = state[k]
        ground[i] = False
        unproven[i] = False
        if len(fixed) > 0 and fixed[i]:
            ground[i] = True
            continue
        if not s & LOW:
            unproven[i] = s & UNPROVEN
            continue
        if z[i] <= floor[k]:
            continue
        xi, yi, zi = np.int64(x[i]) - x0, np.int64(y[i]) - y0, np.int64(z[i])
        if zi == pos[k, 2] and xi == pos[k, 0] and yi == pos[k, 1]:
            ground[i] = s & REF
            unproven[i] = s & UNPROVEN
            continue
        if zi - pos[k, 2] >= 5000:
            continue
        unproven[i] = nearest(state, pos, width, cell, k, xi, yi, rings, limit2, found)
        n, r, slope, d, _step = height_above(pos, xi, yi, zi, found, soft)
        if n > 0:
            ground[i] = -(3.0 + slope * d) < r < tolerance + (0.1 + 0.5 * slope) * d
