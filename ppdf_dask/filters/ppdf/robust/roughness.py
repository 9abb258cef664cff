"""Local roughness of the ground: how far references lie below the surface of their neighbours (step 9).

Only the references below the surface are counted: vegetation mistaken for ground lies above it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.compiled import kernel, leaf
from ppdf_dask.filters.ppdf.robust.cells import UNPROVEN
from ppdf_dask.filters.ppdf.robust.growth import NOT_KNOWN


def local_roughness(
    width: int, state: npt.NDArray[np.uint8], residuals: npt.NDArray[np.int32], reach: int, most: int
) -> npt.NDArray[np.int32]:
    """Return the mean depth (mm, each at most `most`) of the negative residuals within `reach` cells.

    NOT_KNOWN where an unproven cell lies within; 0 where there is no negative residual. Sums of integers: exact,
    whatever the order.
    """
    rough, across, column = (
        np.empty(len(state), np.int32),
        np.empty((2, len(state)), np.int32),
        np.empty((2, width), np.int32),
    )
    _take_means(width, state, residuals, reach, most, across, column, rough)
    return rough


@kernel
def _take_means(
    width: Any, state: Any, residuals: Any, reach: Any, most: Any, across: Any, column: Any, rough: Any
) -> None:
    """Slide a sum along each row into `across`, and a sum of these along the columns.

    Beside the depths go two counts in one number, as there are fewer than 65 536 cells around: of the residuals, and of
    the unproven cells above them.
    """
    height = len(state) // width
    for row in range(height):
        depth = count = np.int32(0)
        for col in range(-reach, width):
            if col + reach < width:
                k = np.uintp(row * width + col + reach)
                depth += _depth(residuals[k], most)
                count += _count(residuals[k], state[k])
            if col > reach:
                k = np.uintp(row * width + col - reach - 1)
                depth -= _depth(residuals[k], most)
                count -= _count(residuals[k], state[k])
            if col >= 0:
                across[0, row * width + col], across[1, row * width + col] = depth, count
    for col in range(width):
        column[0, col] = column[1, col] = 0
    for row in range(-reach, height):
        if row + reach < height:
            for col in range(width):
                column[0, col] += across[0, (row + reach) * width + col]
                column[1, col] += across[1, (row + reach) * width + col]
        if row > reach:
            for col in range(width):
                column[0, col] -= across[0, (row - reach - 1) * width + col]
                column[1, col] -= across[1, (row - reach - 1) * width + col]
        if row >= 0:
            for col in range(width):
                mean = column[0, col] // max(column[1, col] & 65_535, 1)
                rough[row * width + col] = NOT_KNOWN if column[1, col] >> 16 else mean


@leaf
def _depth(residual: Any, most: Any) -> Any:
    return np.int32(min(-residual, most) if NOT_KNOWN < residual < 0 else 0)


@leaf
def _count(residual: Any, state: Any) -> Any:
    return np.int32(NOT_KNOWN < residual < 0) + (np.int32((state & UNPROVEN) != 0) << 16)
