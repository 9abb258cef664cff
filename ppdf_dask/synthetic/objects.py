"""What stands on the terrain: trees, shrubs, boulders and houses, each placed by its own cell of an absolute lattice.

A cell holds at most one object, so that any window of the lattice can be made alone and neighbouring windows agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ppdf_dask.synthetic._noise import bell, cell_hash, following, noise, unit
from ppdf_dask.synthetic.params import SyntheticParams
from ppdf_dask.synthetic.terrain import Relief, height, relief

HOUSE_CELL = 44.0
SHRUB_CELL = 3.0
BOULDER_CELL = 9.0
TALLEST_HOUSE = 11.0
_TREE, _SHRUB, _BOULDER, _HOUSE = (np.uint64(0x1000 * k) for k in (1, 2, 3, 4))


class Cover(NamedTuple):
    """Vegetation and buildings as the kernels take them."""

    tree_cell: float
    tree_height: float
    radius_share: float
    tree_bias: float
    conifers: float
    shrubs: float
    boulders: float
    houses: float


class Window(NamedTuple):
    """The lattices of one window: ``cells[j - j0, i - i0]`` belongs to the cell with column `i` and row `j`.

    Trees and shrubs: x, y, foot height, height (0 for none), radius, 1 for conifer. Boulders: x, y, foot height,
    height, radius. Houses: x, y, cosine, sine, half length, half width, eave height, ridge's rise, foot height; a half
    length of 0 for none.
    """

    trees: NDArray[np.float64]
    tree_i0: int
    tree_j0: int
    shrubs: NDArray[np.float64]
    shrub_i0: int
    shrub_j0: int
    boulders: NDArray[np.float64]
    boulder_i0: int
    boulder_j0: int
    houses: NDArray[np.float64]
    house_i0: int
    house_j0: int


@dataclass(frozen=True)
class _Lattice:
    i0: int
    j0: int
    columns: int
    rows: int

    @classmethod
    def over(cls, rect: tuple[float, float, float, float], cell: float, reach: float) -> _Lattice:
        i0, j0 = math.floor((rect[0] - reach) / cell), math.floor((rect[1] - reach) / cell)
        i1, j1 = math.floor((rect[2] + reach) / cell), math.floor((rect[3] + reach) / cell)
        return cls(i0, j0, i1 - i0 + 1, j1 - j0 + 1)


def cover(params: SyntheticParams) -> Cover:
    """Work out the kernels' constants."""
    share = 0.19
    # Forest stands where a field of standard deviation 0.11 exceeds the quantile of the cover asked for; the trees of
    # a stand leave some of it open, hence a little more.
    wanted = min(0.999, max(0.001, 1.15 * params.canopy_cover))
    bias = round(0.11 * NormalDist().inv_cdf(wanted), 9) if params.canopy_cover > 0 else -math.inf
    return Cover(
        tree_cell=round(1.15 * share * params.canopy_height, 6),
        tree_height=params.canopy_height,
        radius_share=share,
        tree_bias=bias,
        conifers=params.conifer_share,
        shrubs=params.shrub_share,
        boulders=params.boulder_share,
        houses=params.house_share,
    )


def tallest(params: SyntheticParams) -> float:
    """Return the height above its foot that nothing exceeds, m: 1.4 times the mean tree, or a house on a slope."""
    return max(1.4 * params.canopy_height, TALLEST_HOUSE + 3.0)


def window(rect: tuple[float, float, float, float], params: SyntheticParams) -> Window:
    """Place the objects that pulses with their foot inside `rect` (x0, y0, x1, y1 in metres) can meet."""
    r, c = relief(params), cover(params)
    crown = 1.4 * c.tree_height * c.radius_share * 1.2
    lean = 0.2 * tallest(params) + 1.0
    t = _Lattice.over(rect, c.tree_cell, crown + lean)
    s = _Lattice.over(rect, SHRUB_CELL, 4.0)
    b = _Lattice.over(rect, BOULDER_CELL, BOULDER_CELL)
    h = _Lattice.over(rect, HOUSE_CELL, HOUSE_CELL + crown + lean)
    houses = np.zeros((h.rows, h.columns, 9))
    _place_houses(houses, h.i0, h.j0, r, c)
    trees = np.zeros((t.rows, t.columns, 6))
    _place_trees(trees, t.i0, t.j0, r, c, houses, h.i0, h.j0)
    shrubs = np.zeros((s.rows, s.columns, 6))
    _place_small(shrubs, s.i0, s.j0, SHRUB_CELL, _SHRUB, c.shrubs, r)
    boulders = np.zeros((b.rows, b.columns, 6))
    _place_small(boulders, b.i0, b.j0, BOULDER_CELL, _BOULDER, c.boulders, r)
    return Window(trees, t.i0, t.j0, shrubs, s.i0, s.j0, boulders, b.i0, b.j0, houses, h.i0, h.j0)


@njit(nogil=True, cache=True)
def forest(x: float, y: float, r: Relief) -> float:
    """Return the field that decides where forest stands: mean 0, standard deviation about 0.11."""
    wide = noise(x / 83.0, y / 83.0, r.salt + np.uint64(20))
    return wide + 0.5 * noise(x / 23.0, y / 23.0, r.salt + np.uint64(21))


@njit(nogil=True, cache=True)
def _place_houses(out: NDArray[np.float64], i0: int, j0: int, r: Relief, c: Cover) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            h = cell_hash(i0 + column, j0 + row, r.salt + _HOUSE)
            if unit(h) >= c.houses:
                continue
            house = out[row, column]
            h = following(h)
            house[0] = (i0 + column + 0.4 + 0.2 * unit(h)) * HOUSE_CELL
            h = following(h)
            house[1] = (j0 + row + 0.4 + 0.2 * unit(h)) * HOUSE_CELL
            h = following(h)
            t = unit(h) * 2.0 - 1.0
            house[2], house[3] = (1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t)
            h = following(h)
            half, across = 5.0 + 5.0 * unit(h), 0.0
            h = following(h)
            across = 3.5 + 2.5 * unit(h)
            h = following(h)
            house[6] = 3.0 + 3.5 * unit(h)
            h = following(h)
            house[7] = 0.0 if unit(h) < 0.25 else across * (0.5 + 0.4 * unit(following(h)))
            low, high, wet = 1e9, -1e9, False
            for k in range(9):
                u, v = (k % 3 - 1) * half, (k // 3 - 1) * across
                z, w = height(house[0] + u * house[2] - v * house[3], house[1] + u * house[3] + v * house[2], r)
                low, high, wet = min(low, z), max(high, z), wet or w
            if wet or high - low > 3.0:
                continue
            house[4], house[5], house[8] = half, across, high


@njit(nogil=True, cache=True)
def _near_house(x: float, y: float, gap: float, houses: NDArray[np.float64], i0: int, j0: int) -> bool:
    row, column = int(np.floor(y / HOUSE_CELL)) - j0, int(np.floor(x / HOUSE_CELL)) - i0
    house = houses[row, column]
    if house[4] == 0.0:
        return False
    dx, dy = x - house[0], y - house[1]
    u, v = dx * house[2] + dy * house[3], dy * house[2] - dx * house[3]
    return bool(abs(u) < house[4] + gap and abs(v) < house[5] + gap)


@njit(nogil=True, cache=True)
def _place_trees(
    out: NDArray[np.float64],
    i0: int,
    j0: int,
    r: Relief,
    c: Cover,
    houses: NDArray[np.float64],
    house_i0: int,
    house_j0: int,
) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            h = cell_hash(i0 + column, j0 + row, r.salt + _TREE)
            x = (i0 + column + 0.1 + 0.8 * unit(h)) * c.tree_cell
            h = following(h)
            y = (j0 + row + 0.1 + 0.8 * unit(h)) * c.tree_cell
            density = 0.5 + 25.0 * (forest(x, y, r) + c.tree_bias)
            h = following(h)
            # A few trees stand alone in the open.
            if unit(h) >= max(0.01 if c.tree_bias > -1.0 else 0.0, density):
                continue
            z, wet = height(x, y, r)
            if wet or _near_house(x, y, 2.0 + 0.12 * c.tree_height, houses, house_i0, house_j0):
                continue
            tree = out[row, column]
            h = following(h)
            # Stands differ in age; a sixth of the trees has been overtaken by its neighbours.
            age = 1.0 + 0.8 * noise(x / 61.0, y / 61.0, r.salt + np.uint64(22))
            share = age * (1.0 + 0.13 * bell(h))
            h = following(h)
            if unit(h) < 0.16:
                share *= 0.55
            share = min(1.4, max(0.2, share))
            h = following(h)
            tree[0], tree[1], tree[2], tree[3] = x, y, z, share * c.tree_height
            conifer = unit(h) + 2.0 * noise(x / 47.0, y / 47.0, r.salt + np.uint64(23)) < c.conifers
            h = following(h)
            tree[4] = tree[3] * c.radius_share * (0.8 + 0.4 * unit(h))
            tree[5] = 1.0 if conifer else 0.0


@njit(nogil=True, cache=True)
def _place_small(
    out: NDArray[np.float64], i0: int, j0: int, cell: float, salt: np.uint64, share: float, r: Relief
) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            h = cell_hash(i0 + column, j0 + row, r.salt + salt)
            if unit(h) >= share:
                continue
            h = following(h)
            x = (i0 + column + unit(h)) * cell
            h = following(h)
            y = (j0 + row + unit(h)) * cell
            z, wet = height(x, y, r)
            if wet:
                continue
            h = following(h)
            size = unit(h)
            thing = out[row, column]
            thing[0], thing[1], thing[2] = x, y, z
            thing[3] = 0.5 + 2.5 * size * size
            thing[4] = thing[3] * (0.5 + 0.4 * unit(following(h)))
