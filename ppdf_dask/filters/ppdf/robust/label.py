"""The label of every core point (step 11)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Verdict
from ppdf_dask.filters.ppdf.compiled import kernel
from ppdf_dask.filters.ppdf.robust.cells import HIGH, LOW, REF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.cliffs import BLOCK, at_cliff, cliff_tops
from ppdf_dask.filters.ppdf.robust.growth import NOT_KNOWN, References
from ppdf_dask.filters.ppdf.robust.lanes import (
    ASKED,
    BATCH,
    CELL,
    COUNT,
    DISTANCE,
    FX,
    FY,
    HEIGHT,
    RINGS,
    SLOPE,
    Room,
    X,
    Y,
    Z,
    surfaces,
)
from ppdf_dask.filters.ppdf.robust.surface import all_proven, count_within

FAR_ABOVE = 5_000
"""Millimetres above its cell's low point from where a point is sought nowhere but at cliffs."""


class Tolerance(NamedTuple):
    """Up to where a point is ground, in metres above the references: see `RobustParams`.

    Attributes
    ----------
    tolerance, roughness, spread, slope : float
        `tolerance`, `roughness`, `label_spread` and `label_slope`.
    """

    tolerance: float
    roughness: float
    spread: float
    slope: float


class Points(NamedTuple):
    """The points to label, and the coarse cells they lie in.

    Attributes
    ----------
    x, y, z : numpy.ndarray
        int32, mm; the core first.
    fixed : numpy.ndarray
        Ground from the start, bool; empty: none.
    x0, y0 : int
        Corner of the grid.
    of_point, floor, known, rough : numpy.ndarray
        The cell of each point; the height below which nothing counts, the state and the roughness of each cell.
    """

    x: npt.NDArray[np.int32]
    y: npt.NDArray[np.int32]
    z: npt.NDArray[np.int32]
    fixed: npt.NDArray[np.bool_]
    x0: int
    y0: int
    of_point: npt.NDArray[np.int32]
    floor: npt.NDArray[np.int32]
    known: npt.NDArray[np.uint8]
    rough: npt.NDArray[np.int32]


def label(points: Points, n_core: int, references: References, limit: int, rule: Tolerance, room: Room) -> Verdict:
    """Tell which of the first `n_core` points are ground, by the references within `limit` mm."""
    width, cell, pos, state, index = references
    ground, unproven = np.empty(n_core, np.bool_), np.empty(n_core, np.bool_)
    known, tops = all_proven(index), cliff_tops(width, pos, state)
    rings, soft = 0 if known else -(-limit // cell), 0.1 * (cell * 1e-3) ** 2
    start = 0
    while start < n_core:
        start, count = _gather(points, n_core, width, cell, pos, state, tops, start, ground, unproven, room.place)
        surfaces(room, count, index, pos, width, cell, rings, limit * limit, soft)
        place, answer = room.place[:count], room.answer
        _decide(
            points.of_point,
            points.rough,
            width,
            pos,
            index[2],
            known,
            rule,
            ground,
            unproven,
            place,
            answer,
            room.found,
        )
    return Verdict(ground, unproven)


@kernel
def _gather(
    points: Any,
    n_core: Any,
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    tops: Any,
    start: Any,
    ground: Any,
    unproven: Any,
    place: Any,
) -> Any:
    """Label the next points that need no surface, and put the others; return the point to go on with and how many."""
    x, y, z, fixed, x0, y0, of_point, floor, known, _rough = points
    i, count = np.uintp(start), np.uintp(0)
    while i < np.uintp(n_core) and count < np.uintp(BATCH):
        big = np.uintp(of_point[i])
        pin = len(fixed) > 0 and fixed[i]
        ground[i] = pin
        unproven[i] = not pin and not known[big] & LOW and (known[big] & UNPROVEN) != 0
        if not pin and known[big] & LOW and z[i] > floor[big]:
            xi, yi, zi = np.int64(x[i]) - x0, np.int64(y[i]) - y0, np.int64(z[i])
            row, col = yi // cell, xi // cell
            k = np.uintp(row * width + col)
            is_low = zi == pos[k, 2] and xi == pos[k, 0] and yi == pos[k, 1]
            ground[i] = is_low and (state[k] & REF) != 0
            unproven[i] = is_low and (state[k] & UNPROVEN) != 0
            only_cliff = is_low or zi - pos[k, 2] >= FAR_ABOVE or (state[k] & HIGH) != 0
            settled = False
            if only_cliff:
                b = np.uintp(row // BLOCK * (width // BLOCK) + col // BLOCK)
                settled = ground[i] or zi > tops[b, 0]
                unproven[i] |= not settled and tops[b, 1] != 0
            if not settled:
                place[count, X], place[count, Y], place[count, Z] = xi, yi, zi
                place[count, FX], place[count, FY] = xi - col * cell, yi - row * cell
                place[count, CELL], place[count, ASKED] = k, 2 * np.int64(i) + only_cliff
                count += np.uintp(1)
        i += np.uintp(1)
    return np.int64(i), np.int64(count)


@kernel
def _decide(
    of_point: Any,
    rough: Any,
    width: Any,
    pos: Any,
    unproven_cells: Any,
    all_known: Any,
    rule: Any,
    ground: Any,
    unproven: Any,
    place: Any,
    answer: Any,
    found: Any,
) -> None:
    """Label the points put; `all_known` where no cell is unproven."""
    for m in range(len(place)):
        i, only_cliff = place[m, ASKED] >> 1, place[m, ASKED] & 1
        big = of_point[i]
        r, slope, d = answer[m, HEIGHT], answer[m, SLOPE], answer[m, DISTANCE]
        unknown = not all_known and count_within(unproven_cells, width, place[m, CELL], place[m, RINGS]) > 0
        deepest = 3.0 + slope * d
        if place[m, COUNT] > 0 and at_cliff(pos, place[m, Z], found, 8 * m, slope, deepest):
            ground[i] = True
        elif place[m, COUNT] > 0 and not only_cliff and r > -deepest:
            rise = (rule.spread + rule.slope * slope) * d
            if rough[big] == NOT_KNOWN:
                ground[i] = r < rule.tolerance + rise
                unknown |= ground[i] != (r < 4.0 * rule.tolerance + rise)
            else:
                most = min(4.0 * rule.tolerance, rule.tolerance + rule.roughness * rough[big] * 1e-3)
                ground[i] = r < most + rise
        unproven[i] |= unknown
