"""PMF: the progressive morphological filter.

Zhang, Chen, Whitman, Shyu, Yan and Zhang, "A progressive morphological filter for removing nonground measurements from
airborne LIDAR data", IEEE TGRS 41 (2003), 872-882, on a raster of lowest points as in the paper's section III, or on
the points themselves as in the PCL, which the PPDF paper used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import grey_opening

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import Filter
from ppdf_dask.filters._pmf_points import below
from ppdf_dask.filters.cloud import Bools, Cloud, Density, Verdict
from ppdf_dask.filters.islands import by_island
from ppdf_dask.filters.raster import EMPTY, Heights, dilated, eroded, filled, lowest, rasterize
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity


@dataclass(frozen=True, kw_only=True)
class PmfParams(Parameters):
    """Parameters of the progressive morphological filter.

    Four profiles: the defaults are the tolerances of Table 2 of the PPDF paper with windows up to 33 m, so that houses
    are opened as well as trees; ``paper`` is Table 2 itself on a raster, ``paper-points`` on the points; ``pdal`` the
    defaults of that software, for comparisons.

    Parameters
    ----------
    cell : float
        Edge of a raster cell.
    window : float
        Windows grow as 3, 5, 9, 17, 33, ... cells until one reaches this width; that one is the last.
    slope : float
        Slope of the terrain: a wider window may cut this much more, times its growth in width.
    initial_height, max_height : float
        Height above the opened surface from which a point is an object: in the first window, and at most.
    shape : {"diamond", "square"}
        Shape of the windows.
    on : {"raster", "points"}
        Raster: the surface is opened, empty cells filled. Points: for every point that is left, the lowest in the
        square around it, then the highest of these in the square; squares only, nothing is filled.
    """

    cell: float = quantity(1.0, "m", low=0.05, high=100.0, doc="edge of a raster cell")
    window: float = quantity(33.0, "m", low=0.05, high=1000.0, doc="width of the largest window")
    slope: float = quantity(15.0, "degrees", low=0.0, high=89.0, doc="slope of the terrain")
    initial_height: float = quantity(0.5, "m", low=0.0, high=100.0, doc="height tolerance of the first window")
    max_height: float = quantity(3.0, "m", low=0.0, high=1000.0, doc="largest height tolerance")
    shape: Literal["diamond", "square"] = "diamond"
    on: Literal["raster", "points"] = "raster"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.on == "points" and self.shape != "square":
            raise ParameterError(f"on = 'points' knows squares only; set shape = 'square' instead of {self.shape!r}")


PAPER = PmfParams(window=10.0, slope=15.0, initial_height=0.5, max_height=3.0, shape="square")
"""Table 2 of the PPDF paper, which used square windows; 10 m means the windows 3, 5, 9 and 17."""

PAPER_POINTS = PAPER.replace(on="points")
"""Table 2 of the PPDF paper with the program that it used: no raster."""

PDAL = PmfParams(window=33.0, slope=45.0, initial_height=0.15, max_height=2.5)
"""The defaults of PDAL's filter: a first tolerance so tight that rough ground is lost, a slope that hardly limits."""


def windows(params: PmfParams) -> list[tuple[int, float]]:
    """Return each window's half width in cells and its height tolerance in metres (the paper's equations 3 and 7).

    Examples
    --------
    >>> [(r, round(h, 2)) for r, h in windows(PAPER)]
    [(1, 0.5), (2, 1.04), (4, 1.57), (8, 2.64)]
    >>> [r for r, _ in windows(PmfParams())]
    [1, 2, 4, 8, 16]
    """
    # Rounded, since the tangent of two C libraries may differ in its last digit.
    rise = round(math.tan(math.radians(params.slope)), 12)
    out: list[tuple[int, float]] = []
    width = 0.0
    while width < params.window:
        radius = 2 ** len(out)
        grown, width = width, params.cell * (2 * radius + 1)
        height = params.initial_height + (rise * (width - grown) if out else 0.0)
        out.append((radius, min(height, params.max_height)))
    return out


def classify(cloud: Cloud, params: Parameters) -> Verdict:
    """Classify a cloud with the progressive morphological filter.

    Parameters
    ----------
    cloud : Cloud
        Eligible points; all of them shape the terrain, the core points are classified.
    params : PmfParams
        The parameters.

    Returns
    -------
    Verdict
        Ground where the point is less than each window's tolerance above the surface opened so far; unproven is all
        False, PMF does not prove its answers.

    Raises
    ------
    ParameterError
        When the raster would exceed its limit.

    Examples
    --------
    >>> import numpy as np
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = np.meshgrid(np.arange(0.5, 30), np.arange(0.5, 30))
    >>> tree = (abs(x - 15) < 3) & (abs(y - 15) < 3)
    >>> cloud = cloud_from_xyz(np.column_stack([x.ravel(), y.ravel(), np.where(tree, 6.0, 0.0).ravel()]))
    >>> bool((classify(cloud, PAPER).ground == ~tree.ravel()).all())
    True
    """
    assert isinstance(params, PmfParams)
    return by_island(cloud, required_buffer(params), lambda island: _label(island, params))


def required_buffer(params: Parameters) -> float:
    """Return how far the chain of openings can reach (the sum of the windows), and ten cells, metres."""
    assert isinstance(params, PmfParams)
    return sum((2 * radius + 1) * params.cell for radius, _ in windows(params)) + 10.0 * params.cell


def _label(cloud: Cloud, params: PmfParams) -> Bools:
    if params.on == "points":
        return below(cloud, params.cell, [(radius, height * MM) for radius, height in windows(params)])
    raster = rasterize(cloud, params.cell)
    low = lowest(raster, cloud.z)
    surface = filled(np.where(low == EMPTY, np.nan, low), 1)
    # A point passes every window when it lies below the lowest of the surfaces, each raised by its tolerance.
    ceiling = np.full(surface.shape, np.inf)
    for radius, height in windows(params):
        surface = _opened(surface, radius, params.shape)
        np.minimum(ceiling, surface + height * MM, out=ceiling)
    core = raster.cell[: cloud.n_core]
    return np.asarray(cloud.z[: cloud.n_core] < ceiling.ravel()[core])


def _opened(surface: Heights, radius: int, shape: str) -> Heights:
    if shape == "square":
        # "nearest" repeats the edge, which no erosion or dilation over a symmetric window can tell from clipping.
        return np.asarray(grey_opening(surface, size=(2 * radius + 1, 2 * radius + 1), mode="nearest"))
    return dilated(eroded(surface, radius), radius)


def _keep(params: Parameters, _: Density) -> Parameters:
    return params


FILTER = Filter(
    name="pmf",
    profiles={"default": PmfParams(), "paper": PAPER, "paper-points": PAPER_POINTS, "pdal": PDAL},
    classify=classify,
    required_buffer=required_buffer,
    exact=False,
    resolve=_keep,
    bytes_per_point=260.0,
)
