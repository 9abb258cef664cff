"""PPDF as published, from points to verdict."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Bools, Cloud, Ints, Verdict
from ppdf_dask.filters.ppdf.paper.canopy import under_canopy
from ppdf_dask.filters.ppdf.paper.growth import GROUND, MOST_PASSES, UNPROVEN, grow
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.filters.ppdf.paper.planes import Planes, lowest_seeds, plane_seeds
from ppdf_dask.filters.ppdf.paper.squares import Squares, cut_by_edge, sort_by_square
from ppdf_dask.grid import MM, Rect

States = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Stages:
    """What each step found, for all points of the cloud (buffer included) in their own order.

    Attributes
    ----------
    under_canopy : ndarray of bool, shape (n,)
        Points that planes were sought in; all of them with ``seeds="local_minimum"``, which needs no such step.
    planes : Planes
        The accepted planes; none with ``seeds="local_minimum"``.
    seeds, ground : ndarray of bool, shape (n,)
        Ground before and after growth.
    unproven : ndarray of bool, shape (n,)
        True where `ground` could change with a wider known area.
    passes : int
        Growth passes, the last idle one counted; -1 when they were stopped.
    """

    under_canopy: Bools
    planes: Planes
    seeds: Bools
    ground: Bools
    unproven: Bools
    passes: int


def classify(cloud: Cloud, params: PaperParams) -> Verdict:
    """Tell which core points are ground by PPDF as published.

    Parameters
    ----------
    cloud : Cloud
        Points; `known` and `fixed` are honoured. 0, 1 and 2 points are non-ground.
    params : PaperParams
        The published values by default.

    Returns
    -------
    Verdict
        For the core points; those not unproven equal the answer for every cloud that agrees within the known area.

    Warns
    -----
    RuntimeWarning
        When 200 growth passes did not suffice.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = (v.ravel() for v in np.meshgrid(np.arange(0.5, 20), np.arange(0.5, 20)))
    >>> ground = np.column_stack([x, y, 0.3 * x])
    >>> verdict = classify(cloud_from_xyz(np.vstack([ground, [[10.2, 10.2, 12.0]]])), PaperParams())
    >>> bool(verdict.ground[:-1].all()), bool(verdict.ground[-1])
    (True, False)
    """
    found = stages(cloud, params)
    if found.passes < 0:
        warnings.warn(
            f"growth was stopped after {MOST_PASSES} passes while points were still being added; "
            "a smaller classification_distance ends it earlier",
            RuntimeWarning,
            stacklevel=2,
        )
    core = slice(0, cloud.n_core)
    return Verdict(found.ground[core].copy(), found.unproven[core].copy())


def stages(cloud: Cloud, params: PaperParams) -> Stages:
    """Run the filter and keep what each step found; `classify` returns the last of it.

    Parameters
    ----------
    cloud : Cloud
        As for `classify`.
    params : PaperParams
        As for `classify`.

    Returns
    -------
    Stages
        For the pictures of the paper's Figures 6, 7, 9 and 10.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import cloud_from_xyz
    >>> x, y = (v.ravel() for v in np.meshgrid(np.arange(0.5, 20), np.arange(0.5, 20)))
    >>> found = stages(cloud_from_xyz(np.column_stack([x, y, 0 * x])), PaperParams())
    >>> len(found.planes), int(found.seeds.sum()), found.passes
    (4, 400, 1)
    """
    squares = sort_by_square(cloud, round(params.plane_size * MM))
    uncertain = cut_by_edge(cloud, squares.ix, squares.iy, squares.edge)
    if params.seeds == "planes":
        under, undecided = under_canopy(
            cloud, squares, round(params.canopy_cell * MM), round(params.canopy_height * MM)
        )
        seeds, planes = plane_seeds(cloud, squares, under, params)
        uncertain |= np.add.reduceat(undecided, squares.starts[:-1], dtype=np.int64) > 0 if cloud.n else uncertain
    else:
        under, planes = np.ones(cloud.n, bool), Planes.none()
        seeds = lowest_seeds(squares)
    place = squares.places()
    start = _start(cloud, squares, place, seeds, uncertain)
    end, passes = _grown(cloud, squares, place, start, params)
    return Stages(
        under_canopy=_back(under, squares),
        planes=planes,
        seeds=_back(start[place] & GROUND != 0, squares),
        ground=_back(end[place] & GROUND != 0, squares),
        unproven=_back(end[place] & UNPROVEN != 0, squares),
        passes=passes,
    )


def _start(cloud: Cloud, squares: Squares, place: Ints, seeds: Bools, uncertain: Bools) -> States:
    """Return the state of each distinct place before growth, so that exact duplicates get one label."""
    state = np.zeros(int(place[-1]) + 1 if len(place) else 0, np.uint8)
    state[place[np.repeat(uncertain, np.diff(squares.starts))]] = UNPROVEN
    state[place[seeds]] |= GROUND
    if cloud.fixed is not None:
        state[place[cloud.fixed[squares.order]]] = GROUND
    return state


def _grown(cloud: Cloud, squares: Squares, place: Ints, state: States, params: PaperParams) -> tuple[States, int]:
    """Grow over the distinct places."""
    first = np.diff(place, prepend=np.int32(-1)) != 0
    # Squares weighted by their points: the density that most points see.
    counts = np.diff(squares.starts).astype(float)
    density = float((counts**2).sum()) / max(1, cloud.n) / (squares.edge / MM) ** 2
    points = squares.x[first], squares.y[first], squares.z[first]
    return grow(points, state, density, _relative(cloud), params)


def _relative(cloud: Cloud) -> Rect | None:
    """Return the known area in the cloud's own coordinates."""
    if cloud.known is None:
        return None
    (ox, oy), k = cloud.origin, cloud.known
    return Rect(k.x0 - ox, k.y0 - oy, k.x1 - ox, k.y1 - oy)


def _back(mask: Bools, squares: Squares) -> Bools:
    out = np.empty(len(mask), bool)
    out[squares.order] = mask
    return out
