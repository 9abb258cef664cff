"""The robust profile from points to labels: one grid where it fits, else windows that prove themselves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Cloud, Verdict
from ppdf_dask.filters.ppdf.compiled import kernel
from ppdf_dask.filters.ppdf.robust import cells as cells_
from ppdf_dask.filters.ppdf.robust.cells import Cells
from ppdf_dask.filters.ppdf.robust.fine import halve
from ppdf_dask.filters.ppdf.robust.growth import References, Rule, candidates, clean, grow
from ppdf_dask.filters.ppdf.robust.label import Points, Tolerance, label
from ppdf_dask.filters.ppdf.robust.lanes import Room, room_for_lanes
from ppdf_dask.filters.ppdf.robust.params import RobustParams
from ppdf_dask.filters.ppdf.robust.patches import LOOK_OUT, judge_components, link_patches, spread_roofs
from ppdf_dask.filters.ppdf.robust.planes import find_planes
from ppdf_dask.filters.ppdf.robust.roughness import local_roughness
from ppdf_dask.filters.ppdf.robust.surface import index_references, room_for_index
from ppdf_dask.filters.ppdf.robust.windows import fits_one_grid, in_windows
from ppdf_dask.grid import MM

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
    n, lowest, highest = cloud.n_core, int(cloud.y.min()), int(cloud.y.max())
    order, next_of_row = np.empty(cloud.n, np.int64), np.empty((highest - lowest) // cell + 2, np.int64)
    _sort_into_rows(cloud.y[:n], 0, lowest, cell, next_of_row, order[:n])
    _sort_into_rows(cloud.y[n:], n, lowest, cell, next_of_row, order[n:])
    return order


@kernel
def _sort_into_rows(y: Any, first: Any, lowest: Any, cell: Any, next_of_row: Any, order: Any) -> None:
    """Set `order` to the numbers of the points from `first` on, row by row; room: `next_of_row`, one more than rows."""
    for row in range(len(next_of_row)):
        next_of_row[row] = 0
    for i in range(len(y)):
        next_of_row[np.uintp((y[i] - lowest) // cell + 1)] += 1
    for row in range(1, len(next_of_row)):
        next_of_row[row] += next_of_row[row - 1]
    for i in range(len(y)):
        here = np.uintp((y[i] - lowest) // cell)
        order[np.uintp(next_of_row[here])] = first + i
        next_of_row[here] += 1


def _classify_in_order(cloud: Cloud, params: RobustParams) -> Verdict:
    """Classify points in the order they come in: no label depends on it, but speed does where the grid is large."""
    cell = params.cell_mm
    rings = -(-round(params.search_radius * MM) // cell)
    cells = cells_.build(cloud, cell, max(rings, LOOK_OUT) + 1)
    if "outliers" in params.steps:
        cells_.drop_low_outliers(cloud, cells)
    if "planes" in params.steps:
        _seed(cells, params)
    references, room = _references(cells, cells.state), room_for_lanes()
    if "growth" in params.steps:
        _grow(cells, references, params, room)
    state, residuals = clean(references, round(params.search_radius * MM), "cleaning" in params.steps, room)
    rough = local_roughness(cells.width, state, residuals, ROUGH_REACH, round(ROUGH_MOST * MM))
    index_references(cells.width, cell, cells.pos, state, references.indexed)
    return _label(cloud, cells, references._replace(state=state), rough, params, room)


def _references(cells: Cells, state: npt.NDArray[np.uint8]) -> References:
    """Return the grid with its references, indexed."""
    index = room_for_index(len(state))
    index_references(cells.width, cells.cell, cells.pos, state, index)
    return References(cells.width, cells.cell, cells.pos, state, index)


def _seed(cells: Cells, params: RobustParams) -> None:
    """Planes, their seeds, and the test that tells terrain from roofs and crowns (steps 4 to 6)."""
    patches = find_planes(cells, params)
    if "roofs" in params.steps:
        judge_components(cells, patches, link_patches(cells, patches), params)
        spread_roofs(cells, patches)


def _grow(cells: Cells, references: References, params: RobustParams, room: Room) -> None:
    """Grow the references over the low points in synchronous passes (step 7); their states and index follow."""
    limit = round(params.search_radius * MM)
    spread, step = params.growth_spread, params.growth_step
    rule = Rule(params.growth_base, spread, params.growth_slope, step, spread, 1.5, 0.0, 0.0)
    left, skip = candidates(cells.state, cells_.ROOF), cells_.ROOF
    for _ in range(params.passes):
        changed, left = grow(cells.pos, cells.state, references, 1, limit, rule, skip, NO_ROUGHNESS, 1, left, room)
        if not changed:
            break


def _label(
    cloud: Cloud,
    cells: Cells,
    references: References,
    rough: npt.NDArray[np.int32],
    params: RobustParams,
    room: Room,
) -> Verdict:
    """Second growth over halved cells where the cloud is sparse (step 10), then the labels (step 11)."""
    limit, x0, y0, of_point = round(params.search_radius * MM), cells.x0, cells.y0, cells.of_point
    x, y, z, state = cloud.x, cloud.y, cloud.z, references.state
    fixed = NO_POINTS if cloud.fixed is None else cloud.fixed
    if params.refinement == 2 and "refinement" in params.steps:
        fine_pos, fine_state = halve(cloud, cells, state)
        references, limit = _grow_fine(fine_pos, fine_state, references, rough, params, room), limit // 2
    rule = Tolerance(params.tolerance, params.roughness, params.label_spread, params.label_slope)
    points = Points(x, y, z, fixed, x0, y0, of_point, cells.floor, state, rough)
    return label(points, cloud.n_core, references, limit, rule, room)


def _grow_fine(
    pos: npt.NDArray[np.int32],
    state: npt.NDArray[np.uint8],
    coarse: References,
    rough: npt.NDArray[np.int32],
    params: RobustParams,
    room: Room,
) -> References:
    """Growth over the finer cells with a tolerance that follows the roughness (step 10); return their references."""
    limit, skip = round(params.search_radius * MM) // 2, cells_.ROOF | cells_.HIGH
    spread, step, factor = params.fine_spread, params.fine_step, params.fine_roughness
    rule = Rule(params.fine_base, spread, params.fine_slope, step, spread, 2.0, factor, ROUGH_MOST)
    fine = References(2 * coarse.width, coarse.cell // 2, pos, state, room_for_index(len(state)))
    left = candidates(state, skip)
    for number in range(params.fine_passes):
        seek, fold = (coarse, 2) if number == 0 else (fine, 1)
        _changed, left = grow(pos, state, seek, fold, limit, rule, skip, rough, 2, left, room)
        if number == 0:
            index_references(fine.width, fine.cell, pos, state, fine.indexed)
    if params.fine_passes == 0:
        index_references(fine.width, fine.cell, pos, state, fine.indexed)
    return fine
