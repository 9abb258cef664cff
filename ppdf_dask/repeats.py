"""Points at the very place of another one: counted where a chunk has them all, looked for where two tiles overlap."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import numpy.typing as npt

from ppdf_dask.grid import Rect
from ppdf_dask.params import ClassRules
from ppdf_dask.reader import batches
from ppdf_dask.tiles import Problem, Tile

PAIRS = 4
"""Overlapping pairs of tiles whose points the scan compares, those that overlap most.

A delivery with buffers around its tiles, or with a tile twice, shows it there, and the scan of a country still takes
seconds."""

POINTS = 2_000_000
"""Points of each such tile that are read."""

SHARE = 0.01
"""Part of the points in an overlap from which on two tiles are said to hold the same ones; on a grid of centimetres
single points of two flight lines may meet by chance."""

Places = npt.NDArray[np.int32] | npt.NDArray[np.int64]


def repeats(points: Places, counts: Mapping[str, int]) -> tuple[int, dict[str, int]]:
    """Count the points of a chunk at whose place another one of it lies.

    Parameters
    ----------
    points : ndarray of int32 or int64, shape (3 or more, n)
        x, y, z in the rows; source after source.
    counts : mapping
        Points of each source, in that order.

    Returns
    -------
    repeated : int
        Points but for one at each place.
    shared : dict
        ``"a b"``, two sources by name, to the number of places where both have a point.

    Examples
    --------
    >>> repeats(np.array([[1, 1, 2, 1], [0, 0, 0, 0], [5, 5, 5, 5]]), {"s_0": 3, "s_1": 1})
    (2, {'s_0 s_1': 1})
    """
    index, place = _together(points)
    if len(index) == 0:
        return 0, {}
    repeated = len(index) - len(np.unique(place))
    names = list(counts)
    source = np.searchsorted(np.cumsum(list(counts.values())), index, side="right")
    held = np.unique(np.stack([place, source]), axis=1)
    shared: dict[str, int] = {}
    for step in range(1, len(names)):
        same = held[0, step:] == held[0, :-step]
        if not same.any():
            break
        pairs, times = np.unique(np.stack([held[1, :-step], held[1, step:]])[:, same], axis=1, return_counts=True)
        for (a, b), n in zip(pairs.T, times, strict=True):
            key = " ".join(sorted((names[a], names[b])))
            shared[key] = shared.get(key, 0) + int(n)
    return repeated, dict(sorted(shared.items()))


def _together(points: Places) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return points that may share their place, ascending, and a number of each one's place."""
    keys = _keys(points)
    ordered = np.sort(keys)
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(twice) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    index = np.flatnonzero(np.isin(keys, twice))
    # Equal keys may be unequal places; what is counted are places.
    _, place = np.unique(points[:3, index], axis=1, return_inverse=True)
    return index, place.ravel()


def _keys(points: Places) -> npt.NDArray[np.uint64]:
    """Return a number for each place that other places hardly ever have."""
    factors = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
    keys = np.zeros(points.shape[1], np.uint64)
    for row, factor in zip(points[:3], factors, strict=True):
        keys += row.astype(np.int64).view(np.uint64) * np.uint64(factor)
    return keys


def share_of_same_points(first: Tile, second: Tile, unit_xy: float, unit_z: float) -> float:
    """Return which part of the points in the overlap of two tiles both have, 0 to 1, of the tile that has fewer there.

    The first `POINTS` of each file are read.
    """
    a, b = first.bounds, second.bounds
    place = Rect(max(a.x0, b.x0), max(a.y0, b.y0), min(a.x1, b.x1), min(a.y1, b.y1))
    one, other = (np.unique(np.concatenate(list(_keys_in(t, place, unit_xy, unit_z)))) for t in (first, second))
    fewer = min(len(one), len(other))
    return float(np.isin(one, other, assume_unique=True).sum()) / fewer if fewer else 0.0


def _keys_in(tile: Tile, place: Rect, unit_xy: float, unit_z: float) -> Iterator[npt.NDArray[np.uint64]]:
    left = POINTS
    yield np.empty(0, np.uint64)
    for batch in batches(tile, unit_xy=unit_xy, unit_z=unit_z, rules=ClassRules(), returns="all"):
        x, y, z = (v[:left] for v in (batch.x, batch.y, batch.z))
        inside = (x >= place.x0) & (x < place.x1) & (y >= place.y0) & (y < place.y1)
        yield _keys(np.stack([x[inside], y[inside], z[inside]]))
        left -= len(x)
        if left <= 0:
            return


def shared_problems(
    tiles: Mapping[str, Tile], looked_at: Mapping[str, int], shared: Iterable[Mapping[str, int]]
) -> Iterator[Problem]:
    """Yield what a run found: tiles with points at the places of another tile's.

    Parameters
    ----------
    tiles : mapping
        Source id to tile.
    repeated : mapping
        Source id to its number of points that were looked at.
    shared : iterable of mapping
        What `repeats` returned for each chunk.
    """
    total: dict[str, int] = {}
    for chunk in shared:
        for pair, n in chunk.items():
            total[pair] = total.get(pair, 0) + n
    for pair, n in sorted(total.items()):
        a, b = pair.split(" ")
        if n > SHARE * min(looked_at[a], looked_at[b]):
            message = f"shares {n:,} places with {tiles[a].path}; such points are looked at twice and get one label"
            yield Problem(tiles[b].path, "shared", message, False)
