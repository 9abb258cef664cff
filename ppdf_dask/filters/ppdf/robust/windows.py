"""Clouds whose bounding box is mostly empty: occupied windows, each widened until its answers are proven.

A dense grid over two points 2000 km apart, or over a diagonal corridor, would take unbounded memory. Such a cloud is
cut into square windows; a window's answers are proven, hence those of the whole.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Cloud, Verdict
from ppdf_dask.grid import Rect

CELLS_AT_LEAST = 1 << 20
"""A grid of this many cells is always allowed: about 22 MB."""

CELLS_PER_POINT = 4
"""Above that a grid may have this many cells per point, which keeps the filter below 120 bytes per point."""

CELLS_AT_MOST = 1 << 26
"""A window that needs a larger grid (1.5 GB) to be proven leaves its points unproven."""

WINDOW = 1024
"""Edge of a window, cells."""


def fits_one_grid(cloud: Cloud, cell: int) -> bool:
    """Tell whether one dense grid over the cloud's bounding box is worth its memory."""
    return _cells(cloud.x, cloud.y, cell) <= max(CELLS_AT_LEAST, CELLS_PER_POINT * cloud.n)


def _cells(x: npt.NDArray[np.int32], y: npt.NDArray[np.int32], cell: int) -> int:
    wide, high = (int(v.max()) - int(v.min()) for v in (x, y))
    return (wide // cell + 1) * (high // cell + 1)


def in_windows(cloud: Cloud, cell: int, buffer: int, classify: Callable[[Cloud], Verdict]) -> Verdict:
    """Classify window by window.

    Parameters
    ----------
    cloud : Cloud
        At least one point.
    cell : int
        Cell edge, mm; windows have 1024 cells along an edge.
    buffer : int
        First guess of a window's surroundings, mm; doubled until every answer is proven.
    classify : callable
        Classifies a small cloud and says what it could not prove.

    Returns
    -------
    Verdict
        Masks of the core points. With ``cloud.known`` None a point is unproven only if its window would have
        needed more than 2^26 cells.
    """
    edge = WINDOW * cell
    ox, oy = cloud.origin
    col = (cloud.x.astype(np.int64) + ox) // edge
    row = (cloud.y.astype(np.int64) + oy) // edge
    key = np.stack([row, col], axis=1)
    names, window = np.unique(key, axis=0, return_inverse=True)
    order = np.argsort(window, kind="stable")
    ends = np.searchsorted(window[order], np.arange(len(names) + 1))
    slot = {(int(r), int(c)): order[ends[i] : ends[i + 1]] for i, (r, c) in enumerate(names)}
    ground = np.zeros(cloud.n_core, np.bool_)
    unproven = np.zeros(cloud.n_core, np.bool_)
    for (r, c), mine in slot.items():
        core = mine[mine < cloud.n_core]
        if len(core) == 0:
            continue
        rect = Rect(c * edge, r * edge, (c + 1) * edge, (r + 1) * edge)
        found = _one_window(cloud, rect, core, slot, cell, buffer, classify)
        ground[core] = found.ground
        unproven[core] = found.unproven
    return Verdict(ground, unproven)


def _one_window(
    cloud: Cloud,
    rect: Rect,
    core: npt.NDArray[np.int64],
    slot: dict[tuple[int, int], npt.NDArray[np.int64]],
    cell: int,
    buffer: int,
    classify: Callable[[Cloud], Verdict],
) -> Verdict:
    edge = rect.width
    ox, oy = cloud.origin
    while True:
        wide = rect.grow(buffer).snap(edge // 64)
        around = _windows_of(wide, edge, slot)
        x, y = (cloud.x[around].astype(np.int64) + ox), (cloud.y[around].astype(np.int64) + oy)
        inside = (x >= wide.x0) & (x < wide.x1) & (y >= wide.y0) & (y < wide.y1)
        inside &= (x < rect.x0) | (x >= rect.x1) | (y < rect.y0) | (y >= rect.y1)
        chosen = np.concatenate([core, _others(slot, rect, cloud.n_core), around[inside]])
        whole = len(chosen) == cloud.n
        known = cloud.known if whole else wide if cloud.known is None else _meet(wide, cloud.known)
        px, py = cloud.x[chosen], cloud.y[chosen]
        shift_x, shift_y = int(px.min()), int(py.min())
        part = Cloud(
            px - np.int32(shift_x),
            py - np.int32(shift_y),
            cloud.z[chosen],
            (ox + shift_x, oy + shift_y),
            len(core),
            known,
            None if cloud.fixed is None else cloud.fixed[chosen],
        )
        verdict = classify(part)
        if whole or not verdict.unproven.any() or (cloud.known is not None and wide.contains(cloud.known)):
            return verdict
        buffer *= 2
        span = (rect.width + 2 * buffer) // cell
        if span * span > CELLS_AT_MOST:
            return verdict


def _others(slot: dict[tuple[int, int], npt.NDArray[np.int64]], rect: Rect, n_core: int) -> npt.NDArray[np.int64]:
    mine = slot[rect.y0 // rect.height, rect.x0 // rect.width]
    return mine[mine >= n_core]


def _windows_of(wide: Rect, edge: int, slot: dict[tuple[int, int], npt.NDArray[np.int64]]) -> npt.NDArray[np.int64]:
    parts = [
        slot[r, c]
        for r in range(wide.y0 // edge, -(-wide.y1 // edge))
        for c in range(wide.x0 // edge, -(-wide.x1 // edge))
        if (r, c) in slot
    ]
    return np.concatenate(parts)


def _meet(a: Rect, b: Rect) -> Rect:
    return Rect(max(a.x0, b.x0), max(a.y0, b.y0), min(a.x1, b.x1), min(a.y1, b.y1))
