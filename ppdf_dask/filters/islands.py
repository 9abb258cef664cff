"""Cut a cloud into islands, so that one stray point never spans a raster over the empty land between.

The classic filters think in rasters and triangulations of the whole cloud. Points far from all others are therefore
looked at by themselves: an island is a group of occupied absolute blocks that touch at an edge or a corner.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ppdf_dask.filters.cloud import Bools, Cloud, Verdict
from ppdf_dask.grid import MM

BLOCK = 250 * MM
"""Smallest edge of a block, mm: wider than the windows of the classic filters, so that nothing is cut that belongs
together; small enough that a handful of stray points never spans a large raster."""


def islands(cloud: Cloud, block: int) -> npt.NDArray[np.int32]:
    """Give each point of a cloud the number of its island.

    Parameters
    ----------
    cloud : Cloud
        Any cloud.
    block : int
        Edge of the absolute blocks, mm. Points of different islands are at least one block apart in x or in y.

    Returns
    -------
    ndarray of int32, shape (cloud.n,)
        The island of each point, 0, 1, ...; the numbers carry no meaning.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> cloud = cloud_from_xyz([[0, 0, 0], [900, 0, 0], [1500, 0, 0], [90000, 0, 0]])
    >>> islands(cloud, 1_000_000).tolist()
    [0, 0, 0, 1]
    """
    ox, oy = cloud.origin
    i, j = (_blocks(v, o, block) for v, o in ((cloud.x, ox), (cloud.y, oy)))
    if i.max(initial=0) <= 1 and j.max(initial=0) <= 1:
        return np.zeros(cloud.n, np.int32)
    width = int(j.max()) + 2
    occupied, of_point = np.unique(i * width + j, return_inverse=True)
    links = []
    for step in (1, width - 1, width, width + 1):
        at = np.searchsorted(occupied, occupied + step)
        found = np.flatnonzero(occupied[np.minimum(at, len(occupied) - 1)] == occupied + step)
        links.append((found, at[found]))
    a, b = (np.concatenate(part) for part in zip(*links, strict=True))
    graph = sparse.coo_array((np.ones(len(a), np.int8), (a, b)), shape=(len(occupied), len(occupied)))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label, np.int32)[of_point]


def _blocks(values: npt.NDArray[np.int32], origin: int, block: int) -> npt.NDArray[np.int64]:
    """Block numbers along one axis, the lowest 0."""
    if len(values) == 0:
        return np.empty(0, np.int64)
    first = (int(values.min()) + origin) // block
    if (int(values.max()) + origin) // block == first:
        return np.zeros(len(values), np.int64)
    return (values + np.int64(origin)) // block - first


def by_island(cloud: Cloud, reach: float, label: Callable[[Cloud], Bools]) -> Verdict:
    """Classify each island of a cloud by itself.

    Parameters
    ----------
    cloud : Cloud
        Any cloud; `Cloud.known` is not looked at, since the classic filters cannot prove their answers.
    reach : float
        Metres over which the filter looks; no block is smaller.
    label : callable
        ``label(island) -> ndarray of bool, shape (island.n_core,)``; called for islands with a core point and at least
        three distinct points only.

    Returns
    -------
    Verdict
        Points of islands with fewer than three distinct points are not ground; nothing is marked unproven.
    """
    ground = np.zeros(cloud.n_core, np.bool_)
    unproven = np.zeros(cloud.n_core, np.bool_)
    numbers = islands(cloud, max(BLOCK, round(reach * MM)))
    if cloud.n and not numbers.any():
        if cloud.n_core and _three_distinct(cloud):
            ground[:] = label(cloud)
        return Verdict(ground, unproven)
    order = np.argsort(numbers, kind="stable")
    ends = np.flatnonzero(np.diff(numbers[order], append=-1)) + 1
    for members in np.split(order, ends[:-1]):
        n_core = int(np.searchsorted(members, cloud.n_core))
        island = Cloud(cloud.x[members], cloud.y[members], cloud.z[members], cloud.origin, n_core)
        if n_core and _three_distinct(island):
            ground[members[:n_core]] = label(island)
    return Verdict(ground, unproven)


def _three_distinct(cloud: Cloud) -> bool:
    """Tell whether the cloud has at least three different points."""
    other = np.ones(cloud.n, np.bool_)
    for _ in range(2):
        k = int(other.argmax())
        if not (cloud.n and other[k]):
            return False
        other &= (cloud.x != cloud.x[k]) | (cloud.y != cloud.y[k]) | (cloud.z != cloud.z[k])
    return bool(other.any())
