"""PTDF: progressive TIN densification.

Axelsson, "DEM generation from laser scanner data using adaptive TIN models", ISPRS Archives 33 (B4), 2000, 110-117, as
in the commercial program that the PPDF paper used. The triangulation is exact and unique, so that neither the order of
the points nor rounding decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ppdf_dask._delaunay import MAX_SPAN, Triangulation
from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import Filter
from ppdf_dask.filters import _ptdf_kernels as kernels
from ppdf_dask.filters.cloud import Bools, Cloud, Density, Ints, Verdict
from ppdf_dask.filters.islands import by_island
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity

Longs = npt.NDArray[np.int64]

MIRROR = {"off": kernels.OFF, "steep": kernels.STEEP, "failed": kernels.FAILED}


@dataclass(frozen=True, kw_only=True)
class PtdfParams(Parameters):
    """Parameters of progressive TIN densification.

    Parameters
    ----------
    window : float
        Edge of the cells whose lowest points are the seeds: larger than the largest building.
    terrain_angle : float
        Steepest terrain; points in steeper facets are mirrored (see `mirror`).
    iteration_angle : float
        Largest angle between the facet and the line from the point to its nearest corner.
    iteration_distance : float
        Largest perpendicular distance between point and facet.
    spacing : float
        Only the lowest point of each cell of this size may join the TIN, and no facet with shorter edges is divided.
    tolerance : float
        Points closer to the finished TIN than this are ground whatever their angle; 0 leaves the judgement to the
        angle, which is merciless where the TIN is as dense as its noise.
    mirror : {"steep", "failed", "off"}
        Which points are judged by their mirror image about the facet's highest corner, as at the edge of a cliff: those
        in facets steeper than `terrain_angle`, those that fail, none.
    foot_inside : bool
        The perpendicular from the point must meet the facet itself, not only its plane: keeps walls from being climbed.
    label : {"surface", "vertices"}
        Ground is what passes the test of the finished TIN, or its vertices only.
    """

    window: float = quantity(20.0, "m", low=0.1, high=1000.0, doc="cells whose lowest points are the seeds")
    terrain_angle: float = quantity(88.0, "degrees", low=1.0, high=89.9, doc="steepest terrain")
    iteration_angle: float = quantity(20.0, "degrees", low=0.1, high=89.9, doc="largest angle to the facet")
    iteration_distance: float = quantity(1.5, "m", low=0.01, high=100.0, doc="largest distance to the facet")
    spacing: float = quantity(0.25, "m", low=0.001, high=100.0, doc="spacing of the TIN's points")
    tolerance: float = quantity(0.15, "m", low=0.0, high=100.0, doc="distance that is ground at any angle")
    mirror: Literal["steep", "failed", "off"] = "steep"
    foot_inside: bool = False
    label: Literal["surface", "vertices"] = "surface"


PAPER = PtdfParams(window=10.0, iteration_angle=15.0, iteration_distance=1.5, tolerance=0.0)
"""Table 2 of the PPDF paper."""

LASR = PtdfParams(
    window=10.0,
    iteration_angle=30.0,
    iteration_distance=2.0,
    tolerance=0.0,
    mirror="off",
    foot_inside=True,
    label="vertices",
)
"""The defaults and rules of lasR's filter, for comparisons. It adds points in the order of their height rather than the
best of each facet, and removes spikes at the end."""


def classify(cloud: Cloud, params: Parameters) -> Verdict:
    """Classify a cloud with progressive TIN densification.

    Parameters
    ----------
    cloud : Cloud
        Eligible points; all of them may join the TIN, the core points are classified.
    params : PtdfParams
        The parameters.

    Returns
    -------
    Verdict
        Ground as `PtdfParams.label` says; unproven is all False, PTDF does not prove its answers.

    Raises
    ------
    ParameterError
        When the cloud is wider than the 134 km over which the triangulation is exact.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = np.meshgrid(np.arange(0, 40, 0.7), np.arange(0, 40, 0.7))
    >>> terrain = np.column_stack([x.ravel(), y.ravel(), 0.1 * x.ravel()])
    >>> ground = classify(cloud_from_xyz([*terrain, [20.1, 20.1, 5.0]]), PtdfParams()).ground
    >>> bool(ground[:-1].all()), bool(ground[-1])
    (True, False)
    """
    assert isinstance(params, PtdfParams)
    return by_island(cloud, required_buffer(params), lambda island: _label(island, params))


def required_buffer(params: Parameters) -> float:
    """Return five windows, metres: so cut into 250 m chunks, 3 of the 221 131 points of a sparse tile changed."""
    assert isinstance(params, PtdfParams)
    return 5.0 * params.window


def _label(cloud: Cloud, params: PtdfParams) -> Bools:
    window, spacing = (max(1, round(v * MM)) for v in (params.window, params.spacing))
    points, ring, half = _centred(cloud, window)
    seeds = points[_lowest(points, *_sorted(cloud, window))]
    key, order = _sorted(cloud, spacing)
    candidates = points[_lowest(points, key, order)]
    tin = Triangulation(half)
    tin.insert(np.vstack([seeds, _border(ring, seeds)]))
    count = len(tin.vertices)
    room = count + len(candidates)
    vertices, triangles = np.empty((room, 3), np.int32), np.empty((2 * room - 6, 6), np.int32)
    vertices[:count], triangles[: 2 * count - 6] = tin.vertices, tin.triangles
    # Rounded, since the sine of two C libraries may differ in its last digit.
    sine, slope = math.sin(math.radians(params.iteration_angle)), math.tan(math.radians(params.terrain_angle))
    limits = (
        (params.iteration_distance * MM) ** 2,
        round(sine**2, 12),
        round(slope**2, 9),
        float(half),
        float(params.foot_inside),
    )
    mirror = MIRROR[params.mirror]
    kernels.densify(vertices, triangles, count, candidates, limits, float(spacing) ** 2, mirror)
    ground = np.empty(cloud.n_core, np.bool_)
    of_core = order[order < cloud.n_core]
    near2 = (params.tolerance * MM) ** 2
    kernels.label(vertices, triangles, points, of_core, limits, mirror, near2, params.label == "vertices", ground)
    return ground


def _centred(cloud: Cloud, window: int) -> tuple[Ints, Ints, int]:
    """Points about a centre, the border's places, and half the edge of a square around all.

    The border runs along absolute windows, one beyond those that hold points, with a place every window.
    """
    middle, sides = [], []
    for values, origin in zip((cloud.x, cloud.y), cloud.origin, strict=True):
        first = ((int(values.min()) + origin) // window - 1) * window - origin
        end = ((int(values.max()) + origin) // window + 2) * window - origin
        middle.append((first + end) // 2)
        sides.append(np.arange(first - middle[-1], end - middle[-1] + 1, window, dtype=np.int64))
    half = max(int(np.abs(side).max()) for side in sides) + window
    if 2 * half + 1 > MAX_SPAN:
        raise ParameterError(
            f"the cloud with its border is {2 * half / MM:.0f} m wide, more than the {MAX_SPAN / MM:.0f} m over which "
            "the triangulation is exact; use smaller chunks (--chunk-size) or a smaller window"
        )
    points = np.empty((cloud.n, 3), np.int32)
    for axis, values in enumerate((cloud.x, cloud.y)):
        np.subtract(values, middle[axis], out=points[:, axis], casting="unsafe")
    points[:, 2] = cloud.z
    (along, up) = sides
    ring = [(a, b) for b in (up[0], up[-1]) for a in along] + [(a, b) for a in (along[0], along[-1]) for b in up[1:-1]]
    return points, np.array(ring, np.int32), half


def _sorted(cloud: Cloud, step: int) -> tuple[Longs, Longs]:
    """Return the number of each point's absolute cell of `step` mm, row by row, and the order of the points by it."""
    column, row = (
        (v + np.int64(o)) // step - (int(v.min()) + o) // step
        for v, o in zip((cloud.x, cloud.y), cloud.origin, strict=True)
    )
    key = row * (int(column.max()) + 1) + column
    return key, np.argsort(key, kind="stable")


def _lowest(points: Ints, key: Longs, order: Longs) -> Longs:
    x, y, z = points.T
    return np.asarray(kernels.lowest_of_runs(key, order, x, y, z))


def _border(ring: Ints, seeds: Ints) -> Ints:
    """Give the border's places the height of their nearest seed by (squared distance, z, x, y)."""
    near = cKDTree(seeds[:, :2]).query(ring, k=list(range(1, min(8, len(seeds)) + 1)))[1]
    x, y, z = (seeds[near, axis].astype(np.int64) for axis in range(3))
    d2 = (x - ring[:, :1]) ** 2 + (y - ring[:, 1:]) ** 2
    first = np.lexsort((y, x, z, d2), axis=1)[:, 0]
    return np.column_stack([ring, z[np.arange(len(ring)), first]]).astype(np.int32)


def _keep(params: Parameters, _: Density) -> Parameters:
    return params


FILTER = Filter(
    name="ptdf",
    profiles={"default": PtdfParams(), "paper": PAPER, "lasr": LASR},
    classify=classify,
    required_buffer=required_buffer,
    exact=False,
    resolve=_keep,
    bytes_per_point=220.0,
)
