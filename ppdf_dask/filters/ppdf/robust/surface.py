"""The reference surface at a place: nearest references in four quadrants and a plane through them (paper, 2.5)."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.compiled import kernel, leaf
from ppdf_dask.filters.ppdf.robust.cells import REF, UNPROVEN

NONE = 60_000
"""Cells: no reference in this direction; farther than any search."""


Index: TypeAlias = tuple[
    npt.NDArray[np.uint16],
    npt.NDArray[np.uint16],
    npt.NDArray[np.int32],
    npt.NDArray[np.uint32],
]
"""Steps to the next reference of the row rightwards and leftwards, summed-area table of the unproven cells, and the
places of the references within their cells."""


NOWHERE = np.uint32(2**32 - 1)
"""Place of no reference; cells are narrower than 65 m."""


def room_for_index(cells: int) -> Index:
    """Return the arrays that `index_references` fills: 12 bytes per cell."""
    return (
        np.empty(cells, np.uint16),
        np.empty(cells, np.uint16),
        np.empty(cells, np.int32),
        np.empty(cells, np.uint32),
    )


def all_proven(index: Index) -> bool:
    """Tell whether no cell is unproven."""
    return bool(index[2][-1] == 0)


@leaf
def _packed(x: Any, y: Any) -> Any:
    return np.uint32(y << 16 | x)


@kernel
def index_references(width: Any, cell: Any, pos: Any, state: Any, index: Any) -> None:
    """Index a grid for `nearest`, `count_within` and `lanes.surfaces`.

    `index` gets the number of cells to the next reference of the row, the cell itself included, or `NONE`, rightwards
    and leftwards (uint16); the summed-area table of unproven cells (int32); the places of the references (uint32), mm
    from the corner of the cell, x in the lower half and y in the upper, or `NOWHERE`: with them a search touches a
    third of the memory.
    """
    right, left, unproven, place = index
    for row in range(len(state) // width):
        start = row * width
        gap = NONE
        for behind in range(width):
            k = np.uintp(start + width - 1 - behind)
            gap = 0 if state[k] & REF else min(gap + 1, NONE)
            right[k] = gap
        gap = NONE
        total = 0
        for col in range(width):
            k = np.uintp(start + col)
            is_reference = (state[k] & REF) != 0
            gap = 0 if is_reference else min(gap + 1, NONE)
            left[k] = gap
            total += (state[k] & UNPROVEN) != 0
            unproven[k] = total + (unproven[np.uintp(start + col - width)] if row > 0 else 0)
            place[k] = _packed(pos[k, 0] - col * cell, pos[k, 1] - row * cell) if is_reference else NOWHERE


@leaf
def add_reference(width: Any, cell: Any, pos: Any, k: Any, index: Any) -> None:
    """Add the reference of cell `k` to the index."""
    right, left, _unproven, place = index
    place[k] = _packed(pos[k, 0] % cell, pos[k, 1] % cell)
    start = k - k % width
    j = k
    while j >= start and right[j] > k - j:
        right[j] = k - j
        j -= 1
    j = k
    while j < start + width and left[j] > j - k:
        left[j] = j - k
        j += 1


@leaf
def count_within(table: Any, width: Any, k: Any, ring: Any) -> Any:
    """Return the sum over the square of `ring` cells around cell `k` from a summed-area table."""
    a = k - (ring + 1) * width - ring - 1
    b = k + ring * width - ring - 1
    wide = 2 * ring + 1
    return table[b + wide] - table[a + wide] - table[b] + table[a]


@leaf
def nearest(
    gap: Any,
    place: Any,
    pos: Any,
    width: Any,
    cell: Any,
    k: Any,
    fx: Any,
    fy: Any,
    along: Any,
    up: Any,
    found: Any,
    at: Any,
    done: Any,
) -> None:
    """Look in one quadrant for a nearer reference than `found[at]`, which knows those up to `done` cells away.

    `found[at]` is a cell or -1, `found[at + 4]` its squared distance or the largest. The place lies `fx`, `fy` within
    cell `k`; a reference at that very place is none. The quadrants are half-open, so that a point on an axis belongs
    to one of them, and numbered right + 2 up: `along` and `up` are 1 or -1, `gap` is the index that way. Row by row
    outwards, from reference to reference, as long as a row or a column can still hold a nearer one.
    """
    wide = cell - fx if along > 0 else fx + 1
    high = cell - fy if up > 0 else fy + 1
    best, which = found[at + 4], found[at]
    row, far2 = k, np.int64(0)
    for r in range(NONE):
        o = np.int64(gap[row]) if r > done else done + 1 + np.int64(gap[row + (done + 1) * along])
        u2 = np.int64(0) if o == 0 else (wide + (o - 1) * cell) ** 2
        while u2 + far2 <= best:
            j = row + o * along
            there = np.int64(place[j])
            u = o * cell + ((there & 65_535) - fx) * along
            v = r * cell + ((there >> 16) - fy) * up
            d2 = u * u + v * v
            inside = (u >= 0) & (v >= 0) & ((u if along == up else v) > 0)
            if inside and (d2 < best or (d2 == best and (which < 0 or before(pos, j, which)))):
                best = d2
                which = j
            o += 1 + np.int64(gap[j + along])
            u2 = (wide + (o - 1) * cell) ** 2
        row += width * up
        far2 = (high + r * cell) ** 2
        if far2 > best:
            break
    found[at] = which
    found[at + 4] = best


@leaf
def reach(found: Any, at: Any, fx: Any, fy: Any, cell: Any, rings: Any) -> Any:
    """Return how many rings of cells decide what `nearest` found: beyond them nothing could be nearer.

    `fx`, `fy` is the place within its cell; `rings` where a quadrant is empty.
    """
    for q in range(4):
        if found[at + q] < 0:
            return rings
    for ring in range(rings):
        right = (ring + 1) * cell - fx
        left = ring * cell + fx
        top = (ring + 1) * cell - fy
        bottom = ring * cell + fy
        if (
            found[at + 7] < min(right, top) ** 2
            and found[at + 6] < min(left, top) ** 2
            and found[at + 4] < min(left, bottom) ** 2
            and found[at + 5] < min(right, bottom) ** 2
        ):
            return ring
    return rings


@leaf
def before(pos: Any, j: Any, k: Any) -> Any:
    """Tell whether the low point of cell `j` comes before that of `k` in the order (z, x, y)."""
    if pos[j, 2] != pos[k, 2]:
        return pos[j, 2] < pos[k, 2]
    if pos[j, 0] != pos[k, 0]:
        return pos[j, 0] < pos[k, 0]
    return pos[j, 1] < pos[k, 1]
