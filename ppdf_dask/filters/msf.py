"""MSF: the maximum slope filter, as defined and with growth from seeds.

Vosselman, "Slope based filtering of laser altimetry data", ISPRS Archives 33 (B3), 2000, 935-942: a point is ground
when no neighbour lies lower than a slope allows. On terrain steeper than that slope the definition rejects every point,
since each has a lower neighbour downhill; what the PPDF paper ran cannot have been that. ``variant="seeded"`` follows
its words instead: seeds, then points judged by their nearest ground point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import minimum_filter

from ppdf_dask.filters import Filter
from ppdf_dask.filters import _msf_kernels as kernels
from ppdf_dask.filters.cloud import Bools, Cloud, Density, Ints, Verdict
from ppdf_dask.filters.islands import by_island
from ppdf_dask.filters.raster import Raster, rasterize
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity

POINTS_PER_BUCKET = 3
"""Points that a bucket of the search for the nearest ground point holds on average."""


@dataclass(frozen=True, kw_only=True)
class MsfParams(Parameters):
    """Parameters of the maximum slope filter; ``paper`` is the strict rule with Table 2 of the PPDF paper.

    Parameters
    ----------
    cell : float
        Edge of the cells whose lowest points are the neighbours.
    window : float
        Strict: full width of the neighbourhood, a disc of half of it. Seeded: width of the windows whose lowest points
        are the seeds.
    slope : float
        Steepest terrain.
    max_height : float
        Largest height difference, however far the neighbour.
    tolerance : float
        Height difference allowed at no distance; without it one point per cell could be ground. Strict: against the
        lowest point of the point's own cell. Seeded: added to what the slope allows.
    variant : {"seeded", "strict"}
        Growth from seeds, or Vosselman's definition.
    """

    cell: float = quantity(1.0, "m", low=0.05, high=100.0, doc="cells whose lowest points are the neighbours")
    window: float = quantity(20.0, "m", low=0.1, high=1000.0, doc="neighbourhood, or windows of the seeds")
    slope: float = quantity(20.0, "degrees", low=0.0, high=89.0, doc="steepest terrain")
    max_height: float = quantity(3.0, "m", low=0.0, high=1000.0, doc="largest height difference")
    tolerance: float = quantity(0.3, "m", low=0.0, high=100.0, doc="height difference at no distance")
    variant: Literal["seeded", "strict"] = "seeded"


PAPER = MsfParams(window=10.0, slope=15.0, variant="strict")
"""Table 2 of the PPDF paper under Vosselman's definition."""

PAPER_SEEDED = PAPER.replace(variant="seeded")
"""Table 2 of the PPDF paper with growth from seeds, which its text describes."""


def classify(cloud: Cloud, params: Parameters) -> Verdict:
    """Classify a cloud with the maximum slope filter.

    Parameters
    ----------
    cloud : Cloud
        Eligible points; all of them are neighbours, the core points are classified.
    params : MsfParams
        The parameters.

    Returns
    -------
    Verdict
        Strict: ground where ``z - z_j <= min(tan(slope) * d_j, max_height)`` for the lowest point j of each other cell
        within half a window and ``z - z_own <= tolerance`` in the own cell. Seeded: ground where ``z - z_g <=
        min(tolerance + tan(slope) * d_g, max_height)`` for the nearest ground point g, in passes until none is added.
        Unproven is all False, MSF does not prove its answers.

    Raises
    ------
    ParameterError
        When the raster would exceed its limit.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = np.meshgrid(np.arange(0.5, 30), np.arange(0.5, 30))
    >>> tree = (abs(x - 15) < 3) & (abs(y - 15) < 3)
    >>> cloud = cloud_from_xyz(np.column_stack([x.ravel(), y.ravel(), np.where(tree, 6.0, 0.0).ravel()]))
    >>> bool((classify(cloud, MsfParams()).ground == ~tree.ravel()).all())
    True
    """
    assert isinstance(params, MsfParams)
    label = _strict if params.variant == "strict" else _seeded
    return by_island(cloud, required_buffer(params), lambda island: label(island, params))


def required_buffer(params: Parameters) -> float:
    """Return the reach, metres: exact for the strict rule, five windows for growth, which has no limit."""
    assert isinstance(params, MsfParams)
    return params.window / 2 + 2 * params.cell if params.variant == "strict" else 5.0 * params.window


def _rise(params: MsfParams) -> float:
    # Rounded, since the tangent of two C libraries may differ in its last digit.
    return round(math.tan(math.radians(params.slope)), 12)


def _strict(cloud: Cloud, params: MsfParams) -> Bools:
    raster, lowest = _lowest_points(cloud, params.cell)
    ground = np.empty(cloud.n_core, np.bool_)
    columns = raster.shape[1]
    limits = (params.window / 2 * MM, _rise(params), params.max_height * MM, params.tolerance * MM)
    kernels.strict(cloud.x, cloud.y, cloud.z, raster.cell, lowest, columns, raster.step, limits, ground)
    return ground


def _seeded(cloud: Cloud, params: MsfParams) -> Bools:
    raster, lowest = _lowest_points(cloud, params.cell)
    ground = np.zeros(cloud.n, np.bool_)
    ground[_seeds(cloud, raster, lowest, max(1, round(params.window / params.cell)))] = True
    # The size of the buckets changes the speed of the search only.
    buckets = rasterize(cloud, max(0.05, params.cell * math.sqrt(POINTS_PER_BUCKET * (lowest >= 0).sum() / cloud.n)))
    order = np.argsort(buckets.cell, kind="stable")
    starts = np.searchsorted(buckets.cell[order], np.arange(buckets.shape[0] * buckets.shape[1] + 1))
    limits = (_rise(params), params.max_height * MM, params.tolerance * MM)
    points = cloud.x[order], cloud.y[order], cloud.z[order]
    grown = ground[order]
    kernels.grow(*points, starts, buckets.shape[1], buckets.step, _offset(cloud, buckets), limits, grown)
    ground[order] = grown
    return ground[: cloud.n_core]


def _offset(cloud: Cloud, raster: Raster) -> tuple[int, int]:
    """Return what to add to x and y so that the raster's corner is zero, mm."""
    return cloud.origin[0] - raster.column * raster.step, cloud.origin[1] - raster.row * raster.step


def _lowest_points(cloud: Cloud, size: float) -> tuple[Raster, Ints]:
    """Return the cells and each cell's lowest point by (z, x, y), -1 where it is empty."""
    raster = rasterize(cloud, size)
    lowest = np.full(raster.shape[0] * raster.shape[1], -1, np.int32)
    kernels.lowest_points(cloud.x, cloud.y, cloud.z, raster.cell, lowest)
    return raster, lowest


def _seeds(cloud: Cloud, raster: Raster, lowest: Ints, width: int) -> npt.NDArray[np.int64]:
    """Find the lowest points of all windows of `width` x `width` cells inside the raster, cut to its size if wider."""
    full = np.flatnonzero(lowest >= 0)
    found = lowest[full]
    order = np.lexsort((cloud.y[found], cloud.x[found], cloud.z[found]))
    rank = np.full(lowest.shape, len(full), np.int64)
    rank[full[order]] = np.arange(len(full))
    rows, columns = raster.shape
    size = min(width, rows), min(width, columns)
    least = minimum_filter(rank.reshape(raster.shape), size=size, mode="nearest")
    inside = tuple(slice(w // 2, w // 2 + n - w + 1) for w, n in zip(size, raster.shape, strict=True))
    ranks = np.unique(least[inside])
    return np.asarray(found[order[ranks[ranks < len(full)]]], np.int64)


def _keep(params: Parameters, _: Density) -> Parameters:
    return params


FILTER = Filter(
    name="msf",
    profiles={"default": MsfParams(), "paper": PAPER, "paper-seeded": PAPER_SEEDED},
    classify=classify,
    required_buffer=required_buffer,
    exact=False,
    resolve=_keep,
    bytes_per_point=160.0,
)
