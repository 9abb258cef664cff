"""Fly over the landscape: points of any rectangle, in bands of bounded size."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppdf_dask.errors import ParameterError
from ppdf_dask.grid import MM, Rect
from ppdf_dask.synthetic._pulses import MOST_RETURNS, Band, Beam, scan
from ppdf_dask.synthetic.objects import cover, tallest, window
from ppdf_dask.synthetic.params import SyntheticParams
from ppdf_dask.synthetic.terrain import relief

STRIP_WIDTH = 360.0
ALTITUDE = 1000.0
BAND_PULSES = 200_000
"""Pulses fired at once; a band's memory is this many times five returns, whatever the extent."""

_DTYPES: dict[str, Any] = {
    "x": np.int64,
    "y": np.int64,
    "z": np.int32,
    "return_number": np.uint8,
    "number_of_returns": np.uint8,
    "classification": np.uint8,
    "delivered": np.uint8,
    "intensity": np.uint16,
    "gps_time": np.float64,
    "scan_angle": np.int16,
    "point_source_id": np.uint16,
}


def points(rect: tuple[float, float, float, float], params: SyntheticParams) -> dict[str, NDArray[Any]]:
    """Return the points of a rectangle, all in memory.

    Parameters
    ----------
    rect : tuple of float
        ``(x0, y0, x1, y1)`` in metres, half-open: ``x0 <= x < x1``, ``y0 <= y < y1``.
    params : SyntheticParams
        The survey. Any two rectangles agree where they overlap.

    Returns
    -------
    dict of str to numpy.ndarray, each of length N
        ``x``, ``y``, ``z`` (float64, metres, multiples of 1 mm), ``return_number``, ``number_of_returns``,
        ``classification`` (the truth: 2 ground, 3 to 5 vegetation, 6 building, 9 water, 7 and 18 noise, 1 boulders),
        ``delivered`` (the classes of an unclassified delivery: 1, and 7, 9, 18 where labelled), ``intensity``,
        ``gps_time`` (s, ascending; the returns of a pulse stand together), ``scan_angle`` (0.006 degrees),
        ``point_source_id`` (flight strip).

    Raises
    ------
    ParameterError
        When the rectangle is empty or not finite.

    Notes
    -----
    A pulse's returns may fall into two rectangles; each point belongs to the one that contains the point itself.

    Examples
    --------
    >>> cloud = points((500_000, 5_400_000, 500_020, 5_400_020), SyntheticParams(density=2.0))
    >>> left = points((500_000, 5_400_000, 500_007, 5_400_020), SyntheticParams(density=2.0))
    >>> len(left["x"]) == int((cloud["x"] < 500_007).sum())
    True
    """
    bands = list(bands_of(rect_of(rect), params))
    columns = {
        name: np.concatenate([np.empty(0, dtype), *(getattr(b, name) for b in bands)]).astype(dtype, copy=False)
        for name, dtype in _DTYPES.items()
    }
    return columns | {name: columns[name] / MM for name in "xyz"}


def rect_of(rect: tuple[float, float, float, float]) -> Rect:
    """Turn metres into the job grid's millimetres."""
    if not (all(math.isfinite(v) for v in rect) and rect[0] < rect[2] and rect[1] < rect[3]):
        raise ParameterError(f"extent = {rect} must be four finite numbers of metres x0, y0, x1, y1, x0 < x1, y0 < y1")
    return Rect(*(round(v * MM) for v in rect))


def bands_of(rect: Rect, params: SyntheticParams) -> Iterator[Band]:
    """Yield the points of a rectangle in the order of their GPS time, band by band.

    Parameters
    ----------
    rect : Rect
        Half-open, mm.
    params : SyntheticParams
        The survey.

    Yields
    ------
    Band
        At most `BAND_PULSES` pulses each (and one lattice row at least); the arrays are the caller's to keep.
    """
    r, beam = relief(params), beam_of(params)
    x0, y0, x1, y1 = rect.metres()
    lean = 0.5 * STRIP_WIDTH / ALTITUDE * beam.tallest + beam.spacing
    i0, i1 = math.floor((x0 - lean) / beam.spacing), math.floor((x1 + lean) / beam.spacing) + 1
    j0, j1 = math.floor(y0 / beam.spacing) - 1, math.floor(y1 / beam.spacing) + 2
    for strip in range(i0 // beam.columns, (i1 - 1) // beam.columns + 1):
        a, b = max(i0, strip * beam.columns), min(i1, (strip + 1) * beam.columns)
        rows = max(1, BAND_PULSES // (b - a))
        for j in range(j0, j1, rows):
            end = min(j + rows, j1)
            s = beam.spacing
            objects = window((a * s, j * s, b * s, end * s), params)
            size = (b - a) * (end - j) * MOST_RETURNS
            out = _allocate(size)
            n = scan((rect.x0, rect.y0, rect.x1, rect.y1), (a, b, j, end), strip, r, beam, objects, out)
            if n:
                yield Band._make(column[:n].copy() for column in out)


def _allocate(size: int) -> Band:
    return Band._make(np.empty(size, dtype) for dtype in _DTYPES.values())


def beam_of(params: SyntheticParams) -> Beam:
    """Work out the scanner's constants."""
    c = cover(params)
    spacing = round(1.0 / math.sqrt(params.density), 6)
    return Beam(
        spacing=spacing,
        columns=max(2, round(STRIP_WIDTH / spacing)),
        altitude=ALTITUDE,
        speed=60.0,
        strip_period=200_000.0,
        tree_cell=c.tree_cell,
        crown=1.4 * c.tree_height * c.radius_share * 1.2 * 1.15,
        tallest=tallest(params),
        penetration=params.penetration,
        grass=params.grass_share,
        sigma=params.height_noise,
        low_noise=params.low_noise,
        high_noise=params.high_noise,
        low_outliers=params.low_outliers,
        water_returns=0.3 if params.water == "returns" else 0.0,
    )
