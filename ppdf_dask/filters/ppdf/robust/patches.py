"""Patch continuity: roofs and crowns are patches whose surroundings are lower (step 6)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.ppdf.compiled import kernel, leaf
from ppdf_dask.filters.ppdf.robust.cells import DROPPED, FIXED, LOW, MAYBE_DROPPED, REF, ROOF, UNPROVEN, Cells
from ppdf_dask.filters.ppdf.robust.params import RobustParams
from ppdf_dask.filters.ppdf.robust.planes import NOT_KNOWN_PATCH, Patches
from ppdf_dask.grid import MM

LOOK_OUT = 12
"""Cells: how far a seed looks for its own patch before it counts as border."""

NEAR = 3
"""Cells: low points of two patches so near vote on whether the patches are one surface."""

AGREE = 1.0
"""Metres: two low points agree when each lies this near to the other's plane."""

UNKNOWN = np.int32(2**31 - 1)
"""Patch of a cell that is not proven: after all others, so that one comparison finds what has to be looked at."""

STEP = 0.5
"""Metres below a patch's plane at which a low point lies partway down."""

HEAPED = 0.7
"""Earth does not lie steeper than this (35 degrees): what nowhere falls more steeply is a flank."""

WALL = 2.0
"""What falls more steeply than this somewhere has a wall, whatever lies partway down."""


@leaf
def residual(planes: Any, squares: Any, p: Any, pos: Any, k: Any, cell: Any) -> Any:
    """Height of the low point of cell `k` above plane `p`, metres."""
    x = (pos[k, 0] - squares[p, 0] * cell) * 1e-3
    y = (pos[k, 1] - squares[p, 1] * cell) * 1e-3
    z = (pos[k, 2] - np.int64(squares[p, 3])) * 1e-3
    return z - (planes[p, 2] + planes[p, 0] * x + planes[p, 1] * y)


@leaf
def _root(parent: Any, p: Any) -> Any:
    while parent[p] != p:
        parent[p] = parent[parent[p]]
        p = parent[p]
    return p


class Components(NamedTuple):
    """Patches that are one surface.

    Attributes
    ----------
    root : numpy.ndarray
        For each patch the first of its component, int32.
    open : numpy.ndarray
        The patches that touch something unproven, bool.
    """

    root: npt.NDArray[np.int32]
    open: npt.NDArray[np.bool_]


def link_patches(cells: Cells, patches: Patches) -> Components:
    """Unite the patches whose planes agree where they touch."""
    count = len(patches.planes)
    root, open_ = np.arange(count, dtype=np.int32), np.zeros(count, np.bool_)
    votes, touched = np.tile([0, 0, -1], (count, 1)), np.empty(count, np.int64)
    unknown = (cells.state & UNPROVEN != 0) | (patches.of_cell == NOT_KNOWN_PATCH)
    seen = np.where(unknown, UNKNOWN, patches.of_cell)
    _link_patches(
        cells.width,
        cells.cell,
        cells.pos,
        seen,
        _highest(seen),
        patches.planes,
        patches.squares,
        np.full(len(seen), -1, np.int32),
        np.empty((2 * NEAR + 1) ** 2 + 1, np.int64),
        votes,
        touched,
        root,
        open_,
    )
    return Components(root, open_)


def _highest(values: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Return the greatest of each value and the `2 * NEAR` after it."""
    count = len(values) - 2 * NEAR
    found = values[:count].copy()
    for step in range(1, 2 * NEAR + 1):
        np.maximum(found, values[step : step + count], out=found)
    return found


PAIRS, AGREEING, ASKED = range(3)


@kernel
def _link_patches(
    width: Any,
    cell: Any,
    pos: Any,
    patch: Any,
    highest: Any,
    planes: Any,
    squares: Any,
    agrees: Any,
    around: Any,
    votes: Any,
    touched: Any,
    parent: Any,
    open_: Any,
) -> None:
    """Unite patches whose planes agree; mark in `open_` the patches that touch something unproven.

    `patch` is `UNKNOWN` where a cell is unproven, `highest` the greatest of a cell and the `2 * NEAR` after it.
    `parent` of each patch is itself. Room: `votes` (n, 3) of zeros and -1, `touched` (n), `agrees` of -1 for each cell,
    `around` for the cells around one and a cell more.

    Both a patch's votes and the cells remember what was answered last, for twice the number of who asked: a low point
    is compared once with each plane, not once for each pair.
    """
    for p in range(len(parent)):
        n = 0
        c0, r0, size = squares[p, 0], squares[p, 1], squares[p, 2]
        for r in range(r0, r0 + size):
            for k in range(r * width + c0, r * width + c0 + size):
                if patch[k] != p:
                    continue
                # Gathered first without a branch, then looked at: which cells those are is hard to foresee.
                count = 0
                for dr in range(-NEAR, NEAR + 1):
                    begin = k + dr * width - NEAR
                    if highest[begin] > p:
                        for j in range(begin, begin + 2 * NEAR + 1):
                            around[np.uintp(count)] = j
                            count += patch[np.uintp(j)] > p
                for m in range(count):
                    j = around[m]
                    q = np.int64(patch[j])
                    if q == UNKNOWN:
                        open_[p] = True
                        continue
                    if votes[q, ASKED] >> 1 != k:
                        votes[q, ASKED] = 2 * k + (abs(residual(planes, squares, q, pos, k, cell)) < AGREE)
                        if votes[q, PAIRS] == 0:
                            touched[n] = q
                            n += 1
                    if agrees[j] >> 1 != p:
                        agrees[j] = 2 * p + (abs(residual(planes, squares, p, pos, j, cell)) < AGREE)
                    votes[q, PAIRS] += 1
                    votes[q, AGREEING] += votes[q, ASKED] & agrees[j] & 1
        for m in range(n):
            q = touched[m]
            if 2 * votes[q, AGREEING] >= votes[q, PAIRS]:
                a, b = _root(parent, p), _root(parent, q)
                parent[max(a, b)] = min(a, b)
            votes[q, PAIRS] = votes[q, AGREEING] = 0
    for p in range(len(parent)):
        parent[p] = _root(parent, p)


def judge_components(cells: Cells, patches: Patches, components: Components, params: RobustParams) -> None:
    """Drop the seeds of components that are too small or whose border drops away on most sides.

    A wall falls at once; the flank of an embankment falls step by step. A direction counts as `border_gentle` of one
    when it falls no more steeply than earth lies (`HEAPED`), or when a low point lies partway down, more than `STEP`
    below the plane, before the drop, and nowhere falls like a `WALL`.
    """
    root, open_ = components
    tally, box = np.zeros((len(root), 4), np.int64), np.empty((len(root), 4), np.int64)
    box[:] = 1 << 40, 1 << 40, -1, -1
    reach = round(params.border_reach * MM)
    _walk_borders(
        cells.width,
        cells.cell,
        cells.pos,
        cells.state,
        *patches,
        root,
        open_,
        LOOK_OUT,
        reach,
        params.border_drop,
        tally,
        box,
    )
    seeds, borders, drops, slow = tally.T
    side = (np.maximum(box[:, 2] - box[:, 0], box[:, 3] - box[:, 1]) + 1) * cells.cell
    small, building = seeds < params.smallest_patch, side < round(params.largest_building * MM)
    raised = drops + params.border_gentle * slow > params.border_share * borders
    verdict = np.select(
        [open_ & (building | small), open_, small, raised & building],
        [UNPROVEN | MAYBE_DROPPED, np.uint8(0), DROPPED, ROOF],
        np.uint8(0),
    )
    k = np.flatnonzero((patches.of_cell >= 0) & (cells.state & FIXED == 0))
    judged, state = verdict[root[patches.of_cell[k]]], cells.state[k]
    cells.state[k] = np.where(judged & (DROPPED | ROOF), state & ~REF, state) | judged


SEEDS, BORDERS, DROPS, SLOW = range(4)


@kernel
def _walk_borders(
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    patch: Any,
    planes: Any,
    squares: Any,
    parent: Any,
    open_: Any,
    look_out: Any,
    reach: Any,
    drop: Any,
    tally: Any,
    box: Any,
) -> None:
    """Count for each component its `SEEDS`, its `BORDERS` in four directions and those that fall; bound it by `box`."""
    shift = (1, -1, width, -width)
    for k in range(len(state)):
        p = np.int64(patch[k])
        if p < 0:
            continue
        root = parent[p]
        tally[root, SEEDS] += 1
        if open_[p]:
            open_[root] = True
        row, col = k // width, k % width
        box[root, 0] = min(box[root, 0], col)
        box[root, 1] = min(box[root, 1], row)
        box[root, 2] = max(box[root, 2], col)
        box[root, 3] = max(box[root, 3], row)
        tilt = np.sqrt(planes[p, 0] ** 2 + planes[p, 1] ** 2)
        for direction in range(4):
            inside = False
            falls = False
            steps = False
            j = last = k
            level = steepest = 0.0
            for far in range(1, look_out + 1):
                j += shift[direction]
                if patch[j] >= 0 and parent[patch[j]] == root:
                    inside = True
                    break
                if state[j] & UNPROVEN or patch[j] == NOT_KNOWN_PATCH:
                    open_[root] = True
                if state[j] & LOW and far * cell <= reach and not falls:
                    fall = drop + 0.5 * tilt * far * (cell * 1e-3)
                    height = residual(planes, squares, p, pos, j, cell)
                    falls = height < -fall
                    steps |= not falls and height < -STEP
                    along = (pos[j, 0] - pos[last, 0]) * 1e-3
                    across = (pos[j, 1] - pos[last, 1]) * 1e-3
                    steepest = max(steepest, (level - height) / np.sqrt(along * along + across * across))
                    last = j
                    level = height
            if not inside:
                slowly = steepest < HEAPED or (steps and steepest < WALL)
                tally[root, BORDERS] += 1
                tally[root, DROPS] += falls and not slowly
                tally[root, SLOW] += falls and slowly


def spread_roofs(cells: Cells, patches: Patches) -> None:
    """Make roof of the low points beside a roof's seeds and near their plane: chimneys, edges, what no plane took."""
    mark = np.zeros(len(cells.state), np.uint8)
    _spread_roofs(cells.width, cells.height, cells.cell, cells.pos, cells.state, *patches, AGREE, mark)
    np.bitwise_or(cells.state, mark, out=cells.state)


@kernel
def _spread_roofs(
    width: Any,
    height: Any,
    cell: Any,
    pos: Any,
    state: Any,
    patch: Any,
    planes: Any,
    squares: Any,
    agree: Any,
    mark: Any,
) -> None:
    for row in range(1, height - 1):
        for k in range(row * width + 1, row * width + width - 1):
            if not state[k] & LOW or state[k] & (REF | ROOF):
                continue
            for dr in range(-1, 2):
                for j in range(k + dr * width - 1, k + dr * width + 2):
                    if state[j] & UNPROVEN:
                        mark[k] |= MAYBE_DROPPED
                    if state[j] & ROOF and abs(residual(planes, squares, np.int64(patch[j]), pos, k, cell)) < agree:
                        mark[k] |= ROOF
