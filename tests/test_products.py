import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.errors import ParameterError
from ppdf_dask.products import gradient, hillshade, slope


def plane(east, north, resolution=2.0, shape=(7, 9)):
    row, col = np.indices(shape)
    return resolution * (east * col - north * row)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 360), st.floats(1, 89))
@settings(max_examples=50)
def test_a_plane_has_its_slope_and_its_light(east, north, azimuth, altitude):
    z = plane(east, north)
    inner = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(slope(z, 2.0)[inner], math.degrees(math.atan(math.hypot(east, north))), atol=1e-5)
    a, h = math.radians(azimuth), math.radians(altitude)
    sun = np.array([math.cos(h) * math.sin(a), math.cos(h) * math.cos(a), math.sin(h)])
    normal = np.array([-east, -north, 1]) / math.sqrt(east**2 + north**2 + 1)
    got = hillshade(z, 2.0, azimuth=azimuth, altitude=altitude)[inner]
    # float32 keeps 6e-8 of 1.
    np.testing.assert_allclose(got, max(0.0, float(sun @ normal)), atol=1e-7)


def test_the_weights_are_horns():
    """Unit impulse: one neighbour raised by 8 changes the differences by 1 or 2, and by none where it is level."""
    weights = {(0, 0): (-1, 1), (0, 1): (0, 2), (0, 2): (1, 1), (1, 0): (-2, 0), (1, 2): (2, 0)}
    weights |= {(2, 0): (-1, -1), (2, 1): (0, -2), (2, 2): (1, -1), (1, 1): (0, 0)}
    for place, (east, north) in weights.items():
        z = np.zeros((3, 3))
        z[place] = 8
        got = gradient(z, 1.0)
        assert (got[0][1, 1], got[1][1, 1]) == (east, north)


def test_nothing_is_invented_beside_a_hole_or_the_rim():
    z = plane(0.1, 0.2)
    z[3, 4] = np.nan
    hole = np.ones(z.shape, bool)
    hole[1:-1, 1:-1] = False
    hole[2:5, 3:6] = True
    for product in (slope, hillshade):
        np.testing.assert_array_equal(np.isnan(product(z, 2.0)), hole)
        assert np.isnan(product(z[:2], 2.0)).all()
        assert product(np.zeros((0, 5)), 1.0).shape == (0, 5)


def test_a_tile_with_a_rim_equals_the_part_of_the_whole():
    z = np.random.default_rng(0).normal(size=(40, 50)).astype(np.float32)
    np.testing.assert_array_equal(hillshade(z, 0.5)[11:20, 21:30], hillshade(z[10:21, 20:31], 0.5)[1:-1, 1:-1])


def test_exaggeration_acts_on_heights():
    z = plane(0.1, 0.2)
    np.testing.assert_array_equal(hillshade(z, 2.0, exaggeration=4), hillshade(4 * z, 2.0))


def test_what_is_no_raster_is_refused():
    with pytest.raises(ParameterError, match=r"shape \(5,\)"):
        slope(np.zeros(5), 1.0)
    with pytest.raises(ParameterError, match="resolution = 0"):
        slope(np.zeros((5, 5)), 0.0)
