"""Rasters derived from the terrain model: slope and hillshade, on plain arrays with north up.

Both use the weighted differences of Horn over 3 x 3 pixels (Horn, "Hill shading and the reflectance map", Proc. IEEE
69, 1981), as GDAL does. A pixel with a NaN among its eight neighbours, or on the array's rim, is NaN: nothing is
invented. A tile computed with a rim of one pixel therefore equals the same part of the whole.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppdf_dask.errors import ParameterError


def gradient(height: NDArray[Any], resolution: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rise to the east and to the north after Horn.

    Parameters
    ----------
    height : ndarray, (rows, columns)
        Heights, north up, NaN where unknown.
    resolution : float
        Pixel size in the unit of the heights.

    Returns
    -------
    east, north : ndarray of float64
        Tangents, NaN where a neighbour is NaN or missing.

    Raises
    ------
    ParameterError
        If the array is not two-dimensional or the pixel size is not positive.

    Examples
    --------
    >>> z = np.array([[2.0, 3.0, 4.0], [1.0, 2.0, 3.0], [0.0, 1.0, 2.0]])
    >>> east, north = gradient(z, 2.0)
    >>> float(east[1, 1]), float(north[1, 1]), float(east[0, 0])
    (0.5, 0.5, nan)
    """
    if height.ndim != 2:
        raise ParameterError(f"heights must be a raster of rows and columns, not an array of shape {height.shape}")
    if not resolution > 0:
        raise ParameterError(f"resolution = {resolution} must be a positive pixel size")
    z = np.pad(np.asarray(height, dtype=np.float64), 1, constant_values=np.nan)
    nw, n, ne = z[:-2, :-2], z[:-2, 1:-1], z[:-2, 2:]
    w, centre, e = z[1:-1, :-2], z[1:-1, 1:-1], z[1:-1, 2:]
    sw, s, se = z[2:, :-2], z[2:, 1:-1], z[2:, 2:]
    east = ((ne + 2 * e + se) - (nw + 2 * w + sw)) / (8 * resolution)
    north = ((nw + 2 * n + ne) - (sw + 2 * s + se)) / (8 * resolution)
    unknown = np.isnan(centre) | np.isnan(east) | np.isnan(north)
    east[unknown] = north[unknown] = np.nan
    return east, north


def slope(height: NDArray[Any], resolution: float) -> NDArray[np.float32]:
    """Return the slope in degrees.

    Parameters
    ----------
    height : ndarray, (rows, columns)
        Heights, north up, NaN where unknown.
    resolution : float
        Pixel size in the unit of the heights.

    Returns
    -------
    ndarray of float32
        0 (level) to 90, NaN where a neighbour is unknown.

    Examples
    --------
    >>> z = np.tile(np.arange(3.0), (3, 1))
    >>> round(float(slope(z, 1.0)[1, 1]), 3)
    45.0
    """
    east, north = gradient(height, resolution)
    return np.degrees(np.arctan(np.hypot(east, north))).astype(np.float32)


def hillshade(
    height: NDArray[Any],
    resolution: float,
    *,
    azimuth: float = 315.0,
    altitude: float = 45.0,
    exaggeration: float = 1.0,
) -> NDArray[np.float32]:
    """Return how brightly a distant sun lights each pixel of a matt surface.

    Parameters
    ----------
    height : ndarray, (rows, columns)
        Heights, north up, NaN where unknown.
    resolution : float
        Pixel size in the unit of the heights.
    azimuth, altitude : float
        Direction to the sun, degrees: clockwise from north, above the horizon. The default, north-west at 45 degrees,
        is the convention of maps.
    exaggeration : float
        Factor on the heights; above 1 for flat country.

    Returns
    -------
    ndarray of float32
        0 (in its own shade) to 1 (facing the sun), NaN where a neighbour is unknown.

    Examples
    --------
    >>> round(float(hillshade(np.zeros((3, 3)), 1.0, altitude=30.0)[1, 1]), 3)
    0.5
    """
    east, north = gradient(np.asarray(height, dtype=np.float64) * exaggeration, resolution)
    a, h = np.radians(azimuth), np.radians(altitude)
    light = np.sin(h) - np.cos(h) * (np.sin(a) * east + np.cos(a) * north)
    shade: NDArray[np.float64] = np.maximum(light / np.sqrt(1 + east * east + north * north), 0)
    return shade.astype(np.float32)
