"""3D Forest's voxel filter ("terrain from octree"): the lowest voxels of each column, from coarse to fine.

For terrestrial scans: hundreds to thousands of points per square metre. The levels, their nesting and their comparison
stand here; `ppdf_dask.filters.pcom` plugs its own choice of ground voxels into the same frame.

The voxels are cubes anchored at absolute multiples of their edge, in integer millimetres. The three edges ``5 r``,
``r`` and ``r / 2`` nest, so that one sort of the points serves all three levels. Only occupied columns are held, never
a grid over the extent: a stray point far away costs one column.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import Filter
from ppdf_dask.filters.cloud import Bools, Cloud, Density, Verdict
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, Returns, quantity

Longs = npt.NDArray[np.int64]

COARSE = 5
"""Edge of a voxel of the coarse level, in resolutions; the fine level's is half a resolution."""

FINE_PER_COARSE = 2 * COARSE


@dataclass(frozen=True, kw_only=True)
class VoxelParams(Parameters):
    """Parameters of 3D Forest's voxel filter.

    Parameters
    ----------
    resolution : float
        Edge r of the middle level's voxels in metres, a multiple of 2 mm; the other levels use 5 r and r / 2. Default
        0.1 m, as in 3D Forest.
    points_per_column : float
        Points that a column of r x r must hold on average, else a run enlarges r, with a warning (see `resolve`).
        Default 16, a spacing of r / 4: the fine level then finds 4 points per column; with fewer it is full of holes. 0
        never enlarges.
    """

    RETURNS: ClassVar[Returns] = "all"

    resolution: float = quantity(0.1, "m", low=0.02, high=500.0, doc="edge of a voxel")
    points_per_column: float = quantity(16.0, "points", low=0.0, high=1e4, doc="below it the resolution is enlarged")

    def __post_init__(self) -> None:
        super().__post_init__()
        steps = self.resolution * MM
        if abs(steps - round(steps)) > 1e-6 or round(steps) % 2:
            raise ParameterError(
                f"resolution = {self.resolution} m is not a multiple of 0.002 m; half of it must be whole millimetres"
            )

    @property
    def edge(self) -> int:
        """The resolution in millimetres."""
        return round(self.resolution * MM)


@dataclass(frozen=True)
class Columns:
    """The occupied columns of one level with the points in them.

    Attributes
    ----------
    edge : int
        Edge of a voxel, mm.
    x, y, z : ndarray of int64, shape (n,)
        Points sorted by column, mm; x and y from a corner that is a voxel corner of every level, z absolute.
    layer : ndarray of int64, shape (n,)
        Layer of each point's voxel, counted from height zero.
    start : ndarray of int64, shape (m,)
        First point of each column.
    """

    edge: int
    x: Longs
    y: Longs
    z: Longs
    layer: Longs
    start: Longs

    @property
    def count(self) -> Longs:
        """Points of each column, shape (m,)."""
        return np.diff(self.start, append=len(self.x))

    @property
    def lowest(self) -> Longs:
        """Layer of each column's lowest voxel, shape (m,)."""
        return np.minimum.reduceat(self.layer, self.start)


Tops = Callable[[Columns], Longs]
"""Tells for each column the highest layer that counts as ground; below the lowest voxel's: none."""


def lowest_voxels(columns: Columns) -> Longs:
    """Take each column's lowest voxel and the voxel directly on it: 3D Forest's rule.

    Parameters
    ----------
    columns : Columns
        The columns of one level.

    Returns
    -------
    ndarray of int64, shape (m,)
        The layer above the lowest one.
    """
    return columns.lowest + 1


def coarse_to_fine(cloud: Cloud, edge: int, tops: Tops) -> Bools:
    """Find the ground by levels: ``5 r`` on all points, ``r / 2`` on what that kept, and what ``r`` on all keeps too.

    Parameters
    ----------
    cloud : Cloud
        Points; core and buffer are treated alike.
    edge : int
        The resolution r, mm, even.
    tops : callable
        ``tops(columns)``: the highest ground layer of each column of a level.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where ground. A coarse column with fewer than three points, or with all its points in one place, holds no
        surface and no ground.
    """
    ground = np.zeros(cloud.n, np.bool_)
    if cloud.n == 0:
        return ground
    key, x, y = _nested_key(cloud, edge)
    order = np.argsort(key)
    key, x, y, z = key[order], x[order], y[order], cloud.z[order].astype(np.int64)
    coarse = _columns(key // FINE_PER_COARSE**2, x, y, z, COARSE * edge)
    first = np.flatnonzero(_level(coarse, tops) & np.repeat(_surfaces(coarse), coarse.count))
    del coarse
    if len(first) == 0:
        return ground
    middle = _level(_columns(key // 4, x, y, z, edge), tops)
    fine = _level(_columns(key[first], x[first], y[first], z[first], edge // 2), tops)
    ground[order[first[fine & middle[first]]]] = True
    return ground


def _nested_key(cloud: Cloud, edge: int) -> tuple[Longs, Longs, Longs]:
    """Return a number per fine column, those of a coarse or middle one in sequence, and x, y from a corner."""
    fine, coarse = edge // 2, COARSE * edge
    x, y = (_from_corner(v, o, coarse) for v, o in zip((cloud.x, cloud.y), cloud.origin, strict=True))
    i, j = x // coarse, y // coarse
    key: Longs = i * (int(j.max()) + 1) + j
    i, j = x % coarse // fine, y % coarse // fine
    key = (key * COARSE + i // 2) * COARSE + j // 2
    key = (key * 2 + i % 2) * 2 + j % 2
    return key, x, y


def _from_corner(values: npt.NDArray[np.int32], origin: int, coarse: int) -> Longs:
    corner = (origin + int(values.min())) // coarse * coarse
    return values.astype(np.int64) + (origin - corner)


def _columns(key: Longs, x: Longs, y: Longs, z: Longs, edge: int) -> Columns:
    start = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
    return Columns(edge, x, y, z, z // edge, start)


def _level(columns: Columns, tops: Tops) -> Bools:
    """Tell for each point of a level whether its voxel counts as ground."""
    return columns.layer <= np.repeat(tops(columns), columns.count)


def _surfaces(columns: Columns) -> Bools:
    """Tell for each column whether it holds three points or more that are not all in one place."""
    spread = np.zeros(len(columns.start), np.bool_)
    for values in (columns.x, columns.y, columns.z):
        spread |= np.maximum.reduceat(values, columns.start) > np.minimum.reduceat(values, columns.start)
    return spread & (columns.count >= 3)


def incomplete_columns(cloud: Cloud, edge: int) -> Bools:
    """Tell for each core point whether its coarse column reaches beyond the known area.

    Parameters
    ----------
    cloud : Cloud
        Points and what is known of their surroundings.
    edge : int
        The resolution r, mm.

    Returns
    -------
    ndarray of bool, shape (n_core,)
        True where points of the same column may be missing.
    """
    out = np.zeros(cloud.n_core, np.bool_)
    if cloud.known is None:
        return out
    size, known = COARSE * edge, cloud.known
    limits = ((known.x0, known.x1), (known.y0, known.y1))
    for values, origin, (low, high) in zip((cloud.x, cloud.y), cloud.origin, limits, strict=True):
        corner = (values[: cloud.n_core].astype(np.int64) + origin) // size * size
        out |= (corner < low) | (corner + size > high)
    return out


def resolve(params: Parameters, density: Density) -> VoxelParams:
    """Enlarge the resolution where the points are too sparse for it.

    With d points per square metre a column of r x r holds ``d r^2`` points on average; where that is below
    `points_per_column`, r becomes ``sqrt(points_per_column / d)``, rounded up to a multiple of 1 cm. d is counted over
    occupied 5 m cells, so it is low for a cloud of few cells, most of them cut by its border.

    Parameters
    ----------
    params : VoxelParams
        As asked for.
    density : Density
        Of the whole job, so that every chunk gets the same resolution.

    Returns
    -------
    VoxelParams
        With the resolution to use; `points_per_column` is kept.

    Warns
    -----
    UserWarning
        When the resolution is enlarged; the message holds both numbers.

    Examples
    --------
    >>> resolve(VoxelParams(), Density(points=2000 * 25, cells=1)).resolution
    0.1
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     print(resolve(VoxelParams(), Density(points=100 * 25, cells=1)).resolution, len(caught))
    0.4 1
    """
    if not isinstance(params, VoxelParams):
        raise ParameterError(f"a voxel filter takes VoxelParams, not {type(params).__name__}")
    if density.points == 0 or params.points_per_column <= density.per_m2 * params.resolution**2:
        return params
    wanted = math.sqrt(params.points_per_column / density.per_m2)
    edge = 10 * math.ceil(round(wanted * MM, 6) / 10)
    warnings.warn(
        f"resolution = {params.resolution} m is too fine for {density.per_m2:.4g} points/m2 (spacing "
        f"{1 / math.sqrt(density.per_m2):.3g} m): a column would hold {density.per_m2 * params.resolution**2:.3g} "
        f"points instead of {params.points_per_column:g}; enlarged to {edge / MM} m. Set resolution={edge / MM} to "
        "silence this, or points_per_column=0 to keep the finer one",
        UserWarning,
        stacklevel=2,
    )
    return params.replace(resolution=edge / MM)


def classify(cloud: Cloud, params: Parameters) -> Verdict:
    """Classify with 3D Forest's "terrain from octree".

    Parameters
    ----------
    cloud : Cloud
        Points of a terrestrial scan.
    params : VoxelParams
        Used as they are; `resolve` adapts them to the density.

    Returns
    -------
    Verdict
        A point's answer depends on its coarse column (5 r) alone: unproven where that column is not wholly known.
        Points fixed as ground stay ground.

    Notes
    -----
    Source: 3D Forest (Trochta 2016; VUKOZ), `terrain.cpp`: a voxel is low if it is the lowest of its column or the
    second and touches the lowest. The voxels are anchored at absolute zero instead of at the first point, and the
    levels are compared by the points themselves instead of by distance.

    Examples
    --------
    A slope of 0.4 m under a branch:

    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = (v.ravel() * 0.01 for v in np.mgrid[0:40, 0:40])
    >>> ground = np.column_stack([x, y, 0.1 * x])
    >>> branch = np.column_stack([x[:40], y[:40], 2 + x[:40]])
    >>> found = classify(cloud_from_xyz(np.vstack([ground, branch])), VoxelParams()).ground
    >>> bool(found[:1600].all()), bool(found[1600:].any())
    (True, False)
    """
    if not isinstance(params, VoxelParams):
        raise ParameterError(f"the voxel filter takes VoxelParams, not {type(params).__name__}")
    ground = coarse_to_fine(cloud, params.edge, lowest_voxels)
    if cloud.fixed is not None:
        ground |= cloud.fixed
    return Verdict(ground[: cloud.n_core], incomplete_columns(cloud, params.edge))


def required_buffer(params: Parameters) -> float:
    """Return the edge of a coarse voxel in metres: a column that meets the core lies within it.

    Parameters
    ----------
    params : VoxelParams
        The resolved parameters.

    Returns
    -------
    float
        Five resolutions.

    Examples
    --------
    >>> required_buffer(VoxelParams())
    0.5
    """
    if not isinstance(params, VoxelParams):
        raise ParameterError(f"the voxel filter takes VoxelParams, not {type(params).__name__}")
    return COARSE * params.edge / MM


FILTER = Filter(
    name="voxel",
    profiles={"default": VoxelParams(), "sparse": VoxelParams(resolution=0.5)},
    classify=classify,
    required_buffer=required_buffer,
    exact=True,
    resolve=resolve,
    bytes_per_point=120.0,
)
"""3D Forest's voxel filter for the engine. Exact: a coarse column decides alone, so no seam can show."""
