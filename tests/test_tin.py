"""Heights between nodes: against SciPy in general position, by hand where Qhull is lost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import KDTree

from ppdf_dask._tin import interpolate
from ppdf_dask.metrics import tin_heights, tin_rmse


@given(st.integers(0, 2**32 - 1), st.integers(3, 80), st.sampled_from([(0.0, 0.0), (612_345.5, 5_400_000.25)]))
@settings(max_examples=40, deadline=None)
def test_agrees_with_qhull_in_general_position(seed: int, n: int, origin: tuple[float, float]) -> None:
    rng = np.random.default_rng(seed)
    nodes = np.column_stack([rng.integers(0, 50_000, (n, 2)) / 1000 + origin, rng.normal(0, 5, n)])
    asked = rng.integers(-5_000, 55_000, (60, 2)) / 1000 + origin
    expected = LinearNDInterpolator(nodes[:, :2] - origin, nodes[:, 2])(asked - origin)
    got = interpolate(nodes, asked)
    # Of the hull only slivers may be missing: 50 m squared over 536 km is 5 mm.
    shrunk = LinearNDInterpolator(nodes[:, :2] - origin, nodes[:, 2])
    deep = np.all([~np.isnan(shrunk(asked - origin + s)) for s in np.eye(2).tolist()], axis=0)
    deep &= np.all([~np.isnan(shrunk(asked - origin - s)) for s in np.eye(2).tolist()], axis=0)
    assert not np.isnan(got[deep]).any()
    assert np.isnan(got[np.isnan(expected)]).all()
    both = ~np.isnan(got)
    # Both interpolate in the same triangles with coordinates of 1 mm: only float noise is left.
    np.testing.assert_allclose(got[both], expected[both], atol=1e-6)


def test_a_plane_on_a_grid_is_met_exactly_up_to_the_hulls_edge() -> None:
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.0, 30), np.arange(0.0, 20)))
    nodes = np.column_stack([x, y, 3 * x - 2 * y])
    at = np.array([(0.0, 0.0), (29.0, 19.0), (29.0, 0.5), (0.5, 0.0), (14.5, 7.25), (10.0, 19.0)])
    np.testing.assert_allclose(interpolate(nodes, at), 3 * at[:, 0] - 2 * at[:, 1], atol=1e-12)
    assert np.isnan(interpolate(nodes, np.array([(29.001, 5.0), (-0.001, 5.0), (1e6, 1e6)]))).all()


def test_of_points_at_one_place_the_lowest_counts() -> None:
    square = [(0, 0, 7.0), (4, 0, 1.0), (0, 4, 1.0), (4, 4, 1.0), (0, 0, 1.0)]
    assert interpolate(np.array(square, float), np.array([(0.5, 0.5)])).tolist() == [1.0]


@pytest.mark.parametrize("count", [1, 2, 3, 40])
def test_points_on_a_line_have_no_inside_and_the_nearest_gives_the_height(count: int) -> None:
    line = np.column_stack([np.arange(count) * 2.0, np.arange(count) * 2.0, np.arange(count) * 1.0])
    asked = np.array([(0.4, 0.2), (100.0, 100.0)])
    assert np.isnan(interpolate(line, asked)).all()
    nearest = KDTree(line[:, :2]).query(asked)[1]
    assert tin_heights(line, asked).tolist() == line[nearest, 2].tolist()


def test_far_apart_points_share_one_grid() -> None:
    far = np.array([(0, 0, 0.0), (2e6, 0, 2.0), (0, 2e6, 0.0), (2e6, 2e6, 2.0)])
    # The grid is 2000 km / 60 M steps = 33 mm wide.
    assert interpolate(far, np.array([(5e5, 1e6)]))[0] == pytest.approx(0.5, abs=1e-6)


def test_rmse_is_that_of_the_heights() -> None:
    ground = np.array([(0, 0, 0.0), (10, 0, 0.0), (0, 10, 0.0), (10, 10, 0.0)])
    assert tin_rmse(ground, [(5.0, 5.0, 3.0), (2.0, 3.0, -4.0)]) == pytest.approx((25 / 2) ** 0.5)
