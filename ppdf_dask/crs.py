"""Coordinate reference systems and units of LAS files: read from hostile records, compared by meaning.

Records are parsed once per distinct content, whatever the number of tiles. Nothing here looks at points.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

from ppdf_dask.errors import SurveyError

if TYPE_CHECKING:
    import pyproj

Units = Literal["m", "ft", "us-ft"]

_EXACT = {"m": Fraction(1), "ft": Fraction(3048, 10000), "us-ft": Fraction(1200, 3937)}
_NAMES = {"m": "metre", "ft": "international foot", "us-ft": "US survey foot"}
_UNIT_TOLERANCE = 1e-9  # files round 1200/3937 to as few as 10 digits; the two feet differ by 2e-6
_SHORTEST, _LONGEST = 1e-3, 1e4  # metres: from a millimetre to well over a mile
_LINEAR_KEYS = {9001: Fraction(1), 9002: _EXACT["ft"], 9003: _EXACT["us-ft"]}
_PROJECTED, _GEOGRAPHIC, _LINEAR_UNITS, _VERTICAL, _VERTICAL_UNITS = 3072, 2048, 3076, 4096, 4099
_EPSG = range(1024, 32767)


@dataclass(frozen=True)
class Frame:
    """What a file's CRS records mean.

    Attributes
    ----------
    wkt : str or None
        WKT2; None when there is no record, or none that can be understood.
    unit_xy : float or None
        Metres per horizontal unit; None when unknown.
    unit_z : float or None
        Metres per vertical unit; None when the CRS has no vertical axis.
    fault : tuple of str or None
        Reason code (``"crs-unreadable"``, ``"degrees"``, ``"units"``) and sentence when the file cannot be used as it
        is.
    """

    wkt: str | None
    unit_xy: float | None
    unit_z: float | None
    fault: tuple[str, str] | None = None


NOTHING = Frame(None, None, None)
"""A file without any CRS record."""


def unit_fraction(metres: float) -> Fraction:
    """Return the exact value of a unit given as a float.

    Parameters
    ----------
    metres : float
        Metres per unit, rounded as files round it.

    Returns
    -------
    Fraction
        1, 0.3048 (international foot) or 1200/3937 (US survey foot) when that is what is meant, else the float's own
        decimal value.

    Examples
    --------
    >>> unit_fraction(0.3048006096), unit_fraction(0.3048)
    (Fraction(1200, 3937), Fraction(381, 1250))
    """
    for exact in _EXACT.values():
        if abs(metres - exact) <= _UNIT_TOLERANCE * exact:
            return exact
    return Fraction(repr(float(metres)))


def unit_name(metres: float) -> str:
    """Return the name of a unit for tables and messages.

    Examples
    --------
    >>> unit_name(1.0), unit_name(1200 / 3937)
    ('metre', 'US survey foot')
    """
    exact = unit_fraction(metres)
    for short, value in _EXACT.items():
        if value == exact:
            return _NAMES[short]
    return f"{metres} m"


def units_from_user(units: str) -> float:
    """Return metres per unit for ``"m"``, ``"ft"`` or ``"us-ft"``."""
    if units not in _EXACT:
        raise SurveyError(f"assume_units = {units!r} is unknown; choose one of {', '.join(map(repr, _EXACT))}")
    return float(_EXACT[units])


def from_user(crs: Any) -> Frame:
    """Return the frame of a CRS that the user names.

    Parameters
    ----------
    crs : str, int or pyproj.CRS
        ``"EPSG:25832"``, ``"EPSG:2263+6360"``, WKT or whatever else `pyproj.CRS` takes.

    Raises
    ------
    SurveyError
        When it cannot be understood or is of no use.

    Examples
    --------
    >>> from_user("EPSG:25832").unit_xy
    1.0
    """
    import pyproj

    try:
        frame = _describe(pyproj.CRS.from_user_input(crs))
    except pyproj.exceptions.CRSError as error:
        raise SurveyError(f"assume_crs = {crs!r} is not a known coordinate reference system: {error}") from None
    if frame.fault is not None:
        raise SurveyError(f"assume_crs = {crs!r}: {frame.fault[1]}")
    return frame


@lru_cache(maxsize=4096)
def from_records(wkt: bytes | None, geo_keys: bytes | None, wkt_first: bool) -> Frame:
    """Return the frame of a file's CRS records.

    Parameters
    ----------
    wkt : bytes or None
        Data of the WKT record (2112), padding included.
    geo_keys : bytes or None
        Data of the GeoTIFF key directory (34735).
    wkt_first : bool
        Which record counts when both are there and can be understood.

    Returns
    -------
    Frame
        Never raises, whatever the bytes; `Frame.fault` says what is wrong.
    """
    found = {"wkt": _from_wkt(wkt), "keys": _from_geo_keys(geo_keys)}
    order = ("wkt", "keys") if wkt_first else ("keys", "wkt")
    frames = [frame for frame in (found[name] for name in order) if frame is not NOTHING]
    readable = [frame for frame in frames if frame.wkt is not None]
    return (readable or frames or [NOTHING])[0]


def _from_wkt(record: bytes | None) -> Frame:
    import pyproj

    text = (record or b"").split(b"\0")[0].decode("utf-8", "replace").strip()
    if not text:
        return NOTHING
    try:
        return _describe(pyproj.CRS.from_wkt(text))
    except (pyproj.exceptions.ProjError, ValueError, TypeError, KeyError, AttributeError):
        return Frame(None, None, None, ("crs-unreadable", "has a CRS record (WKT) that cannot be understood"))


def _from_geo_keys(record: bytes | None) -> Frame:
    import pyproj

    if not record or len(record) < 8:
        return NOTHING
    keys = {}
    for position in range(8, len(record) - 7, 8):
        key, location, _, value = struct.unpack_from("<4H", record, position)
        if location == 0:
            keys[key] = value
    code = keys.get(_PROJECTED, keys.get(_GEOGRAPHIC))
    if code is None:
        return NOTHING
    unreadable = Frame(None, None, None, ("crs-unreadable", "has GeoTIFF keys whose CRS cannot be understood"))
    if code not in _EPSG:
        return unreadable
    try:
        horizontal = pyproj.CRS.from_epsg(code)
        frame = _describe(_with_height(horizontal, keys.get(_VERTICAL)))
    except (pyproj.exceptions.ProjError, ValueError, TypeError, KeyError, AttributeError):
        return unreadable
    linear, vertical = _LINEAR_KEYS.get(keys.get(_LINEAR_UNITS, 0)), _LINEAR_KEYS.get(keys.get(_VERTICAL_UNITS, 0))
    if linear is not None and frame.unit_xy is not None and unit_fraction(frame.unit_xy) != linear:
        fault = f"says its unit is {unit_name(float(linear))} but that of EPSG:{code} is {unit_name(frame.unit_xy)}"
        return Frame(frame.wkt, None, None, ("units", fault))
    if vertical is not None and frame.unit_z is None:
        return Frame(frame.wkt, frame.unit_xy, float(vertical), frame.fault)
    return frame


def _with_height(horizontal: pyproj.CRS, vertical: int | None) -> pyproj.CRS:
    import pyproj

    if vertical is None or vertical not in _EPSG or horizontal.is_compound:
        return horizontal
    height = pyproj.CRS.from_epsg(vertical)
    if not height.is_vertical:
        return horizontal
    return pyproj.crs.CompoundCRS(f"{horizontal.name} + {height.name}", [horizontal, height])


def _describe(crs: pyproj.CRS) -> Frame:
    parts = _parts(crs)
    flat = parts[0]
    wkt = crs.to_wkt("WKT2_2019")
    if flat.is_geographic:
        fault = f"is in degrees ({_short(flat.name)}); reproject it to a projected CRS in metres or feet first"
        return Frame(wkt, None, None, ("degrees", fault))
    axes = flat.axis_info
    factors = {unit_fraction(a.unit_conversion_factor) for a in axes[:2]}
    if flat.is_geocentric or flat.is_vertical or len(axes) < 2 or len(factors) != 1:
        fault = f"has a CRS without a horizontal plane in one unit of length ({_short(flat.name)}); reproject it first"
        return Frame(wkt, None, None, ("units", fault))
    (unit_xy,) = factors
    heights = parts[1].axis_info if len(parts) > 1 else axes[2:3]
    unit_z = float(unit_fraction(heights[0].unit_conversion_factor)) if heights else None
    if not all(_SHORTEST <= u <= _LONGEST for u in (unit_xy, unit_z or 1)):
        return Frame(wkt, None, None, ("units", f"has a CRS without a unit of length ({_short(flat.name)})"))
    return Frame(wkt, float(unit_xy), unit_z)


def _parts(crs: pyproj.CRS) -> list[pyproj.CRS]:
    """Return the horizontal and, if there is one, the vertical part, unbound."""
    if crs.is_bound and crs.source_crs is not None:
        return _parts(crs.source_crs)
    if crs.is_compound:
        return [part for sub in crs.sub_crs_list for part in _parts(sub)]
    return [crs]


def _short(name: str) -> str:
    return name if len(name) <= 60 else name[:57] + "..."


@lru_cache(maxsize=4096)
def compare(a: str, b: str) -> Literal["same", "height", "different"]:
    """Compare two CRS by meaning, not by spelling.

    Parameters
    ----------
    a, b : str
        WKT2 of two files.

    Returns
    -------
    {"same", "height", "different"}
        ``"height"``: the horizontal parts are equivalent and only one of the two has a vertical part.

    Examples
    --------
    >>> import pyproj
    >>> crs = pyproj.CRS.from_epsg(25832)
    >>> compare(crs.to_wkt("WKT1_ESRI"), crs.to_wkt()), compare(crs.to_wkt(), pyproj.CRS.from_epsg(25833).to_wkt())
    ('same', 'different')
    """
    import pyproj

    left, right = pyproj.CRS.from_wkt(a), pyproj.CRS.from_wkt(b)
    if _equivalent(left, right):
        return "same"
    p, q = _parts(left), _parts(right)
    if not _equivalent(p[0], q[0]):
        return "different"
    if len(p) == len(q):
        return "same" if len(p) == 1 or _equivalent(p[1], q[1]) else "different"
    return "height"


def _equivalent(left: pyproj.CRS, right: pyproj.CRS) -> bool:
    if left.equals(right, ignore_axis_order=True):
        return True
    code = left.to_epsg()
    return code is not None and code == right.to_epsg()


def crs_name(wkt: str | None) -> str:
    """Return a short name for tables: the CRS's own and its EPSG code when it has one."""
    if wkt is None:
        return "none"
    import pyproj

    crs = pyproj.CRS.from_wkt(wkt)
    code = crs.to_epsg()
    return _short(crs.name) + (f" (EPSG:{code})" if code else "")
