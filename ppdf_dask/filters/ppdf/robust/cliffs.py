"""Cliffs: where the references around a place stand high above each other (step 11).

No roof is a reference; what stands as high as a reference beside it, where the ground itself breaks off, is its rim or
its face, however high above the plane through top and foot.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.compiled import kernel, leaf
from ppdf_dask.filters.ppdf.robust.cells import LOW, REF, UNPROVEN

BLOCK = 4
"""Cells along the edge of a block of `cliff_tops`; squares hold whole blocks, so that these hang at absolute places."""

HEIGHT = 5_000
"""Millimetres by which the references at a cliff differ."""

STEEP = 1.0
"""Slope from where their surface is a cliff's: no seed is steeper."""

NO_CLIFF = np.int32(-(2**31))
NOWHERE = np.int32(2**31 - 1)


def cliff_tops(width: int, pos: npt.NDArray[np.int32], state: npt.NDArray[np.uint8]) -> npt.NDArray[np.int32]:
    """Return for each block of cells the height (mm) above which nothing far above the ground belongs to a cliff.

    That of the highest reference of the block and the eight around it, `NO_CLIFF` where these do not differ by more
    than `HEIGHT`; and not 0 where one of their cells is unproven: then all that might be a reference counts as one.
    """
    blocks = len(state) // BLOCK**2
    spans, tops = np.empty((blocks, 3), np.int32), np.empty((blocks, 2), np.int32)
    spans[:] = NOWHERE, NO_CLIFF, 0
    tops[:] = NO_CLIFF, 0
    _find_tops(width, pos, state, spans, tops)
    return tops


@kernel
def _find_tops(width: Any, pos: Any, state: Any, spans: Any, tops: Any) -> None:
    wide = width // BLOCK
    for row in range(len(state) // width):
        for col in range(width):
            k = np.uintp(row * width + col)
            s = state[k]
            if s & (REF | UNPROVEN):
                here = np.uintp(row // BLOCK * wide + col // BLOCK)
                spans[here, 0] = min(spans[here, 0], pos[k, 2] if s & LOW else NO_CLIFF)
                spans[here, 1] = max(spans[here, 1], pos[k, 2] if s & LOW else NOWHERE)
                spans[here, 2] |= s & UNPROVEN
    for b in range(wide + 1, len(spans) - wide - 1):
        bottom, top = np.int64(NOWHERE), np.int64(NO_CLIFF)
        for start in range(b - wide - 1, b + wide, wide):
            for j in range(start, start + 3):
                bottom = min(bottom, np.int64(spans[j, 0]))
                top = max(top, np.int64(spans[j, 1]))
                tops[b, 1] |= spans[j, 2]
        if top - bottom > HEIGHT:
            tops[b, 0] = top


@leaf
def at_cliff(pos: Any, z: Any, found: Any, at: Any, slope: Any, deepest: Any) -> Any:
    """Tell whether the references `found` from `at` on make a cliff, and `z` lies between them.

    That is no higher than the highest and less than `deepest` metres below the lowest: foot and face lie far below the
    surface through top and foot.
    """
    if slope <= STEEP:
        return False
    bottom, top = np.int64(NOWHERE), np.int64(NO_CLIFF)
    for q in range(at, at + 4):
        if found[q] >= 0:
            height = np.int64(pos[found[q], 2])
            bottom, top = min(bottom, height), max(top, height)
    return bottom - 1e3 * deepest < z <= top and top - bottom > HEIGHT
