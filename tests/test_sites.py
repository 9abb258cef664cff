"""Site statistics against plain loops over points and pixels."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask import sites
from ppdf_dask.errors import ParameterError
from ppdf_dask.experiments.rasters import read_raster, write_raster
from ppdf_dask.grid import MM, Rect
from ppdf_dask.metrics import tin_heights

coordinate = st.integers(-30_000, 30_000)
clouds = st.lists(st.tuples(coordinate, coordinate, st.integers(-5_000, 20_000)), min_size=1, max_size=80)


@given(clouds)
@settings(max_examples=40, deadline=None)
def test_slopes_are_those_of_least_squares_planes(points):
    ground = np.array(points, np.int64)
    found = sites.slopes(ground)
    for i, point in enumerate(ground):
        d = np.hypot(*(ground[:, :2] - point[:2]).T.astype(float))
        order = np.argsort(d, kind="stable")
        if len(ground) > 10 and d[order[9]] == d[order[10]]:
            continue  # which of two equally near points counts is not defined
        near = (ground[order[:10]] - point) / MM
        a = np.column_stack([near[:, :2], np.ones(len(near))])
        spread = np.linalg.svd(near[:, :2] - near[:, :2].mean(axis=0), compute_uv=False)
        if len(near) < 3 or spread[1] == 0:
            assert np.isnan(found[i])
        elif spread[1] > 0.01 * spread[0]:  # else the plane is all but a line, and two solvers may differ
            plane = np.linalg.lstsq(a, near[:, 2], rcond=None)[0]
            assert found[i] == pytest.approx(math.degrees(math.atan(math.hypot(plane[0], plane[1]))), abs=1e-6)


def test_two_points_and_points_on_a_line_have_no_slope():
    assert np.isnan(sites.slopes(np.array([[0, 0, 0], [1000, 0, 500]]))).all()
    line = np.column_stack([np.arange(12) * 700, np.arange(12) * 700, np.arange(12) ** 2])
    assert np.isnan(sites.slopes(line)).all()
    assert sites.slopes(np.empty((0, 3), np.int64)).shape == (0,)


@given(clouds)
@settings(max_examples=40, deadline=None)
def test_canopy_model_and_cell_means_pixel_by_pixel(points):
    cloud = np.array(points, np.int64)
    rect = sites.bounds(cloud).snap(sites.CELL)
    rng = np.random.default_rng(len(cloud))
    dtm = rng.normal(0.0, 3.0, (rect.height // MM, rect.width // MM)).astype(np.float32)
    dtm[rng.random(dtm.shape) < 0.2] = np.nan
    chm = sites.canopy_model(cloud, dtm, rect)
    values = rng.normal(size=len(cloud))
    values[::7] = np.nan
    means = sites.cell_mean(cloud, values, rect, sites.SLOPE_CELL)
    highest, sums = {}, {}
    for (x, y, z), value in zip(cloud.tolist(), values.tolist(), strict=True):
        pixel = (rect.y1 - 1 - y) // MM, (x - rect.x0) // MM
        highest[pixel] = max(highest.get(pixel, -math.inf), z / MM)
        if not math.isnan(value):
            sums.setdefault(((rect.y1 - 1 - y) // sites.SLOPE_CELL, (x - rect.x0) // sites.SLOPE_CELL), []).append(
                value
            )
    assert {tuple(p) for p in np.argwhere(np.isfinite(chm)).tolist()} == {p for p in highest if np.isfinite(dtm[p])}
    for pixel, top in highest.items():
        if np.isfinite(dtm[pixel]):
            # float32 keeps 24 bits of a height below 32 m
            assert chm[pixel] == pytest.approx(max(0.0, top - float(dtm[pixel])), abs=4e-6)
    assert {tuple(p) for p in np.argwhere(np.isfinite(means)).tolist()} == set(sums)
    assert all(means[p] == pytest.approx(sum(v) / len(v), rel=1e-6, abs=1e-6) for p, v in sums.items())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_cover_counts_valid_pixels_only(seed):
    rng = np.random.default_rng(seed)
    chm = rng.choice([0.0, 2.0, 2.5, 9.0, np.nan], (8, 12), p=[0.3, 0.1, 0.1, 0.1, 0.4]).astype(np.float32)
    found = sites.cover(chm, 2)
    for r in range(4):
        for c in range(6):
            cell = [v for v in chm[2 * r : 2 * r + 2, 2 * c : 2 * c + 2].ravel().tolist() if not math.isnan(v)]
            share = sum(v > 2.0 for v in cell) / len(cell) if cell else math.nan
            assert found[r, c] == pytest.approx(share, nan_ok=True)


def test_terrain_is_the_triangulation_over_a_block_edge_and_at_map_coordinates():
    rng = np.random.default_rng(3)
    # x = 512 m and its multiples are edges of terrain blocks
    x0, y0 = 512_000 * 900 - 20_000, 4_400_000_000
    ground = np.column_stack([*rng.integers(0, 40_000, (2, 400)), rng.integers(0, 9_000, 400)]) + np.array([x0, y0, 0])
    rect = sites.bounds(ground).snap(sites.CELL)
    dtm = sites.terrain(ground, rect)
    assert dtm.shape == (rect.height // MM, rect.width // MM)
    rows, columns = np.nonzero(np.isfinite(dtm))
    assert len(rows) > 1000
    centres = np.column_stack([rect.x0 / MM + columns + 0.5, rect.y1 / MM - rows - 0.5])
    # Qhull joggles nothing here: both interpolate the same triangles, float32 keeps 24 bits of a height below 16 m
    assert dtm[rows, columns] == pytest.approx(tin_heights(ground / MM, centres), abs=2e-6)
    with pytest.raises(ParameterError, match="multiples"):
        sites.terrain(ground, Rect(rect.x0 + 1, rect.y0, rect.x1 + 1, rect.y1))
    assert np.isnan(sites.terrain(np.empty((0, 3), np.int64), rect)).all()


def test_statistics_of_a_known_site():
    x, y = (v.ravel() * 500 + 250 for v in np.mgrid[0:40, 0:40])
    terrain = np.column_stack([x, y, x // 4]) + np.array([-7_000_000, 5_000, 0])
    crowns = terrain[(x > 10_000)] + [0, 0, 12_000]
    cloud = np.vstack([terrain, crowns])
    found = sites.statistics(cloud, np.arange(len(cloud)) < 1600)
    assert found.rect == Rect(-7_000_000, 0, -6_980_000, 30_000)  # widened to multiples of 10 m
    numbers = found.as_dict()
    assert (numbers["points"], numbers["ground"]) == (2400, 1600)
    assert numbers["density"] == 6.0  # 2400 points in 16 cells of 25 m2
    assert numbers["slope_deg"] == pytest.approx(math.degrees(math.atan(0.25)), abs=1e-3)
    # half of each row of cells is covered, and the cells beyond the points count for nothing
    assert numbers["cover"] == pytest.approx(0.5)
    # the highest point of a pixel lies 0.25 m east of its centre, at 1 in 4
    assert numbers["canopy_height_m"] == pytest.approx(12.0625, abs=1e-3)
    assert found.cover.tolist()[0][0] == pytest.approx(0.0)
    with pytest.raises(ParameterError, match="ground mask"):
        sites.statistics(cloud, np.ones(3, bool))


def test_rasters_keep_place_and_gaps(tmp_path: Path):
    values = np.array([[1.5, np.nan], [2.5, 3.5], [4.5, 5.5]], np.float32)
    write_raster(tmp_path / "a" / "b.tif", values, Rect(10_000, -6_000, 14_000, 0), 2000)
    assert np.array_equal(read_raster(tmp_path / "a" / "b.tif"), values, equal_nan=True)
    with rasterio.open(tmp_path / "a" / "b.tif") as source:
        assert tuple(source.bounds) == (10.0, -6.0, 14.0, 0.0)
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b.tif"]
