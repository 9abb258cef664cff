"""One laser pulse after the other through crowns, roofs and grass down to the terrain (numba)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ppdf_dask.synthetic._noise import bell, cell_hash, following, unit
from ppdf_dask.synthetic.objects import BOULDER_CELL, HOUSE_CELL, SHRUB_CELL, Window
from ppdf_dask.synthetic.terrain import Relief, height

MOST_RETURNS = 5
_PULSE = np.uint64(0x9000)
_DEAD_ZONE = 0.8
_LEAST_ENERGY = 0.12
_GROUND, _WATER, _OTHER, _BUILDING, _LOW_NOISE, _HIGH_NOISE = 2, 9, 1, 6, 7, 18


class Beam(NamedTuple):
    """The scanner's constants: pulse lattice, flight strips, what swallows a pulse and what goes wrong."""

    spacing: float
    columns: int
    altitude: float
    speed: float
    strip_period: float
    tree_cell: float
    crown: float
    tallest: float
    penetration: float
    grass: float
    sigma: float
    low_noise: float
    high_noise: float
    low_outliers: float
    water_returns: float


class Band(NamedTuple):
    """Columns of points: places in mm, LAS fields, the true class and the class of an unclassified delivery."""

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    z: NDArray[np.int32]
    return_number: NDArray[np.uint8]
    number_of_returns: NDArray[np.uint8]
    classification: NDArray[np.uint8]
    delivered: NDArray[np.uint8]
    intensity: NDArray[np.uint16]
    gps_time: NDArray[np.float64]
    scan_angle: NDArray[np.int16]
    point_source_id: NDArray[np.uint16]


@njit(nogil=True, cache=True)
def _house_top(x: float, y: float, zg: float, lean: float, w: Window) -> float:
    """Return the height at which the ray with foot (x, y, zg) meets a roof or a wall; -inf when it meets none."""
    for probe in range(2):
        at = x + probe * lean * 8.0
        column, row = int(np.floor(at / HOUSE_CELL)) - w.house_i0, int(np.floor(y / HOUSE_CELL)) - w.house_j0
        if w.houses[row, column, 4] == 0.0:
            continue
        house = w.houses[row, column]
        eave = house[8] + house[6]
        z = eave + 0.5 * house[7]
        inside = False
        for _ in range(3):
            dx, dy = x + lean * (z - zg) - house[0], y - house[1]
            u, v = dx * house[2] + dy * house[3], dy * house[2] - dx * house[3]
            inside = abs(u) <= house[4] and abs(v) <= house[5]
            z = eave + house[7] * max(0.0, 1.0 - abs(v) / house[5])
        if inside:
            return float(z)
        dx, dy = x - house[0], y - house[1]
        u, v = dx * house[2] + dy * house[3], dy * house[2] - dx * house[3]
        if abs(u) <= house[4] and abs(v) <= house[5]:
            low, high = zg, z
            for _ in range(16):
                z = 0.5 * (low + high)
                dx = x + lean * (z - zg) - house[0]
                u, v = dx * house[2] + dy * house[3], dy * house[2] - dx * house[3]
                if abs(u) <= house[4] and abs(v) <= house[5]:
                    low = z
                else:
                    high = z
            return float(low)
    return -np.inf


@njit(nogil=True, cache=True)
def _boulder_top(x: float, y: float, w: Window) -> float:
    column, row = int(np.floor(x / BOULDER_CELL)) - w.boulder_i0, int(np.floor(y / BOULDER_CELL)) - w.boulder_j0
    rocks = w.boulders
    top = -np.inf
    for j in range(row - 1, row + 2):
        for i in range(column - 1, column + 2):
            if rocks[j, i, 3] > 0.0:
                dx, dy = x - rocks[j, i, 0], y - rocks[j, i, 1]
                t = 1.0 - (dx * dx + dy * dy) / (rocks[j, i, 4] * rocks[j, i, 4])
                if t > 0.0:
                    top = max(top, rocks[j, i, 2] + 0.8 * rocks[j, i, 3] * np.sqrt(t))
    return top


@njit(nogil=True, cache=True)
def _crowns(
    x: float, y: float, zg: float, lean: float, ragged: float, beam: Beam, w: Window, spans: NDArray[np.float64]
) -> int:
    """Write top, bottom and leaf distance of the crowns and shrubs on the ray, highest first; return their number."""
    trees, shrubs = w.trees, w.shrubs
    n = 0
    end = x + lean * beam.tallest
    i0 = int(np.floor((min(x, end) - beam.crown) / beam.tree_cell)) - w.tree_i0
    i1 = int(np.floor((max(x, end) + beam.crown) / beam.tree_cell)) - w.tree_i0
    j0 = int(np.floor((y - beam.crown) / beam.tree_cell)) - w.tree_j0
    j1 = int(np.floor((y + beam.crown) / beam.tree_cell)) - w.tree_j0
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            if trees[j, i, 3] == 0.0 or n == len(spans):
                continue
            # The ray is taken as upright within a crown, where it crosses the crown's middle.
            dx, dy = x + lean * (trees[j, i, 2] + 0.6 * trees[j, i, 3] - zg) - trees[j, i, 0], y - trees[j, i, 1]
            t = (dx * dx + dy * dy) / (trees[j, i, 4] * trees[j, i, 4] * ragged)
            if t >= 1.0:
                continue
            if trees[j, i, 5] == 1.0:
                spans[n, 0] = trees[j, i, 2] + trees[j, i, 3] * (1.0 - 0.78 * np.sqrt(t))
                spans[n, 1] = trees[j, i, 2] + 0.2 * trees[j, i, 3]
            else:
                half = 0.36 * trees[j, i, 3] * np.sqrt(1.0 - t)
                spans[n, 0] = trees[j, i, 2] + 0.64 * trees[j, i, 3] + half
                spans[n, 1] = trees[j, i, 2] + 0.64 * trees[j, i, 3] - half
            spans[n, 2] = beam.penetration
            n += 1
    column, row = int(np.floor(x / SHRUB_CELL)) - w.shrub_i0, int(np.floor(y / SHRUB_CELL)) - w.shrub_j0
    for j in range(row - 1, row + 2):
        for i in range(column - 1, column + 2):
            if shrubs[j, i, 3] == 0.0 or n == len(spans):
                continue
            dx, dy = x - shrubs[j, i, 0], y - shrubs[j, i, 1]
            t = (dx * dx + dy * dy) / (shrubs[j, i, 4] * shrubs[j, i, 4] * ragged)
            if t < 1.0:
                spans[n, 0] = shrubs[j, i, 2] + shrubs[j, i, 3] * np.sqrt(1.0 - t)
                spans[n, 1] = zg + 0.2
                spans[n, 2] = 0.3 * beam.penetration
                n += 1
    for k in range(1, n):
        top, bottom, free = spans[k, 0], spans[k, 1], spans[k, 2]
        m = k
        while m > 0 and spans[m - 1, 0] < top:
            for field in range(3):
                spans[m, field] = spans[m - 1, field]
            m -= 1
        spans[m, 0], spans[m, 1], spans[m, 2] = top, bottom, free
    return n


@njit(nogil=True, cache=True)
def _through_leaves(
    n: int,
    floor: float,
    h: np.uint64,
    spans: NDArray[np.float64],
    zs: NDArray[np.float64],
    energies: NDArray[np.float64],
) -> tuple[int, float, np.uint64]:
    """Let a pulse spend its energy in the crowns; return the number of returns, the energy left and the next hash."""
    found, energy, z = 0, 1.0, np.inf
    for k in range(n):
        while found < len(zs) - 1 and energy > _LEAST_ENERGY:
            h = following(h)
            # A depth with a heavy tail, P(deeper than d) = 1 / (1 + d/free): leaves come in clumps with gaps between.
            depth = spans[k, 2] * (1.0 / (1.0 - unit(h)) - 1.0)
            start = min(spans[k, 0], z if found == 0 else z - _DEAD_ZONE)
            if start - depth <= max(spans[k, 1], floor + 0.2):
                break
            z = start - depth
            h = following(h)
            share = min(1.0, 0.3 + 0.6 * unit(h))
            zs[found], energies[found] = z, energy * share
            energy *= 1.0 - share
            found += 1
    return found, energy, h


@njit(nogil=True, cache=True)
def scan(
    box: tuple[int, int, int, int],
    lattice: tuple[int, int, int, int],
    strip: int,
    r: Relief,
    beam: Beam,
    w: Window,
    out: Band,
) -> int:
    """Fire the pulses of lattice columns i0 <= i < i1 and rows j0 <= j < j1 of one strip, in the order of their time.

    Points outside `box` (x0, y0, x1, y1 in mm, half-open) are left out. Returns the number of points written.
    """
    i0, i1, j0, j1 = lattice
    x0, y0, x1, y1 = box
    spans = np.empty((24, 3))
    zs, energies, kinds = np.empty(MOST_RETURNS), np.empty(MOST_RETURNS), np.empty(MOST_RETURNS, np.uint8)
    n = 0
    for j in range(j0, j1):
        for step in range(i1 - i0):
            # The mirror swings: odd lines run from right to left.
            i = i0 + step if j % 2 == 0 else i1 - 1 - step
            h = cell_hash(i, j, r.salt + _PULSE)
            px = np.int64(np.floor((i + unit(h)) * beam.spacing * 1000.0))
            h = following(h)
            py = np.int64(np.floor((j + unit(h)) * beam.spacing * 1000.0))
            if py < y0 or py >= y1:
                continue
            column = i - strip * beam.columns
            lean = (column + 0.5 - 0.5 * beam.columns) * beam.spacing / beam.altitude
            x, y = px * 0.001, py * 0.001
            zg, wet = height(x, y, r)
            h = following(h)
            chance = unit(h)
            h = following(h)
            found, energy, delivered = 0, 1.0, np.uint8(1)
            if chance < beam.low_noise + beam.low_outliers:
                zs[0], energies[0], kinds[0], found = zg - 2.0 - 13.0 * unit(h), 0.1, _LOW_NOISE, 1
                delivered = np.uint8(_LOW_NOISE if chance < beam.low_noise else 1)
                lean = 0.0
            elif chance > 1.0 - beam.high_noise:
                zs[0], energies[0], kinds[0], found = zg + 40.0 + 110.0 * unit(h), 0.1, _HIGH_NOISE, 1
                delivered = np.uint8(_HIGH_NOISE)
                lean = 0.0
            else:
                surface, kind = zg, np.uint8(_GROUND)
                roof = _house_top(x, y, zg, lean, w)
                if roof > zg:
                    surface, kind = roof, np.uint8(_BUILDING)
                else:
                    rock = _boulder_top(x, y, w)
                    if rock > zg + 0.15:
                        surface, kind = rock, np.uint8(_OTHER)
                    elif wet:
                        kind, delivered = np.uint8(_WATER), np.uint8(_WATER)
                crowns = _crowns(x, y, zg, lean, 0.7 + 0.6 * unit(h), beam, w, spans)
                found, energy, h = _through_leaves(crowns, surface, h, spans, zs, energies)
                for k in range(found):
                    above = zs[k] - zg
                    kinds[k] = 5 if above > 2.0 else (4 if above > 0.5 else 3)
                h = following(h)
                seen = energy > _LEAST_ENERGY and (found == 0 or zs[found - 1] - surface > _DEAD_ZONE)
                if kind == _WATER:
                    seen = seen and unit(h) < beam.water_returns
                elif kind == _GROUND and unit(h) < beam.grass:
                    h = following(h)
                    surface, kind = zg + 0.1 + 0.4 * unit(h) * unit(h), np.uint8(3)
                if seen:
                    h = following(h)
                    zs[found], energies[found], kinds[found] = surface + beam.sigma * bell(h), energy, kind
                    found += 1
            if found == 0:
                continue
            # Time from rows flown and columns swept; unique per pulse, growing in the order of this loop.
            time = (
                strip * beam.strip_period
                + (j + 0.9 * step_share(i, j, column, beam.columns)) * beam.spacing / beam.speed
            )
            for k in range(found):
                h = following(h)
                qx = px + np.int64(np.floor(lean * (zs[k] - zg) * 1000.0 + 0.5)) if kinds[k] != _GROUND else px
                if qx < x0 or qx >= x1:
                    continue
                bright = 180.0 if kinds[k] == _GROUND else (260.0 if kinds[k] == _BUILDING else 140.0)
                out.x[n], out.y[n], out.z[n] = qx, py, np.int32(np.floor(zs[k] * 1000.0 + 0.5))
                out.return_number[n], out.number_of_returns[n] = k + 1, found
                out.classification[n] = kinds[k]
                out.delivered[n] = delivered if (kinds[k] != 5 and kinds[k] != 4 and kinds[k] != 3) else 1
                out.intensity[n] = np.uint16(max(1.0, bright * energies[k] * (1.0 + 0.15 * bell(h))))
                out.gps_time[n] = time
                out.scan_angle[n] = np.int16(np.floor(lean * 57.29577951308232 / 0.006 + 0.5))
                out.point_source_id[n] = np.uint16(1 + strip % 65535)
                n += 1
    return n


@njit(nogil=True, cache=True)
def step_share(i: int, j: int, column: int, columns: int) -> float:
    """Return how far the sweep has come at a column, 0 to 1."""
    return (column if j % 2 == 0 else columns - 1 - column) / columns
