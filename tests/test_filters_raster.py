"""Rasters, gap filling, morphology and islands against plain-Python definitions."""

from __future__ import annotations

import numpy as np
import pytest
from classic_clouds import cells, cloud_of, extreme, fill, nasty, points
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import islands as islands_module
from ppdf_dask.filters import raster as raster_module
from ppdf_dask.filters.islands import by_island, islands
from ppdf_dask.filters.raster import EMPTY, dilated, eroded, filled, lowest, rasterize


def grids(most=9):
    heights = st.one_of(st.none(), st.integers(-3, 3))
    return st.integers(1, most).flatmap(
        lambda columns: st.lists(st.lists(heights, min_size=columns, max_size=columns), min_size=1, max_size=most)
    )


def as_array(grid):
    return np.array([[np.nan if v is None else v for v in row] for row in grid], float)


def as_dict(array):
    return {(c, r): v for (r, c), v in np.ndenumerate(array) if not np.isnan(v)}


@given(points(), st.sampled_from([0.25, 1.0, 1.7]))
@settings(deadline=None, max_examples=40)
def test_cells_are_absolute_and_hold_the_lowest(pts, size):
    if not pts:
        return
    cloud = cloud_of(pts)
    raster = rasterize(cloud, size)
    low = lowest(raster, cloud.z)
    expected, box = cells(pts, round(size * 1000))
    assert (raster.column, raster.row) == (box[0], box[2])
    assert raster.shape == (box[3] - box[2] + 1, box[1] - box[0] + 1)
    found = {(c + box[0], r + box[2]): int(z) for (r, c), z in np.ndenumerate(low) if z != EMPTY}
    assert found == expected


@given(grids(), st.sampled_from([1, 3, 8]), st.sampled_from([0, 2, 12]))
@settings(deadline=None, max_examples=80)
def test_gaps_take_the_mean_of_the_nearest(grid, wanted, nearby):
    array = as_array(grid)
    if np.isnan(array).all():
        return
    # Small look-up radii drive the search by rows that wide gaps need.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raster_module, "NEARBY", nearby)
        raster_module._nearby.cache_clear()
        got = filled(array, wanted)
    raster_module._nearby.cache_clear()
    rows, columns = array.shape
    expected = fill(as_dict(array), (0, columns - 1, 0, rows - 1), wanted)
    for (c, r), z in expected.items():
        assert got[r, c] == pytest.approx(z, abs=1e-12)


@given(grids(), st.integers(0, 4))
@settings(deadline=None, max_examples=40)
def test_diamonds(grid, radius):
    array = np.nan_to_num(as_array(grid))
    for ours, pick in ((eroded, min), (dilated, max)):
        expected = extreme(as_dict(array), radius, "diamond", pick)
        assert as_dict(ours(array, radius)) == expected


@given(points(extent=60_000, most=25), st.sampled_from([2_000, 5_000, 100_000]))
@settings(deadline=None, max_examples=60)
def test_islands_are_blocks_that_touch(pts, block):
    number = islands(cloud_of(pts), block)
    blocks = [(x // block, y // block) for x, y, _ in pts]
    group = {b: {b} for b in blocks}
    for a in blocks:
        for b in blocks:
            if max(abs(a[0] - b[0]), abs(a[1] - b[1])) <= 1 and group[a] is not group[b]:
                group[a] |= group[b]
                for member in group[a]:
                    group[member] = group[a]
    for i, a in enumerate(blocks):
        for j, b in enumerate(blocks):
            assert (number[i] == number[j]) == (group[a] is group[b])


def test_each_island_is_labelled_once_core_points_only(monkeypatch):
    monkeypatch.setattr(islands_module, "BLOCK", 1000)
    here = [(0, 0, 0), (100, 0, 1), (0, 100, 2)]
    there = [(90_000 + x, y, z + 10) for x, y, z in here]
    few = [(500_000, 0, 5), (500_000, 0, 5), (500_100, 0, 5)]
    pts = [here[0], there[0], few[0], here[1], *few[1:], *here[2:], *there[1:]]
    cloud = cloud_of(pts, n_core=4)
    seen = []

    def label(island):
        seen.append(sorted(island.z.tolist()))
        return island.z[: island.n_core] != 0

    verdict = by_island(cloud, 0.5, label)
    assert sorted(seen) == [[0, 1, 2], [10, 11, 12]]
    assert verdict.ground.tolist() == [False, True, False, True]
    assert not verdict.unproven.any()


def test_too_large_a_raster_is_refused_with_a_remedy():
    cloud = cloud_of([(0, 0, 0), (100_000_000, 100_000_000, 0)])
    with pytest.raises(ParameterError, match=r"100001 x 100001 cells of 1.0 m .* larger cell"):
        rasterize(cloud, 1.0)


@pytest.mark.parametrize("name", nasty())
def test_islands_of_nasty_clouds(name):
    pts = nasty()[name]
    number = islands(cloud_of(pts), 250_000)
    assert number.shape == (len(pts),)
    assert len(set(number.tolist())) == min(len(pts), 2 if "stray" in name else 1)
