"""Progressive RANSAC planes and the ground seeds they give (sections 2.4 and 2.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Bools, Cloud
from ppdf_dask.filters.ppdf.paper import _plane_kernels as kernels
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.filters.ppdf.paper.squares import Longs, Squares
from ppdf_dask.grid import MM

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Planes:
    """Accepted planes, each bounded by its own square; the squares never overlap.

    Attributes
    ----------
    corner : ndarray of float64, shape (m, 2)
        Lower-left corner of each square, absolute metres.
    size : ndarray of float64, shape (m,)
        Edge of each square, m.
    normal : ndarray of float64, shape (m, 3)
        Unit normal, the third part positive.
    point : ndarray of float64, shape (m, 3)
        A point of the plane, absolute metres.
    support : ndarray of int64, shape (m,)
        Number of inliers among the points under the canopy.
    """

    corner: Floats
    size: Floats
    normal: Floats
    point: Floats
    support: Longs

    def __len__(self) -> int:
        return len(self.size)

    @classmethod
    def none(cls) -> Planes:
        """Return an empty collection."""
        return cls(np.empty((0, 2)), np.empty(0), np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.int64))


def plane_seeds(cloud: Cloud, squares: Squares, under: Bools, params: PaperParams) -> tuple[Bools, Planes]:
    """Detect planes in ever smaller squares and mark the points near them.

    A square's plane is the one with most inliers among hashed triples of its points under the canopy, refitted once by
    least squares; it is kept when no such point lies `division_distance` or more below it, else the square is cut
    in four. A square with too few points or inliers is given up: its quarters could not do better.

    Parameters
    ----------
    cloud : Cloud
        Gives the origin.
    squares : Squares
        The points, sorted by squares of `params.plane_size`.
    under : ndarray of bool, shape (n,)
        Points under the canopy, in the order of `squares`.
    params : PaperParams
        The distances and `min_inliers`.

    Returns
    -------
    seeds : ndarray of bool, shape (n,)
        Every point of a kept plane's square nearer to it than `seed_distance`, in the order of `squares`.
    planes : Planes
        The kept planes, one per square.

    Notes
    -----
    Cai, Liang, Yu 2023, section 2.4 and Eq. 2 (perpendicular distance; the printed formula lost its bars and root).
    Random numbers are hashed from the absolute address and size of the square and the trial.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> from ppdf_dask.filters.ppdf.paper.squares import sort_by_square
    >>> x, y = (v.ravel() for v in np.meshgrid(np.arange(0.5, 10), np.arange(0.5, 10)))
    >>> squares = sort_by_square(cloud := cloud_from_xyz(np.column_stack([x, y, 0.2 * x])), 10_000)
    >>> seeds, planes = plane_seeds(cloud, squares, np.ones(100, bool), PaperParams())
    >>> int(seeds.sum()), planes.size.tolist(), planes.support.tolist()
    (100, [10.0], [100])
    """
    n, edge = len(squares.x), squares.edge
    seeds = np.zeros(n, bool)
    most = n // max(3, params.min_inliers)
    found, cells = np.empty((most, 9)), np.empty((most, 5), np.int64)
    distances = np.array([params.inlier_distance, params.division_distance, params.seed_distance]) * MM
    count = kernels.detect(
        squares.x, squares.y, squares.z, under, squares.starts, squares.ix, squares.iy,
        np.array(cloud.origin, np.int64), edge, params.min_inliers, distances, seeds, found, cells,
    )  # fmt: skip
    found, cells = found[:count], cells[:count]
    size = (edge / MM) * 0.5 ** cells[:, 2].astype(np.float64)
    corner = cells[:, :2] * size[:, None]
    base = np.column_stack([squares.ix[cells[:, 4]] * edge, squares.iy[cells[:, 4]] * edge, np.zeros(count)])
    point = (base + found[:, 3:6] + found[:, 6:9]) / MM
    return seeds, Planes(corner, size, found[:, :3].copy(), point, cells[:, 3].copy())


def lowest_seeds(squares: Squares) -> Bools:
    """Mark the lowest point of each square by (z, x, y): the local minimum method of the paper's ablation.

    Parameters
    ----------
    squares : Squares
        The points, sorted.

    Returns
    -------
    ndarray of bool, shape (n,)
        One True per occupied square, in the order of `squares`.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> from ppdf_dask.filters.ppdf.paper.squares import sort_by_square
    >>> squares = sort_by_square(cloud_from_xyz([[1, 1, 5.0], [2, 1, 3.0], [3, 1, 3.0], [12, 1, 9.0]]), 10_000)
    >>> lowest_seeds(squares).tolist()
    [False, True, False, True]
    """
    seeds = np.zeros(len(squares.x), bool)
    kernels.lowest(squares.z, squares.starts, seeds)
    return seeds
