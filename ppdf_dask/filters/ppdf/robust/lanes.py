"""The surface at many places: the cells around each searched, and the planes computed, without branches.

A search from reference to reference is a chain of branches that no processor foretells. Here all cells around a place
are looked at in the same order, columns side by side, and planes are computed for many places side by side, so that the
compiler takes several in one instruction. What the cells around leave open is searched on from there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.compiled import kernel, leaf
from ppdf_dask.filters.ppdf.robust.surface import Index, before, nearest, reach

LANES = 64
"""Places whose planes are computed side by side."""

BATCH = 4096
"""Places asked for in one call: with what is known of them they fit a processor's second cache."""

REACH = 3
"""Cells on each side that are looked at without branches."""

COLUMNS = np.uint64(8)
"""Columns taken together, from `REACH` to the left on: what an instruction takes."""

LARGEST_CELL = 6_500
"""Millimetres: squared distances within the cells around fit 32 bits up to this; larger cells take the other way."""

# Offsets in the room of integers: the places of the references around, and for each column the nearest in four
# quadrants (squared distance and row) and whether two were equally near. All in one array, at constant distances, or
# the compiler must fear that they overlap.
_BEST = np.uint64(2 * REACH + 1) * COLUMNS
_WHICH = _BEST + np.uint64(4) * COLUMNS
_TIES = _WHICH + np.uint64(4) * COLUMNS

# Offsets in the room of floats: differences to four references, whether they are there, how many are, then height
# and slope.
_N = np.uint64(LANES)
_DY, _DZ, _SOME, _COUNT = (np.uint64(n * LANES) for n in (4, 8, 12, 16))
_RISE, _TILT = np.uint64(17 * LANES), np.uint64(18 * LANES)

NEVER = np.int32(2**31 - 1)
"""Squared distance of no reference."""

ZERO = np.int32(0)


class Room(NamedTuple):
    """The room for `BATCH` places.

    Attributes
    ----------
    ints : numpy.ndarray
        What one search computes with.
    floats : numpy.ndarray
        What the planes of `LANES` places are computed with.
    found : numpy.ndarray
        What `nearest` finds, 8 for each place.
    place : numpy.ndarray
        A row for each place: `X`, `Y`, `Z` and within its cell `FX`, `FY`, mm; its `CELL` in the grid of the
        references; `ASKED`, whatever the caller wants to remember of it; `COUNT`, how many quadrants have a
        reference, `RINGS`, how many rings decide that, and `OPEN`, whether one of their cells is unproven.
    answer : numpy.ndarray
        A row for each place, m: `HEIGHT` above the surface of the references and its `SLOPE`; `DISTANCE` from and
        height (`STEP`) above the nearest one.
    """

    ints: npt.NDArray[np.int32]
    floats: npt.NDArray[np.float64]
    found: npt.NDArray[np.int64]
    place: npt.NDArray[np.int64]
    answer: npt.NDArray[np.float64]


X, Y, Z, FX, FY, CELL, ASKED, COUNT, RINGS, OPEN = range(10)
HEIGHT, SLOPE, DISTANCE, STEP = range(4)


def room_for_lanes() -> Room:
    """Return the room."""
    ints, floats = np.empty(int(_TIES + COLUMNS), np.int32), np.empty(19 * LANES)
    found, place = np.empty(8 * BATCH, np.int64), np.empty((BATCH, 10), np.int64)
    return Room(ints, floats, found, place, np.empty((BATCH, 4)))


@kernel
def put_low_points(cells: Any, asked: Any, width: Any, cell: Any, half: Any, pos: Any, place: Any) -> None:
    """Set the places from the low points of `cells`, which ascend, of a grid `width` wide with edges of `cell` mm.

    The references are in the same grid (`half` 0) or in one with half as many rows and columns (`half` 1).
    """
    row = np.int64(cells[0]) // width
    for i in range(len(cells)):
        k = np.int64(cells[i])
        while k >= (row + 1) * width:
            row += 1
        q_row, q_col = row >> half, (k - row * width) >> half
        x, y = np.int64(pos[k, 0]), np.int64(pos[k, 1])
        place[i, X], place[i, Y], place[i, Z] = x, y, pos[k, 2]
        place[i, FX], place[i, FY] = x - q_col * (cell << half), y - q_row * (cell << half)
        place[i, CELL], place[i, ASKED] = q_row * (width >> half) + q_col, asked[i]


@leaf
def _take(best: Any, which: Any, tie: Any, d2: Any, row: Any) -> Any:
    return min(best, d2), row if d2 < best else which, np.int32(tie | np.int32(d2 == best))


@leaf
def _distance(ints: Any, at: Any, dx: Any, dy: Any) -> Any:
    there = ints[at]
    dx = np.int32(dx + (there & np.int32(65_535)))
    dy = np.int32(dy + (there >> np.int32(16) & np.int32(65_535)))
    d2 = np.int32(np.int32(dx * dx) + np.int32(dy * dy))
    return dx, dy, NEVER if (there == np.int32(-1)) | (d2 == ZERO) else d2


@leaf
def _below(ints: Any, c: Any, row: Any, dx: Any, dy: Any, b0: Any, w0: Any, b1: Any, w1: Any, tie: Any) -> Any:
    dx, _dy, d2 = _distance(ints, c + np.uint64(row) * COLUMNS, dx, dy)
    b0, w0, tie = _take(b0, w0, tie, NEVER if dx >= ZERO else d2, row)
    b1, w1, tie = _take(b1, w1, tie, d2 if dx >= ZERO else NEVER, row)
    return b0, w0, b1, w1, tie


@leaf
def _above(ints: Any, c: Any, row: Any, dx: Any, dy: Any, b2: Any, w2: Any, b3: Any, w3: Any, tie: Any) -> Any:
    dx, _dy, d2 = _distance(ints, c + np.uint64(row) * COLUMNS, dx, dy)
    b2, w2, tie = _take(b2, w2, tie, NEVER if dx > ZERO else d2, row)
    b3, w3, tie = _take(b3, w3, tie, d2 if dx > ZERO else NEVER, row)
    return b2, w2, b3, w3, tie


@leaf
def _columns(ints: Any, cell: Any, fx: Any, fy: Any, start: Any) -> None:
    """Find in each column around the nearest reference of each quadrant."""
    for c in range(COLUMNS):
        x = np.int32((np.int32(c) - np.int32(REACH)) * cell - fx)
        b0 = b1 = b2 = b3 = start
        w0 = w1 = w2 = w3 = tie = ZERO
        b0, w0, b1, w1, tie = _below(ints, c, np.int32(0), x, np.int32(-3 * cell - fy), b0, w0, b1, w1, tie)
        b0, w0, b1, w1, tie = _below(ints, c, np.int32(1), x, np.int32(-2 * cell - fy), b0, w0, b1, w1, tie)
        b0, w0, b1, w1, tie = _below(ints, c, np.int32(2), x, np.int32(-cell - fy), b0, w0, b1, w1, tie)
        b2, w2, b3, w3, tie = _above(ints, c, np.int32(4), x, np.int32(cell - fy), b2, w2, b3, w3, tie)
        b2, w2, b3, w3, tie = _above(ints, c, np.int32(5), x, np.int32(2 * cell - fy), b2, w2, b3, w3, tie)
        b2, w2, b3, w3, tie = _above(ints, c, np.int32(6), x, np.int32(3 * cell - fy), b2, w2, b3, w3, tie)
        middle = np.int32(REACH)
        dx, dy, d2 = _distance(ints, c + np.uint64(REACH) * COLUMNS, x, np.int32(-fy))
        right = (dx > ZERO) | ((dx == ZERO) & (dy < ZERO))
        up = (dy > ZERO) | ((dy == ZERO) & (dx > ZERO))
        b0, w0, tie = _take(b0, w0, tie, NEVER if right | up else d2, middle)
        b1, w1, tie = _take(b1, w1, tie, NEVER if up else (d2 if right else NEVER), middle)
        b2, w2, tie = _take(b2, w2, tie, NEVER if right else (d2 if up else NEVER), middle)
        b3, w3, tie = _take(b3, w3, tie, d2 if right & up else NEVER, middle)
        ints[_BEST + c], ints[_BEST + COLUMNS + c] = b0, b1
        ints[_BEST + np.uint64(2) * COLUMNS + c], ints[_BEST + np.uint64(3) * COLUMNS + c] = b2, b3
        ints[_WHICH + c], ints[_WHICH + COLUMNS + c] = w0, w1
        ints[_WHICH + np.uint64(2) * COLUMNS + c], ints[_WHICH + np.uint64(3) * COLUMNS + c] = w2, w3
        ints[_TIES + c] = tie


@kernel
def _around(
    ints: Any, found: Any, place: Any, count: Any, index_place: Any, width: Any, cell: Any, limit2: Any
) -> None:
    """Find for each place what `nearest` would among the cells around; `COUNT` gets 1 where two are equally near."""
    start = np.int32(min(limit2, np.int64(NEVER) - 1) + 1)
    for i in range(count):
        k = place[i, CELL]
        for r in range(2 * REACH + 1):
            first = np.uint64(k + (r - REACH) * width - REACH)
            for c in range(COLUMNS):
                ints[np.uint64(r) * COLUMNS + c] = np.int32(index_place[first + c])
        _columns(ints, np.int32(cell), np.int32(place[i, FX]), np.int32(place[i, FY]), start)
        tie = ZERO
        for c in range(COLUMNS):
            tie |= ints[_TIES + c]
        for q in range(4):
            first = np.uint64(q) * COLUMNS
            best = start
            for c in range(COLUMNS):
                best = min(best, ints[_BEST + first + c])
            column, times = ZERO, ZERO
            for c in range(COLUMNS):
                column = max(column, np.int32(c) if ints[_BEST + first + c] == best else ZERO)
                times += np.int32(ints[_BEST + first + c] == best)
            tie |= np.int32(times > np.int32(1)) & np.int32(best < start)
            which = np.int64(ints[_WHICH + first + np.uint64(column)])
            some = best < start
            found[8 * i + q] = k + (which - REACH) * width + np.int64(column) - REACH if some else -1
            found[8 * i + 4 + q] = np.int64(best) if some else limit2
        place[i, COUNT] = tie


@kernel
def _onwards(
    found: Any,
    place: Any,
    count: Any,
    right: Any,
    left: Any,
    index_place: Any,
    pos: Any,
    width: Any,
    cell: Any,
    limit2: Any,
    rings: Any,
    together: Any,
) -> None:
    """Search what the cells around leave open, or everything where they were not looked at."""
    for i in range(count):
        k, at = place[i, CELL], 8 * i
        fx, fy = place[i, FX], place[i, FY]
        known = np.int64(REACH if together and not place[i, COUNT] else -1)
        for q in range(4):
            if known < 0:
                found[at + q], found[at + 4 + q] = -1, limit2
            to_side = (known + 1) * cell - fx if q & 1 else known * cell + fx
            to_end = (known + 1) * cell - fy if q & 2 else known * cell + fy
            if known < 0 or found[at + 4 + q] >= min(to_side, to_end) ** 2:
                way, along = (right, 1) if q & 1 else (left, -1)
                nearest(way, index_place, pos, width, cell, k, fx, fy, along, 1 if q & 2 else -1, found, at + q, known)
        if rings > 0:
            place[i, RINGS] = reach(found, at, fx, fy, cell, rings)


def surfaces(
    room: Room,
    count: int,
    index: Index,
    pos: npt.NDArray[np.int32],
    width: int,
    cell: int,
    rings: int,
    limit2: int,
    soft: float,
) -> None:
    """Find the surface at the first `count` places; the answers are in `room`.

    `index`, `pos`, `width` and `cell` are of the grid of the references, sought up to the squared distance `limit2`;
    `rings` as for `reach`, or 0 where nobody asks for it; `soft` is added to squared distances (m2) before they weigh.
    """
    ints, floats, found, place, answer = room
    right, left, _unproven, index_place = index
    together = cell <= LARGEST_CELL
    if together:
        _around(ints, found, place, count, index_place, width, cell, limit2)
    _onwards(found, place, count, right, left, index_place, pos, width, cell, limit2, rings, together)
    _planes(floats, found, place, count, answer, pos, soft)


@leaf
def _nearer(pos: Any, found: Any, at: Any, than: Any) -> Any:
    d2, other = found[at + 4], found[than + 4]
    return d2 < other or (d2 == other and before(pos, found[at], found[than]))


@kernel
def _planes(floats: Any, found: Any, place: Any, count: Any, answer: Any, pos: Any, soft: Any) -> None:
    """Compute the surface through the references found: with three or four a plane, else a mean."""
    for begin in range(0, count, LANES):
        lanes = min(LANES, count - begin)
        for lane in range(lanes):
            i = begin + lane
            x, y, z = place[i, X], place[i, Y], place[i, Z]
            n, near = 0, -1
            for q in range(4):
                at, k = 8 * i + q, q * LANES + lane
                j = found[at]
                some = j >= 0
                n += some
                # A reference that is not there weighs nothing, wherever it is.
                j = max(j, np.int64(0))
                floats[k] = (np.int64(pos[j, 0]) - x) * 1e-3
                floats[k + 4 * LANES] = (np.int64(pos[j, 1]) - y) * 1e-3
                floats[k + 8 * LANES] = (np.int64(pos[j, 2]) - z) * 1e-3
                floats[k + 12 * LANES] = 1.0 if some else 0.0
                if some and (near < 0 or _nearer(pos, found, at, near)):
                    near = at
            floats[16 * LANES + lane] = n
            place[i, COUNT] = n
            answer[i, DISTANCE] = answer[i, STEP] = 0.0
            if n > 0:
                answer[i, DISTANCE] = np.sqrt(found[near + 4] * 1e-6)
                answer[i, STEP] = (z - np.int64(pos[found[near], 2])) * 1e-3
        _side_by_side(floats, lanes, soft)
        for lane in range(lanes):
            answer[begin + lane, HEIGHT] = floats[17 * LANES + lane]
            answer[begin + lane, SLOPE] = floats[18 * LANES + lane]


@leaf
def _side_by_side(floats: Any, count: Any, soft: Any) -> None:
    """Compute height above the surface and its slope for all lanes, without a branch."""
    for i in range(np.uint64(count)):
        x0, x1, x2, x3 = floats[i], floats[i + _N], floats[i + np.uint64(2) * _N], floats[i + np.uint64(3) * _N]
        k = i + _DY
        y0, y1, y2, y3 = floats[k], floats[k + _N], floats[k + np.uint64(2) * _N], floats[k + np.uint64(3) * _N]
        k = i + _DZ
        z0, z1, z2, z3 = floats[k], floats[k + _N], floats[k + np.uint64(2) * _N], floats[k + np.uint64(3) * _N]
        k = i + _SOME
        s0, s1, s2, s3 = floats[k], floats[k + _N], floats[k + np.uint64(2) * _N], floats[k + np.uint64(3) * _N]
        n = floats[i + _COUNT]
        weak = soft if n > 2.0 else 1e-4
        d0, d1 = x0 * x0 + y0 * y0 + weak, x1 * x1 + y1 * y1 + weak
        d2, d3 = x2 * x2 + y2 * y2 + weak, x3 * x3 + y3 * y3 + weak
        w0, w1, w2, w3 = s0 / d0, s1 / d1, s2 / d2, s3 / d3
        ws = w0 + w1 + w2 + w3
        ws = ws if n > 0.0 else 1.0
        xm = (w0 * x0 + w1 * x1 + w2 * x2 + w3 * x3) / ws
        ym = (w0 * y0 + w1 * y1 + w2 * y2 + w3 * y3) / ws
        zm = (w0 * z0 + w1 * z1 + w2 * z2 + w3 * z3) / ws
        scale = n / ws
        w0, w1, w2, w3 = s0 * scale / d0, s1 * scale / d1, s2 * scale / d2, s3 * scale / d3
        x0, x1, x2, x3 = x0 - xm, x1 - xm, x2 - xm, x3 - xm
        y0, y1, y2, y3 = y0 - ym, y1 - ym, y2 - ym, y3 - ym
        z0, z1, z2, z3 = z0 - zm, z1 - zm, z2 - zm, z3 - zm
        sxx = soft + w0 * x0 * x0 + w1 * x1 * x1 + w2 * x2 * x2 + w3 * x3 * x3
        sxy = w0 * x0 * y0 + w1 * x1 * y1 + w2 * x2 * y2 + w3 * x3 * y3
        syy = soft + w0 * y0 * y0 + w1 * y1 * y1 + w2 * y2 * y2 + w3 * y3 * y3
        sxz = w0 * x0 * z0 + w1 * x1 * z1 + w2 * x2 * z2 + w3 * x3 * z3
        syz = w0 * y0 * z0 + w1 * y1 * z1 + w2 * y2 * z2 + w3 * y3 * z3
        det = sxx * syy - sxy * sxy
        a = (sxz * syy - syz * sxy) / det
        b = (syz * sxx - sxz * sxy) / det
        slope = np.sqrt(a * a + b * b)
        less = 3.0 / slope if slope > 3.0 else 1.0
        floats[i + _RISE] = a * less * xm + b * less * ym - zm if n > 2.0 else -zm
        floats[i + _TILT] = min(slope, 3.0) if n > 2.0 else 0.0
