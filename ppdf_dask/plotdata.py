"""What pictures are drawn from, read in bounded memory: a raster no finer than the picture, the points of a strip."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppdf_dask.errors import ParameterError

Line = Sequence[Sequence[float]]
"""Two points, ``((x0, y0), (x1, y1))``, in the CRS's units."""

PIXELS = 1500
"""Most pixels of a picture's edge."""

_BATCH = 1_000_000


def section_points(
    tiles: Iterable[Path], line: Line, width: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8]]:
    """Read the points of LAS or LAZ files within a strip around a line.

    Parameters
    ----------
    tiles : iterable of Path
        The files; one whose header bounds miss the strip is not read.
    line : sequence of two (x, y)
        From where to where, in the files' units.
    width : float
        Full width of the strip.

    Returns
    -------
    along, z : ndarray of float64, shape (n,)
        Distance from the line's start, and height.
    classes : ndarray of uint8, shape (n,)
        As stored.

    Raises
    ------
    ParameterError
        If the line has no length or the width is not positive.
    """
    (x0, y0), (x1, y1) = line
    length = float(np.hypot(x1 - x0, y1 - y0))
    if not length > 0 or not width > 0:
        raise ParameterError(f"a section needs a line with a length and a positive width, not {line} and {width}")
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    box = (min(x0, x1) - width, min(y0, y1) - width, max(x0, x1) + width, max(y0, y1) + width)
    found: list[NDArray[Any]] = [np.empty((3, 0))]
    for x, y, z, classes in _batches(tiles, box):
        dx, dy = x - x0, y - y0
        along, across = dx * ux + dy * uy, dy * ux - dx * uy
        near = (np.abs(across) <= width / 2) & (along >= 0) & (along <= length)
        found.append(np.stack([along[near], z[near], classes[near]]))
    every = np.concatenate(found, axis=1)
    return every[0], every[1], every[2].astype(np.uint8)


def unit_metres(unit: str) -> float:
    """Return the metres of a unit as it stands in the terrain model.

    Parameters
    ----------
    unit : str
        ``m``, ``ft``, ``US_survey_foot``, or a number of metres such as ``0.5 m``.

    Examples
    --------
    >>> unit_metres("ft"), unit_metres("0.5 m")
    (0.3048, 0.5)
    """
    named = {"": 1.0, "m": 1.0, "ft": 0.3048, "US_survey_foot": 1200 / 3937}
    return named[unit] if unit in named else float(unit.removesuffix(" m"))


def read_raster(
    path: Path, area: tuple[float, float, float, float] | None
) -> tuple[NDArray[np.float32], tuple[float, float, float, float], float, str]:
    """Read a terrain model, or a part of it, from the overviews where it is large.

    Parameters
    ----------
    path : Path
        The GeoTIFF.
    area : tuple of float or None
        ``(x0, y0, x1, y1)`` in the CRS's units; None: all of it.

    Returns
    -------
    height : ndarray of float32, (rows, columns)
        At most `PIXELS` along an edge.
    extent : tuple of float
        ``(x0, x1, y0, y1)`` of its outer edges.
    step : float
        Stored pixels per pixel returned.
    unit : str
        Of the heights.

    Raises
    ------
    ParameterError
        If the area does not meet the raster.
    """
    import rasterio
    from rasterio.windows import Window

    with rasterio.open(path) as source:
        left, top, dx, dy = source.transform.c, source.transform.f, source.transform.a, source.transform.e
        rows, columns = (0, source.height), (0, source.width)
        if area is not None:
            columns = _clip((area[0] - left) / dx, (area[2] - left) / dx, source.width)
            rows = _clip((area[3] - top) / dy, (area[1] - top) / dy, source.height)
            if columns[0] >= columns[1] or rows[0] >= rows[1]:
                raise ParameterError(f"area {area} does not meet the raster, {tuple(source.bounds)}")
        window = Window.from_slices(rows, columns)
        step = max(1.0, max(window.width, window.height) / PIXELS)
        shape = (max(1, round(window.height / step)), max(1, round(window.width / step)))
        height = source.read(1, window=window, out_shape=shape)
        extent = (left + columns[0] * dx, left + columns[1] * dx, top + rows[1] * dy, top + rows[0] * dy)
        return height, extent, step, source.units[0] or "m"


def _clip(first: float, last: float, most: int) -> tuple[int, int]:
    return max(0, round(first)), min(most, round(last))


def _batches(tiles: Iterable[Path], box: tuple[float, float, float, float]) -> Iterator[tuple[NDArray[Any], ...]]:
    import laspy

    for path in tiles:
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            low, high = reader.header.mins, reader.header.maxs
            if low[0] > box[2] or high[0] < box[0] or low[1] > box[3] or high[1] < box[1]:
                continue
            for points in reader.chunk_iterator(_BATCH):
                classes = np.asarray(points.classification)
                yield np.asarray(points.x), np.asarray(points.y), np.asarray(points.z), classes
