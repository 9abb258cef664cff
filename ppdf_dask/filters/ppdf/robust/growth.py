"""Growth of the references over low points and one cleaning round (steps 7, 8 and 10)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.compiled import kernel, leaf
from ppdf_dask.filters.ppdf.robust.cells import DROPPED, FIXED, HIGH, LOW, MAYBE_DROPPED, REF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.lanes import (
    ASKED,
    BATCH,
    CELL,
    COUNT,
    DISTANCE,
    HEIGHT,
    OPEN,
    RINGS,
    SLOPE,
    STEP,
    Room,
    X,
    Y,
    put_low_points,
    surfaces,
)
from ppdf_dask.filters.ppdf.robust.surface import Index, add_reference, all_proven, count_within, index_references

NOT_KNOWN = np.int32(-(2**31))
"""A residual or roughness that does not exist or is not proven."""

TOO_HIGH = 4.0
"""Metres above the surface of its references, and as much more as that rises in a cell, from where a low point is HIGH.

A shortcut: what stands as high as a house is not tried again, and nor is what lies above it in its cell."""

FAR = 65_535
"""Rings to the nearest change: none; more than any search looks at."""

FEW = 16
"""One change in so many low points is few: a mark costs about that many times less than a test."""


@kernel
def _find_open(place: Any, count: Any, width: Any, pos: Any, state: Any, unproven: Any) -> None:
    """Note in `OPEN` of each place whether an unproven cell lies within the rings that decide it, itself left out."""
    for m in range(count):
        k = place[m, CELL]
        itself = (state[k] & UNPROVEN) != 0 and pos[k, 0] == place[m, X] and pos[k, 1] == place[m, Y]
        place[m, OPEN] = count_within(unproven, width, k, place[m, RINGS]) > itself


class Candidates(NamedTuple):
    """What growth still has to test, and its room; the first three lie beside each other.

    Attributes
    ----------
    todo : numpy.ndarray
        Cells, int32.
    looked : numpy.ndarray
        Rings of cells the last search visited, uint16.
    fresh : numpy.ndarray
        The new states, uint8.
    near : numpy.ndarray
        For every cell the rings to the nearest change of the pass before, uint16; 0 makes every cell be tested.
    """

    todo: npt.NDArray[np.int32]
    looked: npt.NDArray[np.uint16]
    fresh: npt.NDArray[np.uint8]
    near: npt.NDArray[np.uint16]

    def first(self, n: int) -> Candidates:
        """Return the first `n`."""
        return Candidates(self.todo[:n], self.looked[:n], self.fresh[:n], self.near)


def candidates(state: npt.NDArray[np.uint8], skip: np.uint8) -> Candidates:
    """Return the cells whose low points growth has to test: without a flag of `skip`, no proven reference yet."""
    asked = (state & (LOW | skip)) == LOW
    todo = np.flatnonzero(asked & ((state & (REF | UNPROVEN)) != REF)).astype(np.int32)
    n = len(todo)
    return Candidates(todo, np.zeros(n, np.uint16), np.empty(n, np.uint8), np.zeros(len(state), np.uint16))


@leaf
def _to_test(s: Any, skip: Any) -> Any:
    return ((s & LOW) != 0) & ((s & skip) == 0) & ((s & (REF | UNPROVEN)) != REF)


class Rule(NamedTuple):
    """When a low point becomes a reference; m where nothing is said.

    Attributes
    ----------
    base, spread, slope : float
        A height of `base`, and for each metre to the nearest reference `spread` and `slope` times the surface's slope.
    step, step_spread : float
        The same for the height above the nearest reference.
    highest : float
        Never above this.
    rough, rough_most : float
        What the roughness is counted with, and the most it can be where it is not known.
    """

    base: float
    spread: float
    slope: float
    step: float
    step_spread: float
    highest: float
    rough: float
    rough_most: float


class References(NamedTuple):
    """A grid in which references are sought.

    Attributes
    ----------
    width, cell : int
        Columns, and the edge of a cell, mm.
    pos, state : numpy.ndarray
        Its low points, and what is known of them.
    indexed : Index
        Of `index_references`.
    """

    width: int
    cell: int
    pos: npt.NDArray[np.int32]
    state: npt.NDArray[np.uint8]
    indexed: Index


def grow(
    pos: npt.NDArray[np.int32],
    state: npt.NDArray[np.uint8],
    references: References,
    fold: int,
    limit: int,
    rule: Rule,
    skip: np.uint8,
    rough: npt.NDArray[np.int32],
    parts: int,
    left: Candidates,
    room: Room,
) -> tuple[int, Candidates]:
    """Do one synchronous pass over the low points of the cells that are left to test.

    Return how many changed by more than `HIGH`, and what is left then: a low point with one of the flags `skip` is
    passed over.

    References are sought within `limit` mm: in this grid, or in the coarser one with `fold` x `fold` cells in one,
    where only its low points are references yet and lie closer together, in cells. In this grid the index follows the
    changes.

    A cell is tested again only where something changed within the rings its last search visited. `rough` holds the
    roughness (mm) of the coarse cells, `parts` x `parts` of these cells make one of them; an empty array stands for
    none.
    """
    width, cell, seek_pos, seek_state, index = references
    mine, place = cell // fold, room.place
    rings, soft, known = -(-limit // cell), 0.1 * (mine * 1e-3) ** 2, all_proven(index)
    todo, looked, fresh, near = left
    np.take(state, todo, out=fresh)
    asked = np.flatnonzero(near[todo] <= looked)
    place[:, OPEN] = 0
    for start in range(0, len(asked), BATCH):
        batch = asked[start : start + BATCH]
        cells, count = todo[batch], len(batch)
        put_low_points(cells, batch, width * fold, mine, fold // 2, pos, place)
        surfaces(room, count, index, seek_pos, width, cell, rings, limit * limit, soft)
        if not known:
            _find_open(place, count, width, seek_pos, seek_state, index[2])
        _decide(cells, width * fold, mine, state, fold, rule, rough, parts, looked, fresh, place, room.answer)
    changed, count = _take_over(width * fold, mine, pos, state, skip, fold, index, *left)
    return changed, left.first(count)


@kernel
def _decide(
    cells: Any,
    width: Any,
    cell: Any,
    state: Any,
    fold: Any,
    rule: Any,
    rough: Any,
    parts: Any,
    looked: Any,
    fresh: Any,
    place: Any,
    answer: Any,
) -> None:
    """Set the new states of the cells put and the rings they depend on."""
    for m in range(len(cells)):
        k, asked, unknown = np.int64(cells[m]), place[m, ASKED], place[m, OPEN] != 0
        looked[asked] = fold * place[m, RINGS] + fold - 1
        least = most = 0.0
        if len(rough) > 0:
            here = rough[k // width // parts * (width // parts) + k % width // parts]
            least = rule.rough * (0.0 if here == NOT_KNOWN else here * 1e-3)
            most = rule.rough * (rule.rough_most if here == NOT_KNOWN else here * 1e-3)
        n, r, slope, d = place[m, COUNT], answer[m, HEIGHT], answer[m, SLOPE], answer[m, DISTANCE]
        s = state[k]
        above = -(8.0 + 0.15 * d) < r
        rise = rule.base + (rule.spread + rule.slope * slope) * d
        by_plane = n > 0 and above and r < min(rule.highest, rise + least)
        perhaps = n > 0 and above and r < min(rule.highest, rise + most)
        by_step = n > 0 and r > 0.0 and answer[m, STEP] < rule.step + rule.step_spread * d and not s & DROPPED
        s &= ~HIGH
        if by_plane or by_step:
            s = (s | REF) & ~UNPROVEN
            if unknown or s & MAYBE_DROPPED:
                s |= UNPROVEN
        elif unknown or perhaps:
            s |= UNPROVEN
        elif not s & UNPROVEN and n >= 3 and r > TOO_HIGH + slope * (cell * 1e-3):
            s |= HIGH
        fresh[asked] = s


@kernel
def _take_over(
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    skip: Any,
    fold: Any,
    index: Any,
    todo: Any,
    looked: Any,
    fresh: Any,
    near: Any,
) -> Any:
    """Set the new states, the index and `near` after them, and drop from `todo` what needs no further test."""
    changed = farthest = np.int64(0)
    proofs = False
    for i in range(len(todo)):
        farthest = max(farthest, np.int64(looked[i]))
        difference = state[todo[i]] ^ fresh[i]
        changed += (difference & ~HIGH) != 0
        proofs |= (difference & UNPROVEN) != 0
    # Few changes are marked one by one; after many nearly all cells would be marked.
    few = changed * FEW < len(todo)
    for j in range(len(near)):
        near[j] = FAR if few else 0
    left = 0
    for i in range(len(todo)):
        k, s = np.int64(todo[i]), fresh[i]
        difference = state[k] ^ s
        state[k] = s
        if difference & REF and fold == 1:
            add_reference(width, cell, pos, k, index)
        if few and difference & ~HIGH:
            _mark(width, len(near) // width, k, farthest, near)
        if _to_test(s, skip):
            todo[left] = k
            looked[left] = looked[i]
            left += 1
    if proofs and fold == 1:
        index_references(width, cell, pos, state, index)
    return changed, left


@leaf
def _mark(width: Any, height: Any, k: Any, reach: Any, near: Any) -> None:
    """Note in `near` that cell `k` changed, for the cells up to `reach` rings around."""
    row = k // width
    col = k - row * width
    first, last = max(col - reach, 0), min(col + reach, width - 1)
    for r in range(max(row - reach, 0), min(row + reach, height - 1) + 1):
        for c in range(first, last + 1):
            j = r * width + c
            near[j] = min(near[j], max(abs(r - row), abs(c - col)))


def clean(
    references: References, limit: int, drop: bool, room: Room
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32]]:
    """Re-test every reference without itself, among those within `limit` mm.

    Return the new states and the heights (mm) of those that stay. Without `drop` only these are taken.
    """
    width, cell, pos, state, index = references
    rings, known, after, place = -(-limit // cell), all_proven(index), state.copy(), room.place
    residuals = np.full(len(state), NOT_KNOWN)
    asked = np.flatnonzero(state & REF).astype(np.int32)
    place[:, OPEN] = 0
    for start in range(0, len(asked), BATCH):
        cells = asked[start : start + BATCH]
        put_low_points(cells, cells.astype(np.int64), width, cell, 0, pos, place)
        surfaces(
            room, len(cells), index, pos, width, cell, 0 if known else rings, limit * limit, 0.1 * (cell * 1e-3) ** 2
        )
        if not known:
            _find_open(place, len(cells), width, pos, state, index[2])
        _test_again(cells, state, drop, residuals, after, place, room.answer)
    return after, residuals


@kernel
def _test_again(cells: Any, state: Any, drop: Any, residuals: Any, after: Any, place: Any, answer: Any) -> None:
    for m in range(len(cells)):
        j, r = cells[m], answer[m, HEIGHT]
        if place[m, COUNT] >= 3:
            if drop and not state[j] & FIXED and r > 0.3 + (0.2 + 1.2 * answer[m, SLOPE]) * answer[m, DISTANCE]:
                after[j] = state[j] & ~REF
            else:
                residuals[j] = np.int32(np.rint(min(max(r, -1000.0), 1000.0) * 1000.0))
        if place[m, OPEN]:
            after[j] |= UNPROVEN
