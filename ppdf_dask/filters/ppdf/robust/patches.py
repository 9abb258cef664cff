"""Patch continuity: roofs and crowns are patches whose surroundings are lower (step 6)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.compiled import leaf
from ppdf_dask.filters.ppdf.robust.cells import DROPPED, FIXED, LOW, MAYBE_DROPPED, REF, ROOF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.planes import NOT_KNOWN_PATCH

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


@njit(nogil=True, cache=True)
def link_patches(
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    patch: Any,
    planes: Any,
    squares: Any,
    count: Any,
    near: Any,
    agree: Any,
    parent: Any,
    open_: Any,
) -> None:
    """Unite patches whose planes agree; mark in `open_` the patches that touch something unproven."""
    votes, agreeing = np.zeros(count, np.int64), np.zeros(count, np.int64)
    touched = np.empty(count, np.int64)
    for p in range(count):
        parent[p] = p
        open_[p] = False
    for p in range(count):
        n = 0
        c0, r0, size = squares[p, 0], squares[p, 1], squares[p, 2]
        for r in range(r0, r0 + size):
            for k in range(r * width + c0, r * width + c0 + size):
                if patch[k] != p:
                    continue
                for dr in range(-near, near + 1):
                    for j in range(k + dr * width - near, k + dr * width + near + 1):
                        if state[j] & UNPROVEN or patch[j] == NOT_KNOWN_PATCH:
                            open_[p] = True
                        q = np.int64(patch[j])
                        if q <= p:
                            continue
                        if votes[q] == 0:
                            touched[n] = q
                            n += 1
                        votes[q] += 1
                        if (
                            abs(residual(planes, squares, p, pos, j, cell)) < agree
                            and abs(residual(planes, squares, q, pos, k, cell)) < agree
                        ):
                            agreeing[q] += 1
        for m in range(n):
            q = touched[m]
            if 2 * agreeing[q] >= votes[q]:
                a, b = _root(parent, p), _root(parent, q)
                parent[max(a, b)] = min(a, b)
            votes[q] = 0
            agreeing[q] = 0
    for p in range(count):
        parent[p] = _root(parent, p)


@njit(nogil=True, cache=True)
def judge_components(
    width: Any,
    cell: Any,
    pos: Any,
    state: Any,
    patch: Any,
    planes: Any,
    squares: Any,
    count: Any,
    parent: Any,
    open_: Any,
    look_out: Any,
    reach: Any,
    drop: Any,
    share: Any,
    gentle: Any,
    smallest: Any,
    largest: Any,
) -> None:
    """Drop the seeds of components that are too small or whose border drops away on most sides.

    A wall falls at once; the flank of an embankment falls step by step. A direction counts as `gentle` of one when it
    falls no more steeply than earth lies (`HEAPED`), or when a low point lies partway down, more than `STEP` below the
    plane, before the drop, and nowhere falls like a `WALL`.
    """
    seeds = np.zeros(count, np.int64)
    borders = np.zeros(count, np.int64)
    drops = np.zeros(count, np.int64)
    slow = np.zeros(count, np.int64)
    box = np.empty((count, 4), np.int64)
    for root in range(count):
        box[root, 0] = box[root, 1] = 1 << 40
        box[root, 2] = box[root, 3] = -1
    shift = (1, -1, width, -width)
    for k in range(len(state)):
        p = np.int64(patch[k])
        if p < 0:
            continue
        root = parent[p]
        seeds[root] += 1
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
                borders[root] += 1
                drops[root] += falls and not slowly
                slow[root] += falls and slowly
    verdict = np.zeros(count, np.uint8)
    for root in range(count):
        if parent[root] != root:
            continue
        side = (max(box[root, 2] - box[root, 0], box[root, 3] - box[root, 1]) + 1) * cell
        if open_[root]:
            if side < largest or seeds[root] < smallest:
                verdict[root] = UNPROVEN | MAYBE_DROPPED
        elif seeds[root] < smallest:
            verdict[root] = DROPPED
        elif drops[root] + gentle * slow[root] > share * borders[root] and side < largest:
            verdict[root] = ROOF
    for k in range(len(state)):
        if patch[k] >= 0 and not state[k] & FIXED:
            v = verdict[parent[patch[k]]]
            if v & (DROPPED | ROOF):
                state[k] &= ~REF
            state[k] |= v


@njit(nogil=True, cache=True)
def spread_roofs(
    width: Any, height: Any, cell: Any, pos: Any, state: Any, patch: Any, planes: Any, squares: Any, agree: Any
) -> None:
    """Make roof of the low points beside a roof's seeds and near their plane: chimneys, edges, what no plane took."""
    mark = np.zeros(len(state), np.uint8)
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
    for k in range(len(state)):
        state[k] |= mark[k]
