"""The robust profile from points to labels: one grid where it fits, else windows that prove themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Cloud, Verdict
from ppdf_dask.filters.ppdf.robust import cells as cells_
from ppdf_dask.filters.ppdf.robust.cells import Cells
from ppdf_dask.filters.ppdf.robust.cliffs import cliff_tops
from ppdf_dask.filters.ppdf.robust.fine import halve
from ppdf_dask.filters.ppdf.robust.growth import clean, grow
from ppdf_dask.filters.ppdf.robust.label import label
from ppdf_dask.filters.ppdf.robust.params import RobustParams
from ppdf_dask.filters.ppdf.robust.patches import judge_components, link_patches, spread_roofs
from ppdf_dask.filters.ppdf.robust.planes import find_planes
from ppdf_dask.filters.ppdf.robust.roughness import local_roughness
from ppdf_dask.filters.ppdf.robust.surface import room_for_index
from ppdf_dask.filters.ppdf.robust.windows import fits_one_grid, in_windows
from ppdf_dask.grid import MM

LOOK_OUT = 12
"""Cells: how far a seed looks for its own patch before it counts as border."""

NEAR = 3
"""Cells: low points of two patches so near vote on whether the patches are one surface."""

AGREE = 1.0
"""Metres: two low points agree when each lies this near to the other's plane."""

CACHED_CELLS = 1 << 15
"""A larger grid does not fit a processor's cache: its points are taken row by row, whatever the file's order."""

ROUGH_REACH = 5
"""Cells on each side over which the roughness is taken."""

ROUGH_MOST = 1.0
"""Metres: a residual counts at most this much."""

NO_ROUGHNESS = np.empty(0, np.int32)
NO_POINTS = np.empty(0, np.bool_)


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
        Masks of the core points. Clouds without a plane (0 to 3 points, points on a line, identical points) have
        no ground.

    Raises
    ------
    ParameterError
        When `cell_size` is None.
    """
    cell = params.cell_mm
    if cloud.n == 0:
        return Verdict(np.zeros(0, np.bool_), np.zeros(0, np.bool_))
    if fits_one_grid(cloud, cell):
        return classify_area(cloud, params)
    return in_windows(cloud, cell, round(params.required_buffer() * MM), lambda c: classify_area(c, params))


def classify_area(cloud: Cloud, params: RobustParams) -> Verdict:
    """Classify on one dense grid over all points of the cloud; `classify` without its guard."""
    height, width = (int(v.max()) - int(v.min()) for v in (cloud.y, cloud.x))
    if height // params.cell_mm * (width // params.cell_mm) < CACHED_CELLS:
        return _classify_in_order(cloud, params)
    order = _by_rows(cloud, params.cell_mm)
    core, fixed = order[: cloud.n_core], None if cloud.fixed is None else cloud.fixed[order]
    found = _classify_in_order(
        replace(cloud, x=cloud.x[order], y=cloud.y[order], z=cloud.z[order], fixed=fixed), params
    )
    ground, unproven = np.empty_like(found.ground), np.empty_like(found.unproven)
    ground[core], unproven[core] = found.ground, found.unproven
    return Verdict(ground, unproven)


def _by_rows(cloud: Cloud, cell: int) -> npt.NDArray[np.int64]:
    """Return an order of the points, core first, in which those of a row of cells follow each other."""
    rows = (cloud.y - cloud.y.min()) // cell
    if rows.max() < 1 << 16:  # sixteen bits are sorted in linear time
        rows = rows.astype(np.uint16)
    n = cloud.n_core
    return np.concatenate([np.argsort(rows[:n], kind="stable"), n + np.argsort(rows[n:], kind="stable")])


def _classify_in_order(cloud: Cloud, params: RobustParams) -> Verdict:
    """Classify points in the order they come in: no label depends on it, but speed does where the grid is large."""
    cell = params.cell_mm
    rings = -(-round(params.search_radius * MM) // cell)
    cells = cells_.build(cloud, cell, max(rings, LOOK_OUT) + 1)
    if "outliers" in params.steps:
        cells_.drop_low_outliers(cloud, cells)
    if "planes" in params.steps:
        _seed(cells, params)
    state = _grow(cells, params) if "growth" in params.steps else cells.state
    after, rough = np.empty_like(state), np.empty(len(state), np.int32)
    residuals = np.empty(len(state), np.int32)
    limit2 = round(params.search_radius * MM) ** 2
    drop = "cleaning" in params.steps
    clean(cells.width, cell, cells.pos, state, rings, limit2, drop, residuals, room_for_index(len(state)), after)
    local_roughness(cells.width, cells.height, after, residuals, ROUGH_REACH, round(ROUGH_MOST * MM), rough)
    return _label(cloud, cells, after, rough, params)


def _seed(cells: Cells, params: RobustParams) -> None:
    """Planes, their seeds, and the test that tells terrain from roofs and crowns (steps 4 to 6)."""
    width, height, cell, pos, state = cells.width, cells.height, cells.cell, cells.pos, cells.state
    lows = int(np.count_nonzero(state & cells_.LOW))
    patch = np.full(len(state), -1, np.int32)
    planes, squares = np.empty((lows, 3)), np.empty((lows, 4), np.int32)
    count = find_planes(
        width,
        height,
        cell,
        pos,
        state,
        patch,
        planes,
        squares,
        params.trials,
        params.inlier_distance,
        params.inlier_share,
        params.division_distance,
    )
    if "roofs" not in params.steps:
        return
    parent, open_ = np.empty(count, np.int32), np.empty(count, np.bool_)
    link_patches(width, cell, pos, state, patch, planes, squares, count, NEAR, AGREE, parent, open_)
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
        round(params.border_reach * MM),
        params.border_drop,
        params.border_share,
        params.border_gentle,
        params.smallest_patch,
        round(params.largest_building * MM),
    )
    spread_roofs(width, height, cell, pos, state, patch, planes, squares, AGREE)


def _grow(cells: Cells, params: RobustParams) -> npt.NDArray[np.uint8]:
    """Grow the references over the low points in synchronous passes (step 7); return the new state."""
    limit = round(params.search_radius * MM)
    state, after = cells.state, np.empty_like(cells.state)
    looked, news, index = np.empty(len(state), np.uint16), np.empty(len(state), np.int32), room_for_index(len(state))
    for number in range(params.passes):
        changed = grow(
            cells.width,
            cells.cell,
            cells.pos,
            state,
            -(-limit // cells.cell),
            limit * limit,
            params.growth_base,
            params.growth_spread,
            params.growth_slope,
            params.growth_step,
            params.growth_spread,
            1.5,
            cells_.ROOF,
            NO_ROUGHNESS,
            0.0,
            0.0,
            1,
            number == 0,
            cells.pos,
            state,
            1,
            looked,
            news,
            index,
            after,
        )
        state, after = after, state
        if not changed:
            break
    return state


def _label(
    cloud: Cloud, cells: Cells, state: npt.NDArray[np.uint8], rough: npt.NDArray[np.int32], params: RobustParams
) -> Verdict:
    """Second growth over halved cells where the cloud is sparse (step 10), then the labels (step 11)."""
    limit = round(params.search_radius * MM)
    known, pos, width, cell, parts = state, cells.pos, cells.width, cells.cell, 1
    if params.refinement == 2 and "refinement" in params.steps:
        pos, state = halve(
            cloud.x,
            cloud.y,
            cloud.z,
            cells.x0,
            cells.y0,
            cells.of_point,
            pos,
            cells.floor,
            state,
            width,
            cells.height,
            cell,
        )
        width, cell, parts, limit = 2 * width, cell // 2, 2, limit // 2
        state = _grow_fine(cells, known, pos, state, rough, params)
    ground, unproven = np.empty(cloud.n_core, np.bool_), np.empty(cloud.n_core, np.bool_)
    label(
        cloud.x,
        cloud.y,
        cloud.z,
        NO_POINTS if cloud.fixed is None else cloud.fixed,
        cloud.n_core,
        cells.x0,
        cells.y0,
        cells.of_point,
        cells.floor,
        known,
        rough,
        parts,
        width,
        cell,
        pos,
        state,
        -(-limit // cell),
        limit * limit,
        params.tolerance,
        params.roughness,
        params.label_spread,
        params.label_slope,
        cliff_tops(width, pos, state),
        room_for_index(len(state)),
        ground,
        unproven,
    )
    return Verdict(ground, unproven)


def _grow_fine(
    coarse: Cells,
    known: npt.NDArray[np.uint8],
    pos: npt.NDArray[np.int32],
    state: npt.NDArray[np.uint8],
    rough: npt.NDArray[np.int32],
    params: RobustParams,
) -> npt.NDArray[np.uint8]:
    """Growth over the finer cells with a tolerance that follows the roughness (step 10)."""
    limit = round(params.search_radius * MM) // 2
    width, cell, after = 2 * coarse.width, coarse.cell // 2, np.empty_like(state)
    looked, news, index = np.empty(len(state), np.uint16), np.empty(len(state), np.int32), room_for_index(len(state))
    for number in range(params.fine_passes):
        grow(
            width,
            cell,
            pos,
            state,
            -(-limit // (coarse.cell if number == 0 else cell)),
            limit * limit,
            params.fine_base,
            params.fine_spread,
            params.fine_slope,
            params.fine_step,
            params.fine_spread,
            2.0,
            cells_.ROOF | cells_.HIGH,
            rough,
            params.fine_roughness,
            ROUGH_MOST,
            2,
            number == 0,
            coarse.pos if number == 0 else pos,
            known if number == 0 else state,
            2 if number == 0 else 1,
            looked,
            news,
            index,
            after,
        )
        state, after = after, state
    return state
