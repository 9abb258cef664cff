"""PCOM, the profile clustering optimizing method of J. Li's thesis (ifp Stuttgart), on 3D Forest's levels.

At each level the lowest voxels of the columns are a provisional terrain. Their centroids are clustered in horizontal
profiles; small clusters (stems, stump tops, shrubs, single points below the ground) are dropped, the ground is expanded
from the rest. Only a summary of the thesis is at hand: what it leaves open is settled here and marked "completed".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import Filter
from ppdf_dask.filters import voxel as _voxel
from ppdf_dask.filters._clusters import above_neighbours, touching, window_clusters
from ppdf_dask.filters.cloud import Bools, Cloud, Verdict
from ppdf_dask.filters.voxel import COARSE, Columns, Longs, VoxelParams, coarse_to_fine
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity

NEIGHBOURS = 3
"""Radius, in voxels, within which a centroid's height is compared with its neighbours' median."""


@dataclass(frozen=True, kw_only=True)
class PcomParams(VoxelParams):
    """Parameters of PCOM; lengths "in voxels" are multiples of the level's own voxel edge.

    Parameters
    ----------
    resolution, points_per_column : float
        As in `VoxelParams`.
    min_area : float
        Smallest area of a cluster that is ground, m2; default 1 (completed): a stem or stump of 0.6 m diameter covers
        0.28.
    min_voxels : int
        A cluster has at least so many voxels at any level; default 3 (completed).
    tolerance : float
        Centroids of one profile at most this far apart in the plane belong together, in voxels; default 2.5
        (completed): diagonal neighbours may lie up to 2.83 apart, direct ones 2.24.
    half_window : int
        A profile holds a layer and so many above and below; default 1 (completed), so that a gentle slope is not cut
        at a layer's boundary; 0 is the summary's single layer.
    interior : float
        A kept centroid is dropped when it is more than this above the median of the kept ones within 3 voxels, of
        whatever layer, in voxels; default 1.5 (completed; the summary ties an "interior threshold" to the resolution).
    """

    min_area: float = quantity(1.0, "m2", low=0.0, high=1e6, doc="smallest cluster that is ground")
    min_voxels: int = quantity(3, "voxels", low=1, high=10**6, doc="smallest cluster at any level")
    tolerance: float = quantity(2.5, "voxels", low=1.0, high=10.0, doc="linking distance within a profile")
    half_window: int = quantity(1, "layers", low=0, high=3, doc="layers above and below in one profile")
    interior: float = quantity(1.5, "voxels", low=0.1, high=100.0, doc="height over the neighbours that is dropped")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("min_voxels", "half_window"):
            if not isinstance(getattr(self, name), int):
                raise ParameterError(f"{name} = {getattr(self, name)} must be a whole number")

    def smallest_cluster(self, edge: int) -> int:
        """Return how many voxels of `edge` mm a cluster must have.

        Examples
        --------
        >>> [PcomParams().smallest_cluster(edge) for edge in (500, 100, 50)]
        [4, 100, 400]
        """
        return max(self.min_voxels, -(-round(self.min_area * MM * MM) // edge**2))


@dataclass(frozen=True)
class _Terrain:
    """The provisional terrain of one level: a centroid per column, sorted by column and row index."""

    ix: Longs
    iy: Longs
    layer: Longs
    cx: Longs
    cy: Longs
    cz: Longs


def ground_tops(columns: Columns, params: PcomParams) -> Longs:
    """Choose the ground voxels of one level by clustering the lowest ones.

    Parameters
    ----------
    columns : Columns
        The occupied columns of the level.
    params : PcomParams
        See there.

    Returns
    -------
    ndarray of int64, shape (m,)
        Highest layer that is ground: the one above the lowest voxel where that voxel is kept, its own where only the
        dilation took it in, the one below (none) where it is dropped.
    """
    lowest = columns.lowest
    order, terrain = _terrain(columns, lowest)
    large = _in_large_cluster(terrain, columns.edge, params)
    t, radius = terrain, NEIGHBOURS * columns.edge
    excess = round(params.interior * columns.edge)
    kept = large & ~above_neighbours(t.ix, t.iy, t.cx, t.cy, t.cz, large, _reach(radius, columns.edge), radius, excess)
    dilated = ~large & (touching(terrain.ix, terrain.iy, terrain.layer, kept) >= 3)
    tops = np.empty_like(lowest)
    tops[order] = terrain.layer - 1 + 2 * kept + dilated
    return tops


def _terrain(columns: Columns, lowest: Longs) -> tuple[npt.NDArray[np.intp], _Terrain]:
    """Return the columns' order by (column, row) index, and the centroids in that order, rounded to mm."""
    edge, start = columns.edge, columns.start
    ix, iy = columns.x[start] // edge, columns.y[start] // edge
    inside = columns.layer == np.repeat(lowest, columns.count)
    n = np.add.reduceat(inside, start, dtype=np.int64)
    centroid = []
    for values, corner in ((columns.x, ix * edge), (columns.y, iy * edge), (columns.z, lowest * edge)):
        total = np.add.reduceat(np.where(inside, values - np.repeat(corner, columns.count), 0), start)
        centroid.append(corner + (2 * total + n) // (2 * n))
    order = np.lexsort((iy, ix))
    return order, _Terrain(*(v[order] for v in (ix, iy, lowest, *centroid)))


def _in_large_cluster(terrain: _Terrain, edge: int, params: PcomParams) -> Bools:
    """Tell which centroids have a large enough cluster in a window; half the size will do for one at the outline."""
    smallest = params.smallest_cluster(edge)
    tolerance = round(params.tolerance * edge)
    t, reach = terrain, _reach(tolerance, edge)
    name = window_clusters(t.ix, t.iy, t.layer, t.cx, t.cy, reach, tolerance, params.half_window)
    size = np.bincount(name.ravel(), minlength=name.size)
    at_outline = np.zeros(name.size, np.bool_)
    at_outline[name[_outline(terrain.ix, terrain.iy)].ravel()] = True
    enough = (size >= smallest) | (at_outline & (2 * size >= smallest))
    large: Bools = enough[name].any(axis=1)
    return large


def _reach(distance: int, edge: int) -> int:
    """Return how many columns apart two centroids at most `distance` apart can lie."""
    return (distance - 1) // edge + 1


def _outline(ix: Longs, iy: Longs) -> Bools:
    """Tell which columns are the first or last occupied one along x or along y: the data's border."""
    out = np.zeros(len(ix), np.bool_)
    for line, along in ((ix, iy), (iy, ix)):
        order = np.lexsort((along, line))
        change = np.flatnonzero(np.diff(line[order]))
        out[order[np.concatenate(([0], change + 1, change, [len(ix) - 1]))]] = True
    return out


def classify(cloud: Cloud, params: Parameters) -> Verdict:
    """Classify with PCOM.

    Parameters
    ----------
    cloud : Cloud
        Points of a terrestrial scan.
    params : PcomParams
        Used as they are; the filter's `resolve` adapts the resolution to the density.

    Returns
    -------
    Verdict
        Points fixed as ground stay ground. Nothing is marked unproven: the filter does not prove its answers.

    Notes
    -----
    Source: J. Li, "Filtering terrestrial LiDAR point cloud in forest areas", summary of the thesis, ifp, University of
    Stuttgart; levels from 3D Forest (see `ppdf_dask.filters.voxel`). Each level: (1) the lowest voxel of each column
    and its centroid; (2) clusters by Euclidean distance within horizontal profiles; (3) small clusters are dropped, at
    the data's outline (first or last column of its row) those below half the size; (4) centroids high above their kept
    neighbours are dropped; (5) expansion: the points of the kept voxels and of those directly above, and of lowest
    voxels dropped in (3) that touch three kept ones. Known limits, the thesis's own: small terraces and narrow steps
    are lost; gaps and sparse points break clusters.

    Examples
    --------
    A stump of 0.3 m on flat ground: the columns under it hold no ground point.

    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = (v.ravel() * 0.02 + 0.01 for v in np.mgrid[0:150, 0:150])
    >>> stump = (abs(x - 1.5) < 0.2) & (abs(y - 1.5) < 0.2)
    >>> found = classify(cloud_from_xyz(np.column_stack([x, y, 0.3 * stump])), PcomParams()).ground
    >>> bool(found[~stump].all()), bool(found[stump].any())
    (True, False)
    """
    if not isinstance(params, PcomParams):
        raise ParameterError(f"PCOM takes PcomParams, not {type(params).__name__}")
    ground = coarse_to_fine(cloud, params.edge, lambda columns: ground_tops(columns, params))
    if cloud.fixed is not None:
        ground |= cloud.fixed
    return Verdict(ground[: cloud.n_core], np.zeros(cloud.n_core, np.bool_))


def required_buffer(params: Parameters) -> float:
    """Return the reach in metres beyond which the result does not change noticeably.

    Parameters
    ----------
    params : PcomParams
        The resolved parameters.

    Returns
    -------
    float
        Five coarse voxels and four times the edge of the smallest ground cluster as a square.

    Examples
    --------
    >>> required_buffer(PcomParams())
    6.5
    """
    if not isinstance(params, PcomParams):
        raise ParameterError(f"PCOM takes PcomParams, not {type(params).__name__}")
    coarse = COARSE * params.edge
    cluster: float = np.sqrt(params.smallest_cluster(coarse)) * coarse
    return float(5 * coarse + 4 * cluster) / MM


FILTER = Filter(
    name="pcom",
    profiles={
        "default": PcomParams(),
        "literal": PcomParams(half_window=0),
        "sparse": PcomParams(resolution=0.5),
    },
    classify=classify,
    required_buffer=required_buffer,
    exact=False,
    resolve=_voxel.resolve,
    bytes_per_point=250.0,
)
"""PCOM for the engine; ``literal`` clusters single layers, as the summary of the thesis says."""
