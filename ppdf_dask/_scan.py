"""Kernels between a triangulation and a raster: heights by plane, distance to the nearest point, and the proof.

Coordinates of points are millimetres from the window's centre; a pixel's centre is given in half millimetres, so that
every test is an integer's. A pixel takes the lowest height of all allowed triangles that hold its centre, edges
included: on a shared edge the two differ in the last bit only, and no order of triangles can decide.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ppdf_dask._delaunay import CORNERS, orient

_SLACK = 1e-6
"""Pixels by which a triangle's box is taken too large, far more than rounding: what counts is decided in integers."""


@njit(nogil=True, cache=True)
def _squared(ax, ay, bx, by):  # type: ignore[no-untyped-def]
    return (bx - ax) * (bx - ax) + (by - ay) * (by - ay)


@njit(nogil=True, cache=True)
def crop(points, shift_x, shift_y, box, out):  # type: ignore[no-untyped-def]
    """Write the shifted points, (3, n), that lie in the closed box to the first rows of `out`; return their number."""
    end = 0
    for i in range(points.shape[1]):
        x, y = points[0, i] + shift_x, points[1, i] + shift_y
        if box[0] <= x <= box[2] and box[1] <= y <= box[3]:
            out[end, 0], out[end, 1], out[end, 2] = x, y, points[2, i]
            end += 1
    return end


@njit(nogil=True, cache=True)
def _longest_and_radius(ax, ay, bx, by, cx, cy):  # type: ignore[no-untyped-def]
    """Return the squared longest edge and the squared radius of the circle; vertices in the order of (x, y)."""
    p, q, r = _squared(ax, ay, bx, by), _squared(bx, by, cx, cy), _squared(cx, cy, ax, ay)
    turn = float(orient(ax, ay, bx, by, cx, cy))
    return max(p, q, r), float(p) * float(q) * float(r) / (4.0 * turn * turn)


@njit(nogil=True, cache=True)
def _circle_box(ax, ay, bx, by, cx, cy, radius):  # type: ignore[no-untyped-def]
    """Return a box in mm (x0, y0, x1, y1, closed) that surely holds the triangle's circle."""
    turn = 2.0 * orient(ax, ay, bx, by, cx, cy)
    b, c = float(_squared(ax, ay, bx, by)), float(_squared(ax, ay, cx, cy))
    ux1, ux2 = b * (cy - ay), c * (by - ay)
    uy1, uy2 = c * (bx - ax), b * (cx - ax)
    x, y = ax + (ux1 - ux2) / turn, ay + (uy1 - uy2) / turn
    # 1e-14 is generous: the terms carry some 4 units of 2**-53 each.
    doubt = 1e-14 * (abs(ux1) + abs(ux2) + abs(uy1) + abs(uy2)) / abs(turn) + 1e-14 * radius + 1.0
    reach = radius + doubt
    return x - reach, y - reach, x + reach, y + reach


@njit(nogil=True, cache=True)
def _span(e0, step, low, high):  # type: ignore[no-untyped-def]
    """Cut the columns low..high down to those with ``e0 + step * column >= 0``."""
    if step > 0:
        return max(low, -(e0 // step)), high
    if step < 0:
        return low, min(high, e0 // -step)
    return (low, high) if e0 >= 0 else (1, 0)


@njit(nogil=True, cache=True)
def _ask(need, x0, y0, x1, y1, ex0, ey0, ex1, ey1):  # type: ignore[no-untyped-def]
    """Widen the box `need` by the part of a box that lies inside the survey's extent."""
    x0, y0, x1, y1 = max(x0, ex0), max(y0, ey0), min(x1, ex1), min(y1, ey1)
    if x0 <= x1 and y0 <= y1:
        need[0], need[1] = min(need[0], math.floor(x0)), min(need[1], math.floor(y0))
        need[2], need[3] = max(need[2], math.ceil(x1)), max(need[3], math.ceil(y1))


@njit(nogil=True, cache=True)
def heights(vertices, triangles, first, step, limits, extent, out, home, need):  # type: ignore[no-untyped-def]
    """Fill `out` with the heights in mm of the pixels and widen `need` by what a proof would have to see.

    Parameters
    ----------
    vertices, triangles : ndarray
        The triangulation.
    first : ndarray of int64, (2,)
        Centre of the upper left pixel, half millimetres.
    step : int
        Pixel size, half millimetres.
    limits : ndarray of int64, (k,)
        For each layer of `out` the longest edge and radius, mm, ascending.
    extent : ndarray of int64, (4,)
        Closed box (x0, y0, x1, y1), mm: where points can be at all.
    out : ndarray of float64, (k, rows, columns)
        Heights in mm, NaN on entry.
    home : ndarray of int32, (rows, columns)
        Set to a triangle that holds the pixel's centre.
    need : ndarray of int64, (4,)
        Closed box, mm; widened where a pixel's triangle might change if more were loaded.
    """
    layers, rows, columns = out.shape
    reach = 2 * limits[-1]
    inverse = 1.0 / step
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay = np.int64(vertices[i, 0]), np.int64(vertices[i, 1])
        bx, by = np.int64(vertices[j, 0]), np.int64(vertices[j, 1])
        cx, cy = np.int64(vertices[k, 0]), np.int64(vertices[k, 1])
        # Most triangles lie between the centres, and dividing integers would be the larger part of the work.
        c0 = max(0, math.ceil((2 * min(ax, bx, cx) - first[0]) * inverse - _SLACK))
        c1 = min(columns - 1, math.floor((2 * max(ax, bx, cx) - first[0]) * inverse + _SLACK))
        r0 = max(0, math.ceil((first[1] - 2 * max(ay, by, cy)) * inverse - _SLACK))
        r1 = min(rows - 1, math.floor((first[1] - 2 * min(ay, by, cy)) * inverse + _SLACK))
        if (c0 > c1) | (r0 > r1):
            continue
        real = i >= CORNERS and j >= CORNERS and k >= CORNERS
        used_c0, used_c1, used_r0, used_r1 = columns, -1, rows, -1
        measured = False
        longest, radius2, turn = np.int64(0), 0.0, 0.0
        px, py, qx, qy, sx, sy = ax, ay, bx, by, cx, cy
        pz, qz, sz = vertices[i, 2], vertices[j, 2], vertices[k, 2]
        for r in range(r0, r1 + 1):
            y = first[1] - r * step
            low, high = c0, c1
            low, high = _span(orient(2 * ax, 2 * ay, 2 * bx, 2 * by, first[0], y), 2 * step * (ay - by), low, high)
            low, high = _span(orient(2 * bx, 2 * by, 2 * cx, 2 * cy, first[0], y), 2 * step * (by - cy), low, high)
            low, high = _span(orient(2 * cx, 2 * cy, 2 * ax, 2 * ay, first[0], y), 2 * step * (cy - ay), low, high)
            if low > high:
                continue
            used_c0, used_c1 = min(used_c0, low), max(used_c1, high)
            used_r0, used_r1 = min(used_r0, r), max(used_r1, r)
            for c in range(low, high + 1):
                home[r, c] = t
            if not real:
                continue
            if not measured:
                # The same triangle must give the same bits from any window: its vertices in the order of (x, y).
                if qx < px or (qx == px and qy < py):
                    px, py, pz, qx, qy, qz = qx, qy, qz, px, py, pz
                if sx < qx or (sx == qx and sy < qy):
                    qx, qy, qz, sx, sy, sz = sx, sy, sz, qx, qy, qz
                if qx < px or (qx == px and qy < py):
                    px, py, pz, qx, qy, qz = qx, qy, qz, px, py, pz
                longest, radius2 = _longest_and_radius(px, py, qx, qy, sx, sy)
                turn = float(orient(2 * px, 2 * py, 2 * qx, 2 * qy, 2 * sx, 2 * sy))
                measured = True
            for layer in range(layers):
                limit = limits[layer]
                if longest > limit * limit or radius2 > float(limit * limit):
                    continue
                for c in range(low, high + 1):
                    x = first[0] + c * step
                    wq = float(orient(2 * px, 2 * py, x, y, 2 * sx, 2 * sy))
                    ws = float(orient(2 * px, 2 * py, 2 * qx, 2 * qy, x, y))
                    z = pz + ((np.int64(qz) - pz) * wq + (np.int64(sz) - pz) * ws) / turn
                    if not out[layer, r, c] <= z:
                        out[layer, r, c] = z
        if used_c0 > used_c1:
            continue
        x0, x1 = (first[0] + used_c0 * step) // 2 - reach, (first[0] + used_c1 * step + 1) // 2 + reach
        y0, y1 = (first[1] - used_r1 * step) // 2 - reach, (first[1] - used_r0 * step + 1) // 2 + reach
        if real:
            u0, v0, u1, v1 = _circle_box(px, py, qx, qy, sx, sy, math.sqrt(radius2))
            _ask(need, max(x0, u0), max(y0, v0), min(x1, u1), min(y1, v1), extent[0], extent[1], extent[2], extent[3])
        else:
            _ask(need, x0, y0, x1, y1, extent[0], extent[1], extent[2], extent[3])


@njit(nogil=True, cache=True)
def _around(vertices, triangles, v, t, x, y, best, best_v, best_t):  # type: ignore[no-untyped-def]
    """Look at the neighbours of `v`, of which `t` is a triangle; return the nearest to (x, y), half mm."""
    for way in (1, 2):
        u = t
        while True:
            i = 0
            while triangles[u, i] != v:
                i += 1
            # The neighbour on the edge that is crossed next: so each one is looked at once.
            w = triangles[u, (i + 3 - way) % 3]
            d = _squared(2 * np.int64(vertices[w, 0]), 2 * np.int64(vertices[w, 1]), x, y)
            if d < best:
                best, best_v, best_t = d, w, u
            u = triangles[u, 3 + (i + way) % 3]
            if u == t:
                return best, best_v, best_t
            if u < 0:
                break
    return best, best_v, best_t


@njit(nogil=True, cache=True)
def distances(vertices, triangles, home, first, step, limit, extent, out, need):  # type: ignore[no-untyped-def]
    """Fill `out` with the distance in mm of each pixel's centre to the nearest point, inf beyond `limit` mm.

    First each point tells the pixels around it. One that hears of a point within one and a half pixels has heard of
    the nearest. The others walk: from a point that is not the nearest, an edge of the Delaunay triangulation leads to
    a nearer one. A walk begins where the last one ended or, where that is nearer, at the triangle that `heights` found.
    The corners lie farther off than any limit.
    """
    rows, columns = out.shape
    _tell(vertices, first, step, out)
    t = home[0, 0]
    v = triangles[t, 0]
    for r in range(rows):
        # Rows run to and fro, so that the walk stays short.
        for k in range(columns):
            c = k if r % 2 == 0 else columns - 1 - k
            x, y = first[0] + c * step, first[1] - r * step
            gap_x, gap_y = max(2 * extent[0] - x, x - 2 * extent[2], 0), max(2 * extent[1] - y, y - 2 * extent[3], 0)
            if gap_x * gap_x + gap_y * gap_y > 4 * limit * limit:
                out[r, c] = np.inf
                continue
            if 4.0 * out[r, c] < 9.0 * step * step:
                best, found = np.int64(out[r, c]), True
            else:
                best = _squared(2 * np.int64(vertices[v, 0]), 2 * np.int64(vertices[v, 1]), x, y)
                for i in range(3):
                    w = triangles[home[r, c], i]
                    nearest = _squared(2 * np.int64(vertices[w, 0]), 2 * np.int64(vertices[w, 1]), x, y)
                    if nearest < best:
                        best, v, t = nearest, w, home[r, c]
                while True:
                    nearest, w, u = _around(vertices, triangles, v, t, x, y, best, v, t)
                    if nearest >= best:
                        break
                    best, v, t = nearest, w, u
                found = v >= CORNERS
            if found and best <= 4 * limit * limit:
                out[r, c] = math.sqrt(float(best)) / 2.0
                d = out[r, c] + 1.0
            else:
                out[r, c] = np.inf
                d = float(limit)
            _ask(need, x / 2.0 - d, y / 2.0 - d, x / 2.0 + d, y / 2.0 + d, extent[0], extent[1], extent[2], extent[3])


@njit(nogil=True, cache=True)
def _tell(vertices, first, step, out):  # type: ignore[no-untyped-def]
    """Lower the squared distances in `out`, half mm, to each point's at the 3 x 3 pixels around its own."""
    rows, columns = out.shape
    inverse = 1.0 / step
    for v in range(CORNERS, len(vertices)):
        x, y = 2 * np.int64(vertices[v, 0]) - first[0], first[1] - 2 * np.int64(vertices[v, 1])
        # Rounding can move a point on a pixel's edge only, which the centre beyond the next one need not hear of.
        c, r = math.floor(x * inverse + 0.5), math.floor(y * inverse + 0.5)
        if c < -1 or r < -1 or c > columns or r > rows:
            continue
        whole = 1 <= c < columns - 1
        left = float((c - 1) * step - x)
        one, two, three = left * left, (left + step) * (left + step), (left + 2 * step) * (left + 2 * step)
        for i in range(max(0, r - 1), min(rows, r + 2)):
            across = float(i * step - y)
            across *= across
            if whole:
                out[i, c - 1] = min(out[i, c - 1], one + across)
                out[i, c] = min(out[i, c], two + across)
                out[i, c + 1] = min(out[i, c + 1], three + across)
            else:
                for j in range(max(0, c - 1), min(columns, c + 2)):
                    out[i, j] = min(out[i, j], float((j * step - x) ** 2) + across)
