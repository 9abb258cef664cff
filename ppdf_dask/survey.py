"""The header-only scan: files in, a `Survey` out. A tile costs a few kilobytes of reading.

Points are read only where a header is impossible or tiles overlap.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from ppdf_dask import crs as crs_module
from ppdf_dask.checksums import with_checksums
from ppdf_dask.crs import Frame
from ppdf_dask.errors import SurveyError, TileError
from ppdf_dask.frames import common_frame, frame_of, remedy
from ppdf_dask.grid import MM, Rect
from ppdf_dask.lasheader import Header, Reject, read_header
from ppdf_dask.pairs import (
    Duplicates,
    Overlap,
    duplicate_problems,
    find_duplicates,
    find_overlaps,
    refuse_same_points,
)
from ppdf_dask.params import ClassRules
from ppdf_dask.reader import batches
from ppdf_dask.tiles import Problem, Tile, bounds_in_mm, find_files, named, output_names, problem_dict

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Duplicates", "Overlap", "Problem", "Survey", "Tile", "find_overlaps", "measure", "scan"]

WAVEFORM_FORMATS = (4, 5, 9, 10)
"""Point formats with waveform packets: lazrs 0.8.2 loses them in formats 9 and 10, LASzip cannot read its 4 and 5."""

_WAVEFORM = "has waveform packets; its result is written uncompressed (.las), for LAZ writers do not agree on them"

_NEAR = 10_000_000
"""How far from the tiles the place of a file that is left out still matters, mm: more than any chunk or triangle looks.

A broken header may name any place; the raster must not grow towards it."""

_DEGREE_SCALE = 1e-5
_DEGREES = "has no CRS and looks like degrees; reproject it, or say the unit with --assume-units"


@dataclass(frozen=True)
class Survey:
    """The delivery as its headers describe it.

    Attributes
    ----------
    tiles : tuple of Tile
        Sorted by path.
    root : str
        The folder that the tiles' names are relative to.
    crs : str or None
        WKT2 of the survey; None when no tile has one.
    unit_xy, unit_z : float
        Metres per horizontal and vertical unit of the files.
    problems : tuple of Problem
        Warnings, and the files left out.
    """

    tiles: tuple[Tile, ...]
    root: str
    crs: str | None
    unit_xy: float
    unit_z: float
    problems: tuple[Problem, ...] = ()

    @property
    def point_count(self) -> int:
        """Points in all tiles, as their headers say."""
        return sum(t.point_count for t in self.tiles)

    @cached_property
    def bounds(self) -> Rect | None:
        """Box around all tiles that have points, mm; None when there is none."""
        boxes = [t.bounds for t in self.tiles if t.point_count]
        if not boxes:
            return None
        return Rect(
            min(b.x0 for b in boxes), min(b.y0 for b in boxes), max(b.x1 for b in boxes), max(b.y1 for b in boxes)
        )

    @cached_property
    def lost(self) -> tuple[Rect, ...]:
        """Places near the tiles where a file that is left out has its points, mm, as far as they are known."""
        if self.bounds is None:
            return ()
        near = self.bounds.grow(_NEAR)
        places = (Rect(*p.place) for p in self.problems if p.fatal and p.place)
        found = (
            Rect(max(r.x0, near.x0), max(r.y0, near.y0), min(r.x1, near.x1), min(r.y1, near.y1))
            for r in places
            if r.intersects(near)
        )
        return tuple(sorted(found))

    @cached_property
    def overlaps(self) -> tuple[Overlap, ...]:
        """Pairs of tiles whose header bounds overlap by more than 1 mm, by path."""
        return find_overlaps(self.tiles)

    @cached_property
    def crs_name(self) -> str:
        """Short name of the CRS for people."""
        return crs_module.crs_name(self.crs)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types; `from_dict` reads them."""
        return {
            "root": self.root,
            "crs": self.crs,
            "unit_xy": self.unit_xy,
            "unit_z": self.unit_z,
            "tiles": [t.as_dict() for t in self.tiles],
            "problems": [problem_dict(p) for p in self.problems],
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Survey:
        """Build a survey from `as_dict`."""
        return cls(
            tiles=tuple(Tile.from_dict(t) for t in values["tiles"]),
            root=values["root"],
            crs=values["crs"],
            unit_xy=values["unit_xy"],
            unit_z=values["unit_z"],
            problems=tuple(
                Problem(**p | {"place": None if p["place"] is None else tuple(p["place"])}) for p in values["problems"]
            ),
        )

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the tiles as a map, see `plot.survey_map`; returns the axes."""
        from ppdf_dask.plot import survey_map

        return survey_map(self, ax)

    def __repr__(self) -> str:
        from ppdf_dask.surveyview import as_text

        return as_text(self)

    def _repr_html_(self) -> str:
        from ppdf_dask.surveyview import as_html

        return as_html(self)


def scan(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    assume_crs: Any = None,
    assume_units: crs_module.Units | None = None,
    duplicates: Duplicates = "error",
    skip_bad: bool = False,
    checksums: str | os.PathLike[str] | None = None,
) -> Survey:
    """Read the headers of a delivery.

    Parameters
    ----------
    paths : path-like or iterable of path-like
        Any mix of files, folders (recursive) and globs of ``.las``, ``.laz`` and ``.copc.laz`` in any case.
    assume_crs : str, int or pyproj.CRS, optional
        The CRS of tiles that have none, or none that can be understood.
    assume_units : {"m", "ft", "us-ft"}, optional
        The unit of x, y and z, whatever the CRS says. Default: the CRS's own; metres when no tile has a CRS.
    duplicates : {"error", "keep", "first"}
        What to do with the same file found twice: refuse (the default, since points would count twice), keep both, or
        use the first by path. Tiles that overlap and have the same points there are refused unless all are kept.
    skip_bad : bool
        Leave files with fatal problems out, and list them in `Survey.problems`, instead of refusing the survey.
    checksums : path-like, optional
        A list as ``sha256sum`` writes it. Each tile is compared with it when its points are read; what is not listed or
        not there is noted.

    Returns
    -------
    Survey

    Raises
    ------
    SurveyError
        When nothing is found; a file cannot be used; CRS are mixed, missing in some tiles or in degrees; or a tile is
        there twice. The message names the files and the option that helps.
    """
    if duplicates not in ("error", "keep", "first"):
        raise SurveyError(f"duplicates = {duplicates!r} is unknown; choose 'error', 'keep' or 'first'")
    units = None if assume_units is None else crs_module.units_from_user(assume_units)
    assumed = None if assume_crs is None else crs_module.from_user(assume_crs)
    listed = [paths] if isinstance(paths, str | os.PathLike) else paths
    files, root = find_files(listed)
    names, problems = output_names(files, root)
    repeated = sorted({a for a, b in pairwise(files) if a == b})

    good, frames, boxes, notes = _read_headers(names, assumed, units)
    problems += notes
    _refuse(problems, skip_bad)
    reference, notes = common_frame(frames, units)
    problems += notes
    twins = find_duplicates(good)
    problems += duplicate_problems(repeated, twins, duplicates)
    if duplicates == "first":
        for later in (path for group in twins for path in group[1:]):
            del good[later]
    tiles = []
    for path, header in sorted(good.items()):
        if reference.wkt is None and units is None and _like_degrees(header):
            problems.append(Problem(path, "degrees", _DEGREES, True))
            continue
        tile, notes = _tile(path, names[path], header, reference)
        tiles.append(tile)
        problems += notes
    _refuse(problems, skip_bad)
    bad = {p.path for p in problems if p.fatal}
    problems = [_placed(p, boxes.get(p.path), reference) for p in problems]
    kept = tuple(t for t in tiles if t.path not in bad)
    if checksums is not None:
        kept, notes = with_checksums(kept, checksums)
        problems += notes
    found = Survey(
        tiles=kept,
        root=root,
        crs=reference.wkt,
        unit_xy=reference.unit_xy or 1.0,
        unit_z=reference.unit_z or reference.unit_xy or 1.0,
        problems=tuple(sorted(problems, key=lambda p: (p.path, not p.fatal, p.code))),
    )
    if duplicates != "keep":
        refuse_same_points(found.tiles, found.overlaps, found.unit_xy, found.unit_z)
    return found


def _read_headers(
    paths: Iterable[str], assumed: Frame | None, units: float | None
) -> tuple[dict[str, Header], dict[str, Frame], dict[str, Any], list[Problem]]:
    """Return headers and frames of the files that can be used, the box that each file gives, and what is wrong."""
    headers: dict[str, Header] = {}
    frames: dict[str, Frame] = {}
    boxes: dict[str, Any] = {}
    problems: list[Problem] = []
    for path in paths:
        try:
            header = read_header(path)
        except Reject as reject:
            boxes[path] = reject.box
            problems.append(Problem(path, reject.code, reject.message, True))
            continue
        boxes[path] = header.mins, header.maxs
        problems += [Problem(path, code, message, False) for code, message in header.warnings]
        frame = frame_of(header, assumed)
        if frame.fault is not None and not (units is not None and frame.fault[0] in ("crs-unreadable", "units")):
            problems.append(Problem(path, frame.fault[0], frame.fault[1] + remedy(frame.fault[0]), True))
            continue
        frames[path] = frame
        # The records' own bytes would be most of the memory of a large survey.
        headers[path] = replace(header, wkt=None, geo_keys=None)
    return headers, frames, boxes, problems


def _placed(problem: Problem, box: Any, frame: Frame) -> Problem:
    """Add to a file that is left out where its points must be."""
    if not problem.fatal or box is None:
        return problem
    unit_xy, unit_z = frame.unit_xy or 1.0, frame.unit_z or frame.unit_xy or 1.0
    low, high = box
    found = bounds_in_mm(low, high, unit_xy, unit_z)
    return problem if found is None else replace(problem, place=(found[0].x0, found[0].y0, found[0].x1, found[0].y1))


def _refuse(problems: Sequence[Problem], skip_bad: bool) -> None:
    """Raise for fatal problems unless they may be skipped."""
    fatal = [p for p in problems if p.fatal]
    if not fatal or skip_bad:
        return
    files = len({p.path for p in fatal})
    raise SurveyError(
        f"{files} file{'s' if files > 1 else ''} cannot be used:\n{named(map(str, fatal))}\n"
        "Repair or remove them, or leave them out with --skip-bad (skip_bad=True)."
    )


def _tile(path: str, name: str, header: Header, frame: Frame) -> tuple[Tile, list[Problem]]:
    """Return the tile and what is odd about it; only impossible header bounds make it read the points."""
    unit_xy, unit_z = frame.unit_xy or 1.0, frame.unit_z or frame.unit_xy or 1.0
    found = bounds_in_mm(header.mins, header.maxs, unit_xy, unit_z) if _bounds_possible(header) else None
    uncompressed = header.point_format in WAVEFORM_FORMATS
    tile = Tile(
        path=path,
        name=f"{name.removesuffix('.laz')}.las" if uncompressed else name,
        size=header.size,
        mtime_ns=header.mtime_ns,
        version=header.version,
        point_format=header.point_format,
        record_length=header.record_length,
        point_count=header.point_count,
        first_returns=header.first_returns,
        scales=header.scales,
        offsets=header.offsets,
        bounds=found[0] if found and header.point_count else Rect(0, 0, 0, 0),
        z_range=found[1] if found and header.point_count else (0.0, 0.0),
        crs=frame.wkt,
        compressed=header.laszip is not None,
        copc=header.copc,
        evlr_count=header.evlr_count,
        guid=header.guid,
    )
    if header.point_count == 0:
        return tile, [Problem(path, "no-points", "has no points; an empty tile is written", False)]
    notes = [Problem(path, "waveform", _WAVEFORM, False)] if uncompressed else []
    if found:
        return tile, notes
    try:
        bounds, z_range = measure(tile, unit_xy, unit_z)
    except TileError as error:
        return tile, [Problem(path, "corrupt", str(error), True)]
    message = "has header bounds that cannot be true; they were measured by reading its points"
    return replace(tile, bounds=bounds, z_range=z_range), [*notes, Problem(path, "bounds", message, False)]


def measure(tile: Tile, unit_xy: float, unit_z: float) -> tuple[Rect, tuple[float, float]]:
    """Return the true bounds of a tile (mm) and its lowest and highest z (m) by reading all its points."""
    low: list[int] = []
    high: list[int] = []
    for batch in batches(tile, unit_xy=unit_xy, unit_z=unit_z, rules=ClassRules(), returns="all"):
        here = [(int(v.min()), int(v.max())) for v in (batch.x, batch.y, batch.z)]
        low = [min(a, b) for a, (b, _) in zip(low or [h[0] for h in here], here, strict=True)]
        high = [max(a, b) for a, (_, b) in zip(high or [h[1] for h in here], here, strict=True)]
    return Rect(low[0], low[1], high[0] + 1, high[1] + 1), (low[2] / MM, high[2] / MM)


def _bounds_possible(header: Header) -> bool:
    """Tell whether 32-bit integers with the header's scale and offset can reach its bounds."""
    if header.point_count > 1 and not any(header.mins) and not any(header.maxs):
        return False
    return all(
        low <= high and o - s * 2.0**31 - s <= low and high <= o + s * 2.0**31 + s
        for low, high, s, o in zip(header.mins, header.maxs, header.scales, header.offsets, strict=True)
    )


def _like_degrees(header: Header) -> bool:
    """Tell whether coordinates without a CRS look like degrees: small numbers in very small steps."""
    largest = max(map(abs, (*header.mins[:2], *header.maxs[:2])))
    return header.point_count > 0 and largest <= 360 and max(header.scales[:2]) < _DEGREE_SCALE
