"""The robust profile from points to labels: one grid where it fits, else windows that prove themselves."""

from __future__ import annotations

import numpy as np

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters.cloud import Cloud, Verdict
from ppdf_dask.filters.ppdf.robust import cells as cells_
from ppdf_dask.filters.ppdf.robust.growth import clean, grow
from ppdf_dask.filters.ppdf.robust.label import label
from ppdf_dask.filters.ppdf.robust.params import RobustParams
from ppdf_dask.filters.ppdf.robust.patches import judge_components, link_patches
from ppdf_dask.filters.ppdf.robust.planes import find_planes
from ppdf_dask.filters.ppdf.robust.windows import fits_one_grid, in_windows
from ppdf_dask.grid import MM

LOOK_OUT = 12


def classify(cloud: Cloud, params: RobustParams) -> Verdict:
    """Tell which core points are ground, and which of these answers need a wider known area.

    Parameters
    ----------
    cloud : Cloud
        Eligible points, core first.
    params : RobustParams
        With `cell_size` filled in (`RobustParams.resolve`).

    Returns
    -------
    Verdict
        Masks of the core points.

    Raises
    ------
    ParameterError
        When `cell_size` is None.
    """
    if params.cell_size is None:
        raise ParameterError("cell_size is not set; call params.resolve(density) first or give cell_size in metres")
    if cloud.n == 0:
        return Verdict(np.zeros(cloud.n_core, np.bool_), np.zeros(cloud.n_core, np.bool_))
    if fits_one_grid(cloud, params.cell_mm):
        return classify_area(cloud, params)
    return in_windows(cloud, params.cell_mm, round(params.required_buffer() * MM), lambda c: classify_area(c, params))


def classify_area(cloud: Cloud, params: RobustParams) -> Verdict:
    """Classify on one dense grid over all points of the cloud; `classify` without its guard."""
    ground = np.zeros(cloud.n_core, np.bool_)
    unproven = np.zeros(cloud.n_core, np.bool_)
    cell = params.cell_mm
    limit = round(params.search_radius * MM)
    rings = -(-limit // cell)
    cells = cells_.build(cloud, cell, max(rings, LOOK_OUT) + 1)
    cells_.drop_low_outliers(cloud, cells, round(params.peel * MM))
    width, pos, state = cells.width, cells.pos, cells.state
    lows = int(np.count_nonzero(state & cells_.LOW))
    patch = np.full(len(state), -1, np.int32)
    planes = np.empty((lows, 3))
    squares = np.empty((lows, 4), np.int32)
    count = find_planes(
        width,
        cells.height,
        cell,
        pos,
        state,
        patch,
        planes,
        squares,
        params.trials,
        params.refits,
        params.inlier_distance,
        params.inlier_share,
        params.division_distance,
    )
    parent = np.empty(count, np.int32)
    open_ = np.empty(count, np.bool_)
    link_patches(width, cell, pos, state, patch, planes, squares, count, 3, 1.0, parent, open_)
    large = round(params.largest_building * MM)
    judge_components(
        width,
        cell,
        pos,
        state,
        patch,
        planes,
        squares,
        count,
        parent,
        open_,
        LOOK_OUT,
        1.5,
        0.40,
        min(100_000, large),
        0.75,
        large,
    )
    after = np.empty_like(state)
    for _ in range(params.passes):
        if not grow(width, cell, pos, state, rings, limit * limit, after):
            break
        state, after = after, state
    if params.clean:
        clean(width, cell, pos, state, rings, limit * limit, after)
        state = after
    fixed = cloud.fixed if cloud.fixed is not None else np.empty(0, np.bool_)
    label(
        cloud.x,
        cloud.y,
        cloud.z,
        fixed,
        cloud.n_core,
        cells.x0,
        cells.y0,
        cells.of_point,
        width,
        cell,
        pos,
        cells.floor,
        state,
        rings,
        limit * limit,
        params.tolerance,
        ground,
        unproven,
    )
    return Verdict(ground, unproven)
