"""The finer cells of the second growth (step 10)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Cloud
from ppdf_dask.filters.ppdf.compiled import kernel
from ppdf_dask.filters.ppdf.robust.cells import DROPPED, HIGH, LOW, MAYBE_DROPPED, ROOF, Cells


def halve(
    cloud: Cloud, cells: Cells, state: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8]]:
    """Cut each cell in four and take their lowest points; return their positions and states.

    The low point of the cell keeps its state; the others start as candidates, and as roof where the cell's is.
    """
    fine_pos, fine = np.empty((4 * len(state), 3), np.int32), np.zeros(4 * len(state), np.uint8)
    x, y, z, corner = cloud.x, cloud.y, cloud.z, (cells.x0, cells.y0)
    _halve(x, y, z, corner, cells.of_point, cells.pos, cells.floor, state, cells.width, cells.cell // 2, fine_pos, fine)
    return fine_pos, fine


@kernel
def _halve(
    x: Any,
    y: Any,
    z: Any,
    corner: Any,
    of_point: Any,
    pos: Any,
    floor: Any,
    state: Any,
    width: Any,
    half: Any,
    fine_pos: Any,
    fine: Any,
) -> None:
    wide = 2 * width
    for i in range(len(x)):
        k = of_point[i]
        if not state[k] & LOW or z[i] <= floor[k]:
            continue
        xi = x[i] - corner[0]
        yi = y[i] - corner[1]
        f = yi // half * wide + xi // half
        if fine[f]:
            if z[i] > fine_pos[f, 2]:
                continue
            if z[i] == fine_pos[f, 2] and (xi > fine_pos[f, 0] or (xi == fine_pos[f, 0] and yi >= fine_pos[f, 1])):
                continue
        fine_pos[f, 0] = xi
        fine_pos[f, 1] = yi
        fine_pos[f, 2] = z[i]
        fine[f] = LOW | (state[k] & (DROPPED | ROOF | MAYBE_DROPPED | HIGH))
    for k in range(len(state)):
        if state[k] & LOW:
            f = pos[k, 1] // half * wide + pos[k, 0] // half
            fine[f] = state[k]
            for axis in range(3):  # assigning a slice would compile the text of its error too: two seconds
                fine_pos[f, axis] = pos[k, axis]
        elif state[k]:
            f = k // width * 2 * wide + k % width * 2
            fine[f] = fine[f + 1] = fine[f + wide] = fine[f + wide + 1] = state[k]
