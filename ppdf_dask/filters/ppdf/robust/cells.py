"""The grid of cells over the loaded area: the lowest point of each cell, its state, low outliers (steps 1 and 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Cloud
from ppdf_dask.filters.ppdf.compiled import kernel, leaf

SQUARE = 16
"""Cells along the edge of the largest plane square."""

REF = np.uint8(1)
"""The cell's low point is a reference."""

UNPROVEN = np.uint8(2)
"""Whether it is a reference could change with a wider known area; without LOW: the cell itself is not known."""

LOW = np.uint8(4)
"""The cell has a low point."""

DROPPED = np.uint8(8)
"""A seed of a patch that was not believed: growth may take it back, but not for being near a reference."""

MAYBE_DROPPED = np.uint8(16)
"""It is not proven whether the low point is DROPPED or ROOF."""

FIXED = np.uint8(32)
"""The low point is ground by decree."""

ROOF = np.uint8(64)
"""The low point belongs to a raised patch: never a reference."""

HIGH = np.uint8(128)
"""Nothing of the cell can be ground: its low point lies too far above the references around it."""

OUTLIER_ROUNDS = 2
OUTLIER_DEPTH = 1000
"""A low point this far (mm) below all but two of its neighbours is an outlier."""

NO_FLOOR = np.int32(-(2**31))


@dataclass(frozen=True)
class Cells:
    """The padded grid of cells; a cell is addressed by ``row * width + column``."""

    width: int
    height: int
    cell: int
    x0: int
    y0: int
    of_point: npt.NDArray[np.int32]
    pos: npt.NDArray[np.int32]
    floor: npt.NDArray[np.int32]
    state: npt.NDArray[np.uint8]


@kernel
def _locate(x: Any, y: Any, x0: Any, y0: Any, cell: Any, width: Any, of_point: Any) -> None:
    for i in range(len(x)):
        of_point[i] = (y[i] - y0) // cell * width + (x[i] - x0) // cell


@kernel
def _lowest(x: Any, y: Any, z: Any, fixed: Any, x0: Any, y0: Any, of_point: Any, pos: Any, state: Any) -> None:
    for i in range(len(x)):
        k = np.uintp(of_point[i])
        s = state[k]
        if s & UNPROVEN:
            continue
        pin = len(fixed) > 0 and fixed[i]
        xi = x[i] - x0
        yi = y[i] - y0
        if s & LOW:
            if s & FIXED and not pin:
                continue
            if pin == ((s & FIXED) != 0):
                if z[i] > pos[k, 2]:
                    continue
                if z[i] == pos[k, 2] and (xi > pos[k, 0] or (xi == pos[k, 0] and yi >= pos[k, 1])):
                    continue
        pos[k, 0] = xi
        pos[k, 1] = yi
        pos[k, 2] = z[i]
        state[k] = LOW | FIXED | REF if pin else LOW


@leaf
def _around(width: Any, pos: Any, state: Any, k: Any) -> Any:
    """Return how many of the 24 cells around `k` have a low point, the third lowest, and whether one is not known."""
    first = second = third = np.int64(1) << 40
    n = 0
    unknown = False
    for dr in range(-2, 3):
        for j in range(k + dr * width - 2, k + dr * width + 3):
            if j == k:
                continue
            if state[j] & LOW:
                n += 1
                z = np.int64(pos[j, 2])
                first, z = min(first, z), max(first, z)
                second, z = min(second, z), max(second, z)
                third = min(third, z)
            elif state[j] & UNPROVEN:
                unknown = True
    return n, third, unknown


@kernel
def _flag_outliers(width: Any, pos: Any, floor: Any, state: Any, limit: Any, again: Any) -> None:
    """Mark in `again` the cells whose low point goes (1) or cannot be judged (2)."""
    for k in range(len(state)):
        again[k] = 0
        if not state[k] & LOW or state[k] & FIXED:
            continue
        z = np.int64(pos[k, 2])
        level = -1  # the point itself is counted too
        for dr in range(-2, 3):
            for j in range(k + dr * width - 2, k + dr * width + 3):
                level += ((state[j] & LOW) != 0) & (pos[j, 2] < z + limit)
            if level >= 3:
                break
        if level >= 3:
            continue
        n, third, unknown = _around(width, pos, state, k)
        if unknown:
            again[k] = 2
        elif n >= 6:
            again[k] = 1
            floor[k] = min(third - limit, z + limit)


@kernel
def _next_lowest(
    x: Any, y: Any, z: Any, x0: Any, y0: Any, of_point: Any, pos: Any, floor: Any, state: Any, again: Any
) -> None:
    for k in range(len(state)):
        if again[k] == 2:
            state[k] = UNPROVEN
        elif again[k] == 1:
            state[k] = 0
    for i in range(len(x)):
        k = of_point[i]
        if again[k] != 1 or z[i] <= floor[k]:
            continue
        xi = x[i] - x0
        yi = y[i] - y0
        if state[k] & LOW:
            if z[i] > pos[k, 2]:
                continue
            if z[i] == pos[k, 2] and (xi > pos[k, 0] or (xi == pos[k, 0] and yi >= pos[k, 1])):
                continue
        pos[k, 0] = xi
        pos[k, 1] = yi
        pos[k, 2] = z[i]
        state[k] = LOW


def build(cloud: Cloud, cell: int, pad: int) -> Cells:
    """Lay the grid over the cloud with a margin of `pad` cells and take the lowest point of each cell."""
    ox, oy = cloud.origin
    square = SQUARE * cell

    def span(v: npt.NDArray[np.int32], o: int) -> tuple[int, int]:
        low = ((int(v.min()) + o) // cell - pad) * cell // square * square
        high = -(-((int(v.max()) + o) // cell + 1 + pad) * cell // square) * square
        return low, (high - low) // cell

    ax, width = span(cloud.x, ox)
    ay, height = span(cloud.y, oy)
    x0, y0 = ax - ox, ay - oy
    n = width * height
    of_point = np.empty(cloud.n, np.int32)
    pos = np.zeros((n, 3), np.int32)
    floor = np.full(n, NO_FLOOR, np.int32)
    raster = np.zeros((height, width), np.uint8)
    if cloud.known is not None:
        k = cloud.known
        c0, c1 = -(-(k.x0 - ax) // cell), (k.x1 - ax) // cell
        r0, r1 = -(-(k.y0 - ay) // cell), (k.y1 - ay) // cell
        inside = np.zeros((height, width), np.bool_)
        inside[max(r0, 0) : max(r1, 0), max(c0, 0) : max(c1, 0)] = True
        raster[~inside] = UNPROVEN
    state = raster.reshape(-1)
    _locate(cloud.x, cloud.y, x0, y0, cell, width, of_point)
    fixed = cloud.fixed if cloud.fixed is not None else np.empty(0, np.bool_)
    _lowest(cloud.x, cloud.y, cloud.z, fixed, x0, y0, of_point, pos, state)
    return Cells(width, height, cell, x0, y0, of_point, pos, floor, state)


def drop_low_outliers(cloud: Cloud, cells: Cells) -> None:
    """Remove low points that lie alone more than 1 m below their surroundings (step 2)."""
    again = np.empty(len(cells.state), np.uint8)
    for _ in range(OUTLIER_ROUNDS):
        _flag_outliers(cells.width, cells.pos, cells.floor, cells.state, OUTLIER_DEPTH, again)
        _next_lowest(
            cloud.x, cloud.y, cloud.z, cells.x0, cells.y0, cells.of_point, cells.pos, cells.floor, cells.state, again
        )
