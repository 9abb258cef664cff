"""Local roughness of the ground: how far references lie below the surface of their neighbours (step 9).

Only the references below the surface are counted: vegetation mistaken for ground lies above it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.robust.cells import UNPROVEN
from ppdf_dask.filters.ppdf.robust.growth import NOT_KNOWN


@njit(nogil=True, cache=True)
def local_roughness(width: Any, height: Any, state: Any, residuals: Any, reach: Any, most: Any, out: Any) -> None:
    """Write the mean depth (mm, each at most `most`) of the negative residuals within `reach` cells to `out`.

    NOT_KNOWN where an unproven cell lies within; 0 where there is no negative residual. Running sums of integers,
    first along rows, then along columns: exact, whatever the order.
    """
    n = len(state)
    depth, number, open_ = np.empty(n, np.int32), np.empty(n, np.int16), np.empty(n, np.int16)
    for row in range(height):
        start = row * width
        d = m = u = 0
        for col in range(width + reach):
            if col < width:
                v = residuals[start + col]
                if v != NOT_KNOWN and v < 0:
                    d += min(-v, most)
                    m += 1
                u += (state[start + col] & UNPROVEN) != 0
            old = col - 2 * reach - 1
            if old >= 0:
                v = residuals[start + old]
                if v != NOT_KNOWN and v < 0:
                    d -= min(-v, most)
                    m -= 1
                u -= (state[start + old] & UNPROVEN) != 0
            if col >= reach:
                depth[start + col - reach] = d
                number[start + col - reach] = m
                open_[start + col - reach] = u
    depths, numbers, opens = np.zeros(width, np.int64), np.zeros(width, np.int64), np.zeros(width, np.int64)
    for row in range(height + reach):
        for col in range(width):
            if row < height:
                k = row * width + col
                depths[col] += depth[k]
                numbers[col] += number[k]
                opens[col] += open_[k]
            if row > 2 * reach:
                k = (row - 2 * reach - 1) * width + col
                depths[col] -= depth[k]
                numbers[col] -= number[k]
                opens[col] -= open_[k]
            if row >= reach:
                k = (row - reach) * width + col
                if opens[col] > 0:
                    out[k] = NOT_KNOWN
                elif numbers[col] > 0:
                    out[k] = depths[col] // numbers[col]
                else:
                    out[k] = 0
