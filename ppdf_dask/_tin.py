"""Heights of a TIN at many places, by walking through the exact triangulation."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ppdf_dask._delaunay import CORNERS, MAX_SPAN, Triangulation, curve_order, locate

_STEP = 1e-3
_HALF = MAX_SPAN // 2 - 2


def interpolate(nodes: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate linearly in the Delaunay triangulation of `nodes`.

    Parameters
    ----------
    nodes : ndarray of float64, shape (n, 3)
        Finite; of nodes at one place the lowest counts.
    xy : ndarray of float64, shape (m, 2)
        Places, any order.

    Returns
    -------
    ndarray of float64, shape (m,)
        Heights; NaN outside the hull, and in slivers along it: a triangle that rests on a hull's edge of length L and
        is lower than about L^2 / 536 km may be missing (2 cm for L = 100 m).

    Notes
    -----
    x and y are rounded to 0.001 units, coarser only for extents beyond 60 000 units; z is not.

    Examples
    --------
    >>> plane = np.array([(0, 0, 0), (10, 0, 1), (0, 10, 0), (10, 10, 1)], float)
    >>> interpolate(plane, np.array([(5.0, 5.0), (2.5, 0.5), (11.0, 5.0)])).tolist()
    [0.5, 0.25, nan]
    """
    out = np.full(len(xy), np.nan)
    if len(nodes) < 3:
        return out
    low, high = nodes[:, :2].min(axis=0), nodes[:, :2].max(axis=0)
    inside = np.flatnonzero(np.all((xy >= low) & (xy <= high), axis=1))
    if len(inside) == 0:
        return out
    middle = np.round((low + high) / 2)
    step = max(_STEP, float((high - low).max()) / (0.9 * _HALF))
    # The triangulation keeps the lowest third coordinate at a place: a rank by height leads back to the node.
    rank = np.argsort(nodes[:, 2], kind="stable")
    placed = np.empty((len(nodes), 3), np.int32)
    placed[:, :2] = np.rint((nodes[rank, :2] - middle) / step)
    placed[:, 2] = np.arange(len(nodes))
    tin = Triangulation(_HALF)
    tin.insert(placed)
    asked = np.rint((xy[inside] - middle) / step).astype(np.int32)
    heights = np.empty(len(inside))
    _heights(tin.vertices, tin.triangles, nodes[rank, 2], asked, curve_order(asked), heights)
    out[inside] = heights
    return out


@njit(nogil=True, cache=True)
def _is_outer(triangles, t):  # type: ignore[no-untyped-def]
    return t < 0 or triangles[t, 0] < CORNERS or triangles[t, 1] < CORNERS or triangles[t, 2] < CORNERS


@njit(nogil=True, cache=True)
def _heights(vertices, triangles, z, asked, order, out):  # type: ignore[no-untyped-def]
    t = len(triangles) - 1
    for k in order:
        x, y = np.int64(asked[k, 0]), np.int64(asked[k, 1])
        t = locate(vertices, triangles, t, x, y)
        home = t
        if _is_outer(triangles, t):
            # A place on the hull's edge lies in two triangles, and the walk may end in the outer one.
            for i in range(3):
                p, q = triangles[t, (i + 1) % 3], triangles[t, (i + 2) % 3]
                side = (np.int64(vertices[q, 0]) - vertices[p, 0]) * (y - vertices[p, 1])
                side -= (np.int64(vertices[q, 1]) - vertices[p, 1]) * (x - vertices[p, 0])
                if side == 0 and not _is_outer(triangles, triangles[t, 3 + i]):
                    home = triangles[t, 3 + i]
        if _is_outer(triangles, home):
            out[k] = np.nan
            continue
        a, b, c = triangles[home, 0], triangles[home, 1], triangles[home, 2]
        ux, uy = float(vertices[b, 0]) - vertices[a, 0], float(vertices[b, 1]) - vertices[a, 1]
        vx, vy = float(vertices[c, 0]) - vertices[a, 0], float(vertices[c, 1]) - vertices[a, 1]
        px, py = float(x) - vertices[a, 0], float(y) - vertices[a, 1]
        area = ux * vy - uy * vx
        za, zb, zc = z[vertices[a, 2]], z[vertices[b, 2]], z[vertices[c, 2]]
        out[k] = za + ((px * vy - py * vx) * (zb - za) + (ux * py - uy * px) * (zc - za)) / area
