"""The reference surface at a place: nearest references in four quadrants and a plane through them (paper, 2.5)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ppdf_dask.filters.ppdf.compiled import leaf
from ppdf_dask.filters.ppdf.robust.cells import REF, UNPROVEN


@leaf
def nearest(
    state: Any, pos: Any, width: Any, cell: Any, k: Any, x: Any, y: Any, rings: Any, limit2: Any, found: Any
) -> Any:
    """Find the nearest reference in each quadrant around (`x`, `y`) of cell `k`; tell if unproven cells were seen.

    `found` (int64, 9) gets the four cells or -1, the last ring visited, and the squared distances. The quadrants are
    half-open, so that a point on an axis belongs to one of them, and numbered right + 2 up: no branch decides.
    """
    fx = x - k % width * cell
    fy = y - k // width * cell
    for q in range(4):
        found[q] = -1
        found[5 + q] = np.int64(1) << 60
    seen = np.uint8(0)
    for ring in range(rings + 1):
        found[4] = ring
        for dr in range(-ring, ring + 1):
            base = k + dr * width
            step = 1 if abs(dr) == ring or ring == 0 else 2 * ring
            for j in range(base - ring, base + ring + 1, step):
                s = state[j]
                seen |= s
                if not s & REF:
                    continue
                dx = np.int64(pos[j, 0]) - x
                dy = np.int64(pos[j, 1]) - y
                d2 = dx * dx + dy * dy
                right = (dx > 0) | ((dx == 0) & (dy < 0))
                up = (dy > 0) | ((dy == 0) & (dx > 0))
                quadrant = np.int64(right) + 2 * np.int64(up)
                if d2 > found[5 + quadrant] or d2 > limit2 or d2 == 0:
                    continue
                if d2 < found[5 + quadrant] or before(pos, j, found[quadrant]):
                    found[5 + quadrant] = d2
                    found[quadrant] = j
        right_side = (ring + 1) * cell - fx
        left_side = ring * cell + fx
        top = (ring + 1) * cell - fy
        bottom = ring * cell + fy
        if (
            found[8] < min(right_side, top) ** 2
            and found[7] < min(left_side, top) ** 2
            and found[5] < min(left_side, bottom) ** 2
            and found[6] < min(right_side, bottom) ** 2
        ):
            break
    return (seen & UNPROVEN) != 0


@leaf
def before(pos: Any, j: Any, k: Any) -> Any:
    """Tell whether the low point of cell `j` comes before that of `k` in the order (z, x, y)."""
    if pos[j, 2] != pos[k, 2]:
        return pos[j, 2] < pos[k, 2]
    if pos[j, 0] != pos[k, 0]:
        return pos[j, 0] < pos[k, 0]
    return pos[j, 1] < pos[k, 1]


@leaf
def height_above(pos: Any, x: Any, y: Any, z: Any, found: Any, soft: Any) -> Any:
    """Return (count, height above the surface, slope, distance and height above the nearest reference), metres."""
    n = 0
    near = -1
    near2 = np.int64(1) << 60
    for q in range(4):
        j = found[q]
        if j < 0:
            continue
        n += 1
        dx = np.int64(pos[j, 0]) - x
        dy = np.int64(pos[j, 1]) - y
        d2 = dx * dx + dy * dy
        if d2 < near2 or (d2 == near2 and before(pos, j, near)):
            near2 = d2
            near = j
    if n == 0:
        return 0, 0.0, 0.0, 0.0, 0.0
    d = np.sqrt(near2 * 1e-6)
    step = (z - np.int64(pos[near, 2])) * 1e-3
    ws = 0.0
    xm = ym = zm = 0.0
    weak = 1e-4 if n < 3 else soft
    for q in range(4):
        j = found[q]
        if j >= 0:
            dx = (pos[j, 0] - np.int64(x)) * 1e-3
            dy = (pos[j, 1] - np.int64(y)) * 1e-3
            w = 1.0 / (dx * dx + dy * dy + weak)
            ws += w
            xm += w * dx
            ym += w * dy
            zm += w * ((pos[j, 2] - np.int64(z)) * 1e-3)
    xm /= ws
    ym /= ws
    zm /= ws
    if n < 3:
        return n, -zm, 0.0, d, step
    scale = n / ws
    sxx = syy = soft
    sxy = sxz = syz = 0.0
    for q in range(4):
        j = found[q]
        if j >= 0:
            dx = (pos[j, 0] - np.int64(x)) * 1e-3
            dy = (pos[j, 1] - np.int64(y)) * 1e-3
            w = scale / (dx * dx + dy * dy + weak)
            dz = (pos[j, 2] - np.int64(z)) * 1e-3 - zm
            dx -= xm
            dy -= ym
            sxx += w * dx * dx
            sxy += w * dx * dy
            syy += w * dy * dy
            sxz += w * dx * dz
            syz += w * dy * dz
    det = sxx * syy - sxy * sxy
    a = (sxz * syy - syz * sxy) / det
    b = (syz * sxx - sxz * sxy) / det
    slope = np.sqrt(a * a + b * b)
    if slope > 3.0:
        a *= 3.0 / slope
        b *= 3.0 / slope
        slope = 3.0
    return n, a * xm + b * ym - zm, slope, d, step
