"""Compiled loops of `growth`: nearest ground points, local planes, synchronous passes. Lengths are millimetres.

Points lie sorted in buckets of edge g; 8 x 8 buckets make a block. Only occupied blocks exist (a hash table finds
them), so memory goes with the points and an empty surrounding costs one look per block. A search looks at rings of
buckets as far as the eight neighbouring blocks reach, then at rings of blocks.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ppdf_dask.filters.ppdf.compiled import leaf
from ppdf_dask.filters.ppdf.hashing import mix

SIDE = 8
"""Buckets along a block's edge."""
GROUND, UNPROVEN = 1, 2
"""Bits of a point's state; GROUND alone is final."""
FLATTEST = 1e-3
"""Smaller to larger eigenvalue of the neighbours' scatter in plan below which they count as lying on a line."""
STEEPEST = 32.163437477526264
"""tan(80 degrees) squared: steeper local planes give no height."""


@leaf
def fill_table(keys: Any, table: Any) -> None:
    """Enter block keys into an open-addressing table of -1s whose length is a power of two."""
    mask = np.uint64(len(table) - 1)
    for b in range(len(keys)):
        at = mix(np.uint64(keys[b])) & mask
        while table[at] >= 0:
            at = (at + np.uint64(1)) & mask
        table[at] = b


@leaf
def _find(keys: Any, table: Any, i: int, j: int) -> int:
    key = (np.int64(i) << 32) + j
    mask = np.uint64(len(table) - 1)
    at = mix(np.uint64(key)) & mask
    while table[at] >= 0:
        if keys[table[at]] == key:
            return int(table[at])
        at = (at + np.uint64(1)) & mask
    return -1


@leaf
def neighbours_of(keys: Any, table: Any, near: Any) -> None:
    """Write the 3 x 3 blocks around each block, -1 where there is none."""
    for b in range(len(keys)):
        i, j = keys[b] >> 32, keys[b] & 0xFFFFFFFF
        for k in range(9):
            near[b, k] = _find(keys, table, i + k // 3 - 1, j + k % 3 - 1)


@leaf
def _before(d: int, p: int, e: int, q: int, x: Any, y: Any, z: Any) -> bool:
    """Tell whether point p at squared distance d comes before q at e: by distance, z, x, y."""
    if d != e:
        first = d < e
    elif z[p] != z[q]:
        first = z[p] < z[q]
    elif x[p] != x[q]:
        first = x[p] < x[q]
    else:
        first = y[p] < y[q]
    return bool(first)


@leaf
def _slot(dx: int, dy: int, nearest: bool) -> int:
    """Return the quadrant of a difference other than (0, 0), always 0 for the nearest of all."""
    if nearest or (dx > 0 and dy >= 0):
        slot = 0
    elif dx <= 0 and dy > 0:
        slot = 1
    elif dx < 0:
        slot = 2
    else:
        slot = 3
    return slot


@leaf
def _offer(
    p: int, o: int, x: Any, y: Any, z: Any, state: Any, limit: int, nearest: bool, best: Any, shade: Any
) -> None:
    """Enter point p among the neighbours of o: `best` and `shade` hold (index, squared distance) per slot."""
    dx, dy = np.int64(x[p]) - x[o], np.int64(y[p]) - y[o]
    d = dx * dx + dy * dy
    if 0 < d <= limit:
        slot = _slot(dx, dy, nearest)
        if state[p] & UNPROVEN and _before(d, p, shade[slot, 1], shade[slot, 0], x, y, z):
            shade[slot, 0], shade[slot, 1] = p, d
        last = 3 if nearest else slot
        if state[p] & GROUND and _before(d, p, best[last, 1], best[last, 0], x, y, z):
            while last > slot and _before(d, p, best[last - 1, 1], best[last - 1, 0], x, y, z):
                best[last, 0], best[last, 1] = best[last - 1, 0], best[last - 1, 1]
                last -= 1
            best[last, 0], best[last, 1] = p, d


@leaf
def _still_open(best: Any, to: Any, reached: int, reach: int, nearest: bool) -> int:
    """Return a bit per quadrant that may still hold a nearer point.

    Unseen points lie at least `to` (right, top, left, bottom) + `reached` away along an axis.
    """
    bits = 0
    for q in range(4):
        bound = reached + min(to[q], to[(q + 1) & 3])
        if bound <= reach and best[3 if nearest else q, 1] >= bound * bound:
            bits |= 1 << q
    return bits


@leaf
def _quadrants_at(di: int, dj: int) -> int:
    """Return a bit per quadrant that a cell `di` columns and `dj` rows away can hold points of."""
    right, left, top, bottom = di >= 0, di <= 0, dj >= 0, dj <= 0
    return (right and top) * 1 + (left and top) * 2 + (left and bottom) * 4 + (right and bottom) * 8


@leaf
def _use(p: int, block: int, x: Any, y: Any, grid: Any, masks: Any) -> None:
    """Note that the bucket of point p holds a ground or unproven point."""
    i, j = (x[p] - grid[1]) // grid[0], (y[p] - grid[2]) // grid[0]
    masks[block, i & 7] |= np.uint8(1 << (j & 7))


@leaf
def _window(block: int, near: Any, masks: Any, window: Any) -> None:
    """Write which buckets of the 3 x 3 blocks are in use: a word per column, bit r for row r, 24 each."""
    for i in range(3 * SIDE):
        window[i] = 0
        for k in range(3):
            b = near[block, 3 * (i // SIDE) + k]
            if b >= 0:
                window[i] |= np.int64(masks[b, i % SIDE]) << (SIDE * k)


@leaf
def _search(o: int, block: int, x: Any, y: Any, z: Any, state: Any, grid: Any, starts: Any, keys: Any, table: Any,
            near: Any, masks: Any, window: Any, reach: int, nearest: bool, best: Any,
            shade: Any, to: Any) -> None:  # fmt: skip
    """Find the ground points that carry the plane at o, and the first unproven point of each slot."""
    g, left, bottom = grid[0], grid[1], grid[2]
    limit = reach * reach
    best[:, 0], best[:, 1] = -1, limit + 1
    shade[:, 0], shade[:, 1] = -1, limit + 1
    gi, gj = (x[o] - left) // g, (y[o] - bottom) // g
    fx, fy = (x[o] - left) - gi * g, (y[o] - bottom) - gj * g
    to[0], to[1], to[2], to[3] = g - fx, g - fy, fx + 1, fy + 1
    li, lj = gi & (SIDE - 1), gj & (SIDE - 1)
    open_ = 15
    for ring in range(SIDE + 1):
        for di in range(-ring, ring + 1):
            full = abs(di) == ring
            bits = ((2 << 2 * ring) - 1 if full else 1 | 1 << 2 * ring) << (SIDE + lj - ring)
            bits &= window[SIDE + li + di]
            if bits == 0:
                continue
            for dj in range(-ring, ring + 1, 1 if full else 2 * ring):
                row = SIDE + lj + dj
                if not bits >> row & 1 or not _quadrants_at(di, dj) & open_:
                    continue
                b = near[block, 3 * ((SIDE + li + di) >> 3) + (row >> 3)]
                bucket = b * SIDE * SIDE + ((li + di) & 7) * SIDE + (row & 7)
                for p in range(starts[bucket], starts[bucket + 1]):
                    if state[p]:
                        _offer(p, o, x, y, z, state, limit, nearest, best, shade)
        open_ = _still_open(best, to, ring * g, reach, nearest)
        if open_ == 0:
            return
    wide = SIDE * g
    bi, bj = gi // SIDE, gj // SIDE
    to[0], to[1], to[2], to[3] = wide - (li * g + fx), wide - (lj * g + fy), li * g + fx + 1, lj * g + fy + 1
    ring = 1
    while open_ != 0:
        for ci in range(-ring, ring + 1):
            for cj in range(-ring, ring + 1, 1 if abs(ci) == ring else 2 * ring):
                if not _quadrants_at(ci, cj) & open_:
                    continue
                b = near[block, 3 * ci + cj + 4] if ring == 1 else _find(keys, table, bi + ci, bj + cj)
                if b < 0:
                    continue
                for i in range(SIDE):
                    if masks[b, i] == 0:
                        continue
                    for j in range(SIDE):
                        di, dj = ci * SIDE + i - li, cj * SIDE + j - lj
                        if (
                            not masks[b, i] >> j & 1
                            or (abs(di) <= SIDE and abs(dj) <= SIDE)
                            or not _quadrants_at(di, dj) & open_
                        ):
                            continue
                        bucket = (b * SIDE + i) * SIDE + j
                        for p in range(starts[bucket], starts[bucket + 1]):
                            if state[p]:
                                _offer(p, o, x, y, z, state, limit, nearest, best, shade)
        open_ = _still_open(best, to, ring * wide, reach, nearest)
        ring += 1


@leaf
def _misfit(o: int, x: Any, y: Any, z: Any, best: Any) -> float:
    """Return the distance of o from the plane through its neighbours (slots in order; empty ones skipped)."""
    n, mx, my, mz = 0, 0.0, 0.0, 0.0
    weight, height = 0.0, 0.0
    for s in range(4):
        p = best[s, 0]
        if p >= 0:
            dz = float(np.int64(z[p]) - z[o])
            w = 1.0 / math.sqrt(best[s, 1])
            n += 1
            mx += np.int64(x[p]) - x[o]
            my += np.int64(y[p]) - y[o]
            mz += dz
            weight += w
            height += w * dz
    away = height / weight
    if n >= 3:
        mx, my, mz = mx / n, my / n, mz / n
        sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0
        for s in range(4):
            p = best[s, 0]
            if p >= 0:
                dx, dy = (np.int64(x[p]) - x[o]) - mx, (np.int64(y[p]) - y[o]) - my
                dz = (np.int64(z[p]) - z[o]) - mz
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                sxz += dx * dz
                syz += dy * dz
        det = sxx * syy - sxy * sxy
        largest = 0.5 * (sxx + syy + math.sqrt((sxx - syy) * (sxx - syy) + 4.0 * sxy * sxy))
        if det >= FLATTEST * largest * largest:
            a = (sxz * syy - syz * sxy) / det
            b = (syz * sxx - sxz * sxy) / det
            steepness = a * a + b * b
            if steepness <= STEEPEST:
                away = (a * mx + b * my - mz) / math.sqrt(1.0 + steepness)
    return abs(away)


@leaf
def _leaves(x: int, y: int, quadrants: int, d: int, reach: int, known: Any) -> bool:
    """Tell whether the disk of squared radius d around (x, y), cut to some quadrants, leaves the known area."""
    away = False
    for side in range(4):
        # Right of quadrants 1 and 4, top of 1 and 2, left of 2 and 3, bottom of 3 and 4.
        faces = 1 << side | 1 << ((side + 3) & 3)
        at = x if side & 1 == 0 else y
        gap = known[2 + side] - at if side < 2 else at - known[side - 2] + 1
        away |= faces & quadrants != 0 and (gap <= 0 or (gap <= reach and gap * gap <= d))
    return away


@leaf
def _doubt(o: int, x: Any, y: Any, z: Any, best: Any, shade: Any, reach: int, nearest: bool, known: Any) -> bool:
    """Tell whether the neighbours of o could be others than those found."""
    doubt = False
    for q in range(1 if nearest else 4):
        last = 3 if nearest else q
        p, d = best[last, 0], min(best[last, 1], reach * reach)
        if shade[q, 0] >= 0 and not (p >= 0 and _before(d, p, shade[q, 1], shade[q, 0], x, y, z)):
            doubt = True
        doubt |= _leaves(x[o], y[o], 15 if nearest else 1 << q, d, reach, known)
    return doubt


@leaf
def _radius(best: Any, reach: int) -> int:
    """Return a bound of the distance beyond which nothing can change the test, mm."""
    far = max(max(best[0, 1], best[1, 1]), max(best[2, 1], best[3, 1]))
    return min(reach, int(math.sqrt(far)) + 1)


@leaf
def _block_touched(block: int, reach: int, wide: int, when: int, keys: Any, table: Any, near: Any, stamps: Any,
                   changed: Any, n_changed: int) -> bool:  # fmt: skip
    """Tell whether a block that may hold points within `reach` of this one changed in pass `when`."""
    w = (reach + wide - 1) // wide
    i, j = keys[block] >> 32, keys[block] & 0xFFFFFFFF
    touched = False
    if w <= 1:
        for k in range(9):
            touched |= near[block, k] >= 0 and stamps[near[block, k]] == when
    elif n_changed < (2 * w + 1) * (2 * w + 1):
        for k in range(n_changed):
            key = keys[changed[k]]
            touched |= abs((key >> 32) - i) <= w and abs((key & 0xFFFFFFFF) - j) <= w
    else:
        for di in range(-w, w + 1):
            for dj in range(-w, w + 1):
                b = _find(keys, table, i + di, j + dj)
                touched |= b >= 0 and stamps[b] == when
    return bool(touched)


@leaf
def _point_touched(o: int, block: int, radius: int, x: Any, y: Any, grid: Any, near: Any, when: int, stamps: Any,
                   block_stamps: Any) -> bool:  # fmt: skip
    """Tell whether something changed in pass `when` within `radius` of o; may say yes too often, never no."""
    g, u, v = grid[0], x[o] - grid[1], y[o] - grid[2]
    i0, i1, j0, j1 = (u - radius) // g, (u + radius) // g, (v - radius) // g, (v + radius) // g
    bi, bj = u // (SIDE * g), v // (SIDE * g)
    ci0, ci1, cj0, cj1 = (i0 >> 3) - bi, (i1 >> 3) - bi, (j0 >> 3) - bj, (j1 >> 3) - bj
    touched = min(ci0, cj0) < -1 or max(ci1, cj1) > 1
    if not touched:
        for ci in range(ci0, ci1 + 1):
            for cj in range(cj0, cj1 + 1):
                b = near[block, 3 * ci + cj + 4]
                if b >= 0 and block_stamps[b] == when:
                    for i in range(max(i0, (bi + ci) * SIDE), min(i1, (bi + ci) * SIDE + SIDE - 1) + 1):
                        for j in range(max(j0, (bj + cj) * SIDE), min(j1, (bj + cj) * SIDE + SIDE - 1) + 1):
                            touched |= stamps[(b * SIDE + (i & 7)) * SIDE + (j & 7)] == when
    return bool(touched)


@leaf
def _next(state: int, accepted: bool, doubtful: bool) -> int:
    """Return the state after a test.

    A certain yes is final whatever was unproven before; a certain no leaves a point as it was; a doubtful answer is
    only a guess. States climb 0, 2, 3, 1 and never fall, so the passes come to an end.
    """
    if doubtful:
        return state | UNPROVEN | (GROUND if accepted else 0)
    return GROUND if accepted else state


@njit(nogil=True, cache=True)
def grow(x: Any, y: Any, z: Any, state: Any, grid: Any, starts: Any, keys: Any, table: Any, near: Any, reach: int,
         tolerance: float, fewest: int, nearest: bool, known: Any, most_passes: int) -> int:  # fmt: skip
    """Run synchronous passes until nothing changes; update `state` in place.

    Parameters
    ----------
    x, y, z : ndarray of int32, shape (n,)
        Distinct points sorted by bucket, mm.
    state : ndarray of uint8, shape (n,)
        Bits GROUND and UNPROVEN.
    grid : ndarray of int64, shape (3,)
        Edge of a bucket; left and bottom edge of block (0, 0).
    starts : ndarray of int32, shape (64 * m + 1,)
        Bounds of the buckets, block after block.
    keys : ndarray of int64, shape (m,)
        Column and row of each block: ``column << 32 | row``.
    table, near : ndarray of int32
        See `fill_table` and `neighbours_of`.
    reach, tolerance : int, float
        Search limit and acceptance limit, mm.
    fewest : int
        Fewest neighbours.
    nearest : bool
        True: the four nearest; False: one per quadrant.
    known : ndarray of int64, shape (4,)
        Left, bottom, right, top of the known area, the last two exclusive.
    most_passes : int
        Stop after so many passes.

    Returns
    -------
    int
        Number of passes, the last one without a change counted; -1 when `most_passes` did not suffice.
    """
    m, wide = len(keys), SIDE * grid[0]
    masks, radius = np.zeros((m, SIDE), np.uint8), np.zeros(len(x), np.int32)
    window = np.zeros(3 * SIDE, np.int64)
    stamps, block_stamps = np.zeros(SIDE * SIDE * m, np.int16), np.zeros(m, np.int16)
    far, changed = np.zeros(m, np.int32), np.empty(m, np.int32)
    moved, fresh = np.empty(len(x), np.int32), np.empty(len(x), np.uint8)
    best, shade, to = np.zeros((4, 2), np.int64), np.zeros((4, 2), np.int64), np.zeros(4, np.int64)
    for b in range(m):
        for p in range(starts[SIDE * SIDE * b], starts[SIDE * SIDE * (b + 1)]):
            if state[p]:
                _use(p, b, x, y, grid, masks)
    n_changed = 0
    for count in range(1, most_passes + 1):
        n_moved = 0
        for b in range(m):
            if count > 1 and (far[b] == 0 or not _block_touched(
                    b, far[b], wide, count - 1, keys, table, near, block_stamps, changed, n_changed)):  # fmt: skip
                continue
            widest = np.int32(0)
            _window(b, near, masks, window)
            for o in range(starts[SIDE * SIDE * b], starts[SIDE * SIDE * (b + 1)]):
                if state[o] == GROUND:
                    continue
                if count == 1 or _point_touched(o, b, radius[o], x, y, grid, near, count - 1, stamps, block_stamps):
                    _search(
                        o,
                        b,
                        x,
                        y,
                        z,
                        state,
                        grid,
                        starts,
                        keys,
                        table,
                        near,
                        masks,
                        window,
                        reach,
                        nearest,
                        best,
                        shade,
                        to,
                    )
                    radius[o] = _radius(best, reach)
                    found = 0
                    for k in range(4):
                        found += best[k, 0] >= 0
                    accepted = found >= fewest and _misfit(o, x, y, z, best) < tolerance
                    after = _next(state[o], accepted, _doubt(o, x, y, z, best, shade, reach, nearest, known))
                    if after != state[o]:
                        moved[n_moved], fresh[n_moved] = o, after
                        n_moved += 1
                widest = max(widest, radius[o])
            far[b] = widest
        if n_moved == 0:
            return count
        n_changed = 0
        block = 0
        for k in range(n_moved):
            p = moved[k]
            # Points move in ascending order, so the block of the next one is this one or a later one.
            while starts[SIDE * SIDE * (block + 1)] <= p:
                block += 1
            i, j = (x[p] - grid[1]) // grid[0], (y[p] - grid[2]) // grid[0]
            _use(p, block, x, y, grid, masks)
            state[p] = fresh[k]
            stamps[block * SIDE * SIDE + (i & 7) * SIDE + (j & 7)] = count
            if block_stamps[block] != count:
                block_stamps[block] = count
                changed[n_changed] = block
                n_changed += 1
    return -1
