"""Local roughness of the ground: how far references lie below the surface of their neighbours (step 9).

Only the references below the surface are counted: vegetation mistaken for ground lies above it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.robust.cells import UNPROVEN
from ppdf_dask.filters.ppdf.robust.growth import NOT_KNOWN


def local_roughness(
    width: int, state: npt.NDArray[np.uint8], residuals: npt.NDArray[np.int32], reach: int, most: int
) -> npt.NDArray[np.int32]:
    """Return the mean depth (mm, each at most `most`) of the negative residuals within `reach` cells.

    NOT_KNOWN where an unproven cell lies within; 0 where there is no negative residual. Sums of integers: exact,
    whatever the order.
    """
    below = (residuals < 0) & (residuals != NOT_KNOWN)
    depth = np.where(below, np.minimum(-residuals, most), 0)
    sums = _around(depth.reshape(-1, width), reach)
    # Both counts in one number: there are fewer than 65 536 cells around.
    counts = _around((below + ((state & UNPROVEN != 0).astype(np.int32) << 16)).reshape(-1, width), reach)
    rough: npt.NDArray[np.int32] = sums // np.maximum(counts & 65_535, 1)
    rough[counts >> 16 != 0] = NOT_KNOWN
    return rough.reshape(-1)


def _around(values: npt.NDArray[np.int32], reach: int) -> npt.NDArray[np.int32]:
    """Return the sum over the cells up to `reach` away in each direction."""
    for _ in range(2):
        sums = np.zeros((values.shape[0] + 2 * reach + 1, values.shape[1]), np.int32)
        np.cumsum(values, axis=0, out=sums[reach + 1 : -reach])
        sums[-reach:] = sums[-reach - 1]
        values = (sums[2 * reach + 1 :] - sums[: -2 * reach - 1]).T
    return values
