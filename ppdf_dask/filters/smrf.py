"""SMRF: the simple morphological filter, today's usual reference.

Pingel, Clarke and McBride, "An improved simple morphological filter for the terrain classification of airborne LIDAR
data", ISPRS Journal 77 (2013), 21-30. Where the paper leaves a choice, the choice is the one of the widespread open
implementation, so that figures can be compared: empty cells take the mean of their eight nearest, the window is a
diamond, and a point is compared with its own cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters import Filter
from ppdf_dask.filters.cloud import Bools, Cloud, Density, Verdict
from ppdf_dask.filters.islands import by_island
from ppdf_dask.filters.raster import EMPTY, Heights, dilated, eroded, filled, lowest, rasterize
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity

LOW_SLOPE = 5.0
"""Slope (500 %) of the inverted surface beyond which a cell is a low outlier; the paper's constant (section 2.2)."""

NEIGHBOURS = 8
"""Cells whose mean fills an empty one."""


@dataclass(frozen=True, kw_only=True)
class SmrfParams(Parameters):
    """Parameters of SMRF; the defaults are the paper's single set for all samples.

    Parameters
    ----------
    cell : float
        Edge of a raster cell.
    slope : float
        Steepest terrain as rise over run.
    window : float
        Radius of the largest opening: about half the width of the largest building.
    threshold : float
        Height above or below the provisional terrain within which a point is ground on flat land.
    scalar : float
        What one unit of terrain slope (rise over run) adds to the threshold, metres.
    """

    cell: float = quantity(1.0, "m", low=0.05, high=100.0, doc="edge of a raster cell")
    slope: float = quantity(0.15, "1", low=0.0, high=10.0, doc="steepest terrain, rise over run")
    window: float = quantity(18.0, "m", low=0.05, high=500.0, doc="radius of the largest opening")
    threshold: float = quantity(0.5, "m", low=0.0, high=100.0, doc="height tolerance on flat land")
    scalar: float = quantity(1.25, "m", low=0.0, high=100.0, doc="tolerance added per unit of slope")


def classify(cloud: Cloud, params: Parameters) -> Verdict:
    """Classify a cloud with SMRF.

    Parameters
    ----------
    cloud : Cloud
        Eligible points; all of them shape the terrain, the core points are classified.
    params : SmrfParams
        The parameters.

    Returns
    -------
    Verdict
        Ground where ``|z - terrain| <= threshold + scalar * slope`` in the point's cell; unproven is all False, SMRF
        does not prove its answers.

    Raises
    ------
    ParameterError
        When the raster would exceed its limit.

    Examples
    --------
    >>> import numpy as np
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = np.meshgrid(np.arange(0.5, 30), np.arange(0.5, 30))
    >>> roof = (abs(x - 15) < 5) & (abs(y - 15) < 5)
    >>> cloud = cloud_from_xyz(np.column_stack([x.ravel(), y.ravel(), np.where(roof, 6.0, 0.0).ravel()]))
    >>> bool((classify(cloud, SmrfParams()).ground == ~roof.ravel()).all())
    True
    """
    assert isinstance(params, SmrfParams)
    return by_island(cloud, required_buffer(params), lambda island: _label(island, params))


def required_buffer(params: Parameters) -> float:
    """Return the reach of the largest opening, there and back, and of the cells that fill a gap, metres."""
    assert isinstance(params, SmrfParams)
    return 2.0 * params.window + 10.0 * params.cell


def _label(cloud: Cloud, params: SmrfParams) -> Bools:
    raster = rasterize(cloud, params.cell)
    low = lowest(raster, cloud.z)
    surface = filled(np.where(low == EMPTY, np.nan, low), NEIGHBOURS)
    radius = math.ceil(params.window / params.cell)
    objects = _progressive(-surface, 1, LOW_SLOPE * raster.step)
    objects |= _progressive(surface, radius, params.slope * raster.step)
    terrain = surface if objects.all() else filled(np.where(objects, np.nan, surface), NEIGHBOURS)
    tolerance = params.threshold * MM + params.scalar * MM * _slope(terrain, raster.step)
    core = raster.cell[: cloud.n_core]
    away = np.abs(cloud.z[: cloud.n_core] - terrain.ravel()[core])
    return np.asarray(away <= tolerance.ravel()[core])


def _progressive(surface: Heights, radius: int, rise: float) -> npt.NDArray[np.bool_]:
    """Mark the cells that an opening of any radius up to `radius` cells cuts down by more than ``rise * radius``."""
    marked = np.zeros(surface.shape, np.bool_)
    previous = erosion = surface
    for r in range(1, radius + 1):
        erosion = eroded(erosion, 1)
        opened = dilated(erosion, r)
        marked |= np.abs(previous - opened) > rise * r
        previous = opened
    return marked


def _slope(terrain: Heights, step: int) -> Heights:
    """Rise over run of a raster by central differences, one-sided at its edge."""
    square = np.zeros(terrain.shape)
    for axis in range(2):
        if terrain.shape[axis] > 1:
            square += (np.gradient(terrain, axis=axis) / step) ** 2
    return np.sqrt(square)


def _keep(params: Parameters, _: Density) -> Parameters:
    return params


FILTER = Filter(
    name="smrf",
    profiles={"default": SmrfParams()},
    classify=classify,
    required_buffer=required_buffer,
    exact=False,
    resolve=_keep,
    bytes_per_point=300.0,
)
