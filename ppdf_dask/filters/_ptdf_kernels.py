"""Kernels of progressive TIN densification: thinning, the facet test, the passes, the final labels."""

from __future__ import annotations

import numpy as np
from numba import njit

from ppdf_dask._delaunay import CORNERS, insert_at, locate, orient

OFF, STEEP, FAILED = 0, 1, 2
"""When a point is mirrored: never, in steep facets, when it fails."""


@njit(nogil=True, cache=True)
def lowest_of_runs(key, order, x, y, z):  # type: ignore[no-untyped-def]
    """Return the index of the lowest point by (z, x, y) of each run of equal keys in `order`."""
    out = np.empty(len(order), np.int64)
    n = 0
    best = -1
    for k in order:
        if best < 0 or key[k] != key[best]:
            out[n] = k
            n += 1
            best = k
        elif z[k] < z[best] or (z[k] == z[best] and (x[k] < x[best] or (x[k] == x[best] and y[k] < y[best]))):
            out[n - 1] = k
            best = k
    return out[:n]


@njit(nogil=True, cache=True)
def _hold(vertices, triangles, t, x, y):  # type: ignore[no-untyped-def]
    """Find the facet that holds a place, from `t` on, and the vertex at that place or -1.

    A place on an edge belongs to the facet left of the edge's way up in (x, y), wherever the walk came from.
    """
    t = locate(vertices, triangles, t, x, y)
    for i in range(3):
        v = triangles[t, i]
        if vertices[v, 0] == x and vertices[v, 1] == y:
            return t, v
    for i in range(3):
        a, b = triangles[t, (i + 1) % 3], triangles[t, (i + 2) % 3]
        ax, ay = np.int64(vertices[a, 0]), np.int64(vertices[a, 1])
        bx, by = np.int64(vertices[b, 0]), np.int64(vertices[b, 1])
        if (bx < ax or (bx == ax and by < ay)) and orient(ax, ay, bx, by, x, y) == 0:
            return triangles[t, 3 + i], -1
    return t, -1


@njit(nogil=True, cache=True)
def _facet(vertices, t, corner, plane):  # type: ignore[no-untyped-def]
    """Write the three corners and the normal of a facet; return False when it holds a corner of the square."""
    for i in range(3):
        v = t[i]
        if v < CORNERS:
            return False
        for axis in range(3):
            corner[i, axis] = vertices[v, axis]
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    plane[0] = uy * vz - uz * vy
    plane[1] = uz * vx - ux * vz
    plane[2] = ux * vy - uy * vx
    return True


@njit(nogil=True, cache=True)
def _distances(corner, plane, x, y, z):  # type: ignore[no-untyped-def]
    """Return the squared distances of a point to the plane and to the nearest corner of a facet."""
    near2 = np.inf
    rise = 0.0
    for i in range(3):
        dx, dy, dz = x - corner[i, 0], y - corner[i, 1], z - corner[i, 2]
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < near2:
            near2 = d2
            # Taken at the nearest corner, so that a vertex is exactly on its facets.
            rise = plane[0] * dx + plane[1] * dy + plane[2] * dz
    return rise * rise / (plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]), near2


@njit(nogil=True, cache=True)
def _foot_inside(corner, plane, x, y, z):  # type: ignore[no-untyped-def]
    """Tell whether the perpendicular from a point meets the facet's plane inside the facet."""
    rise = plane[0] * (x - corner[0, 0]) + plane[1] * (y - corner[0, 1]) + plane[2] * (z - corner[0, 2])
    rise /= plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]
    x -= rise * plane[0]
    y -= rise * plane[1]
    for i in range(3):
        a, b = corner[i], corner[(i + 1) % 3]
        if (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) < 0.0:
            return False
    return True


@njit(nogil=True, cache=True)
def _judge(corner, plane, x, y, z, limits):  # type: ignore[no-untyped-def]
    """Return whether a point keeps the limits in a facet (see `_test`), and its squared distance to it."""
    d2, near2 = _distances(corner, plane, x, y, z)
    passes = d2 == 0.0 or (d2 < limits[0] and d2 < limits[1] * near2)
    if passes and d2 > 0.0 and limits[4] > 0.0:
        passes = _foot_inside(corner, plane, float(x), float(y), float(z))
    return passes, d2


@njit(nogil=True, cache=True)
def _longest2(corner):  # type: ignore[no-untyped-def]
    longest = 0.0
    for i in range(3):
        dx = corner[i, 0] - corner[(i + 1) % 3, 0]
        dy = corner[i, 1] - corner[(i + 1) % 3, 1]
        longest = max(longest, dx * dx + dy * dy)
    return longest


@njit(nogil=True, cache=True)
def _highest(corner):  # type: ignore[no-untyped-def]
    """Return the highest corner of a facet by (z, x, y)."""
    best = 0
    for i in range(1, 3):
        a, b = corner[i], corner[best]
        if a[2] > b[2] or (a[2] == b[2] and (a[0] > b[0] or (a[0] == b[0] and a[1] > b[1]))):
            best = i
    return best


@njit(nogil=True, cache=True)
def _test(vertices, triangles, t, x, y, z, limits, mirror, corner, plane):  # type: ignore[no-untyped-def]
    """Put a point to the test of the facet `t` that holds it.

    `limits`: squared distance, squared sine of the angle, squared tangent of the terrain angle, half of the square, and
    whether the perpendicular must meet the facet (1) or only its plane (0). Returns whether the point passes, the
    squared distance to the facet, and whether its mirror was asked.
    """
    if not _facet(vertices, triangles[t], corner, plane):
        return False, np.inf, False
    steep = plane[0] * plane[0] + plane[1] * plane[1] > limits[2] * plane[2] * plane[2]
    passes, d2 = _judge(corner, plane, x, y, z, limits)
    if not ((mirror == STEEP and steep) or (mirror == FAILED and not passes)):
        return passes, d2, False
    v = _highest(corner)
    mx, my = 2 * np.int64(corner[v, 0]) - x, 2 * np.int64(corner[v, 1]) - y
    if abs(mx) >= limits[3] or abs(my) >= limits[3]:
        return False, np.inf, True
    u, _ = _hold(vertices, triangles, t, mx, my)
    if not _facet(vertices, triangles[u], corner, plane):
        return False, np.inf, True
    passes, d2 = _judge(corner, plane, mx, my, z, limits)
    return passes, d2, True


@njit(nogil=True, cache=True)
def densify(vertices, triangles, count, candidates, limits, frozen2, mirror):  # type: ignore[no-untyped-def]
    """Add to each facet, pass by pass, its best candidate until no facet has one; return the number of vertices.

    Parameters
    ----------
    vertices, triangles : ndarray of int32
        As in `ppdf_dask._delaunay`, with room for all candidates; changed in place.
    count : int
        Vertices so far.
    candidates : ndarray of int32, shape (n, 3)
        In an order that depends on their coordinates only.
    limits : tuple of float
        See `_test`.
    frozen2 : float
        A facet whose longest edge squared is below it takes no point.
    mirror : int
        `OFF`, `STEEP` or `FAILED`.
    """
    n = len(candidates)
    facet = np.zeros(n, np.int32)
    state = np.zeros(n, np.int8)  # 0 open, 1 open and mirrored (asks a far facet: ask again each pass), 2 done
    changed = np.zeros(len(triangles), np.int32)
    best = np.full(len(triangles), -1, np.int32)
    best_d2 = np.empty(len(triangles), np.float64)
    stack = np.empty(len(triangles), np.int32)
    corner = np.empty((3, 3), np.float64)
    plane = np.empty(3, np.float64)
    last = 0
    turn = 0
    added = True
    while added:
        turn += 1
        for k in range(n):
            if state[k] == 2 or (turn > 1 and state[k] == 0 and changed[facet[k]] < turn - 1):
                continue
            x, y, z = np.int64(candidates[k, 0]), np.int64(candidates[k, 1]), np.int64(candidates[k, 2])
            t, twin = _hold(vertices, triangles, last if turn == 1 else facet[k], x, y)
            last = t
            facet[k] = t
            if twin >= 0:
                state[k] = 2
                continue
            passes, d2, mirrored = _test(vertices, triangles, t, x, y, z, limits, mirror, corner, plane)
            state[k] = 1 if mirrored else 0
            if not passes:
                continue
            if frozen2 > 0.0:
                _facet(vertices, triangles[t], corner, plane)
                if _longest2(corner) < frozen2:
                    continue
            b = best[t]
            if b < 0 or d2 < best_d2[t] or (d2 == best_d2[t] and z < candidates[b, 2]):
                best[t] = k
                best_d2[t] = d2
        added = False
        for k in range(n):
            t = facet[k]
            if state[k] == 2 or best[t] != k:
                continue
            best[t] = -1
            state[k] = 2
            added = True
            x, y, z = np.int64(candidates[k, 0]), np.int64(candidates[k, 1]), candidates[k, 2]
            t = locate(vertices, triangles, t, x, y)
            count = insert_at(vertices, triangles, stack, count, t, x, y, z)
            u = t
            while True:
                changed[u] = turn
                u = triangles[u, 4]
                if u == t:
                    break
    return count


@njit(nogil=True, cache=True)
def label(  # type: ignore[no-untyped-def]
    vertices, triangles, points, order, limits, mirror, near2_max, vertices_only, ground
):
    """Put points, in an `order` that runs from neighbour to neighbour, to the test of the finished TIN."""
    corner = np.empty((3, 3), np.float64)
    plane = np.empty(3, np.float64)
    t = 0
    for k in order:
        x, y, z = np.int64(points[k, 0]), np.int64(points[k, 1]), np.int64(points[k, 2])
        t, twin = _hold(vertices, triangles, t, x, y)
        if twin >= 0:
            # Over a vertex many facets meet; the height above it judges.
            rise = z - vertices[twin, 2]
            ground[k] = rise == 0 or (not vertices_only and rise * rise < near2_max)
        elif vertices_only:
            ground[k] = False
        else:
            passes, d2, _ = _test(vertices, triangles, t, x, y, z, limits, mirror, corner, plane)
            ground[k] = passes or d2 < near2_max
