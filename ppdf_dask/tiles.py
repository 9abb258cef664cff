"""Source files: what is known of one from its header, and how a list of paths becomes names in the output."""

from __future__ import annotations

import glob
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from ppdf_dask.errors import SurveyError, TileError
from ppdf_dask.grid import Rect

_EXTENSION = re.compile(r"(?:\.copc)?\.la[sz]\Z", re.IGNORECASE)
_LONGEST_NAME = 255
_NAMED = 5
_FURTHEST = 1e9  # metres; header bounds beyond it say nothing


@dataclass(frozen=True)
class Problem:
    """Something wrong with a file.

    Attributes
    ----------
    path : str
        The file, or an empty string when it concerns the whole survey.
    code : str
        Short reason, for programs: ``"truncated"``, ``"crs-missing"``...
    message : str
        What is wrong and where, for people.
    fatal : bool
        True when the file is not used.
    place : tuple of int or None
        Where the points of a file that is not used must be, x0, y0, x1, y1 in mm; None when nothing tells.
    """

    path: str
    code: str
    message: str
    fatal: bool
    place: tuple[int, int, int, int] | None = None

    def __str__(self) -> str:
        return f"{shown(self.path)}: {self.message}" if self.path else self.message


@dataclass(frozen=True, slots=True)
class Tile:
    """One source file as its header describes it. Bounds are hints: points are never dropped for lying outside.

    Attributes
    ----------
    path : str
        Absolute path as found (symbolic links are not resolved).
    name : str
        Where its result goes, relative to the output's ``laz`` folder: forward slashes, ends in ``.laz`` (``.las`` for
        point formats with waveforms).
    size, mtime_ns : int
        Bytes and modification time at the scan; both are checked again whenever the file is read.
    version : str
        LAS version, ``"1.0"`` to ``"1.4"``.
    point_format, record_length, point_count : int
        As in the header; the record length in bytes.
    scales, offsets : tuple of float
        x, y, z in the file's own units.
    first_returns : int
        Points with return number 1, as the header says; the point count when it says nothing sensible.
    bounds : Rect
        Header bounds in mm after conversion to metres; half-open around the points. Where the header's bounds cannot be
        true the scan measures them; without points ``Rect(0, 0, 0, 0)``.
    z_range : tuple of float
        Lowest and highest z in metres, from the same source.
    crs : str or None
        WKT2.
    compressed, copc : bool
        LAZ rather than LAS; COPC layout.
    evlr_count : int
        Extended variable length records behind the points.
    guid : str
        Project id of the header, 32 hexadecimal digits.
    sha256 : str or None
        What a list of checksums says of the file; None without one.
    """

    path: str
    name: str
    size: int
    mtime_ns: int
    version: str
    point_format: int
    record_length: int
    point_count: int
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    first_returns: int
    bounds: Rect
    z_range: tuple[float, float]
    crs: str | None
    compressed: bool
    copc: bool
    evlr_count: int
    guid: str
    sha256: str | None = None

    @property
    def density(self) -> float | None:
        """Points per square metre of the header's bounds; None without points."""
        if self.point_count == 0:
            return None
        x0, y0, x1, y1 = self.bounds.metres()
        return self.point_count / ((x1 - x0) * (y1 - y0))

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        for name in ("scales", "offsets", "z_range"):
            plain[name] = list(plain[name])
        plain["bounds"] = [self.bounds.x0, self.bounds.y0, self.bounds.x1, self.bounds.y1]
        return plain

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Tile:
        """Build a tile from `as_dict`; its name is checked again, since it becomes a path."""
        given = dict(values)
        check_name(given["name"])
        for name in ("scales", "offsets", "z_range"):
            given[name] = tuple(given[name])
        given["bounds"] = Rect(*given["bounds"])
        return cls(**given)

    def check_unchanged(self) -> None:
        """Refuse a file whose size or modification time is not that of the scan.

        Raises
        ------
        TileError
            Naming the file, what it was and what it is now.
        """
        try:
            now = os.stat(self.path)
        except OSError as error:
            raise TileError(
                f"{shown(self.path)} was there at the scan and cannot be read now: {error.strerror}"
            ) from None
        if (now.st_size, now.st_mtime_ns) != (self.size, self.mtime_ns):
            raise TileError(
                f"{shown(self.path)} changed since the scan: {self.size} bytes, mtime {self.mtime_ns} ns then, "
                f"{now.st_size} bytes, mtime {now.st_mtime_ns} ns now; scan again and start a new run"
            )


def shown(text: str) -> str:
    """Return a path for a message: one line, control and undecodable characters escaped.

    Examples
    --------
    >>> shown("a" + chr(7) + "b.laz") == "a" + chr(92) + "x07b.laz"
    True
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


def named(lines: Iterable[str]) -> str:
    """Return the first five lines, indented, and how many more there are."""
    every = list(lines)
    more = [f"  ... and {len(every) - _NAMED} more"] if len(every) > _NAMED else []
    return "\n".join([f"  {line}" for line in every[:_NAMED]] + more)


def check_name(name: str) -> None:
    """Refuse a relative name that could leave the output folder or that cannot be stored.

    Raises
    ------
    SurveyError
        For absolute names, ``..``, empty parts, control characters, undecodable bytes and parts over 255 bytes.

    Examples
    --------
    >>> check_name("north/a.laz")
    >>> check_name("../a.laz")
    Traceback (most recent call last):
        ...
    ppdf_dask.errors.SurveyError: the name '../a.laz' cannot be used in the output: it has a part '..'
    """
    fault = _name_fault(name)
    if fault:
        raise SurveyError(f"the name {name!r} cannot be used in the output: {fault}")


def _name_fault(name: str) -> str | None:
    try:
        name.encode()
    except UnicodeEncodeError:
        return "it is not valid UTF-8; rename the file"
    if any(not c.isprintable() for c in name):
        return "it has a control or other unprintable character; rename the file"
    if name.startswith("/") or re.match(r"[A-Za-z]:", name) or "\\" in name:
        return "it is absolute or has a drive letter or backslash; rename the file"
    for part in name.split("/"):
        if part in ("", ".", ".."):
            return f"it has a part {part!r}"
        if len(part.encode()) > _LONGEST_NAME:
            return f"a part is longer than {_LONGEST_NAME} bytes; shorten the file's name"
    return None


def find_files(paths: Iterable[str | os.PathLike[str]]) -> tuple[list[str], str]:
    """List the files that the user means, and the folder their names are relative to.

    Parameters
    ----------
    paths : iterable of path-like
        Files (any extension), folders (searched recursively for ``.las`` and ``.laz`` in any case; symbolic links to
        folders are not followed), and glob patterns (``**`` is recursive). A path that exists is never a pattern.

    Returns
    -------
    files : list of str
        Absolute, sorted; a file that was named twice is there twice.
    root : str
        The deepest folder common to all that was given.

    Raises
    ------
    SurveyError
        When a path does not exist, or nothing at all is found.
    """
    given = [os.fspath(p) for p in ([paths] if isinstance(paths, str | os.PathLike) else paths)]
    if not given:
        raise SurveyError("no tiles were given; name LAS or LAZ files, folders or patterns such as 'tiles/*.laz'")
    files: list[str] = []
    bases: list[str] = []
    for path in given:
        found, base = _expand(path)
        if not found:
            raise SurveyError(
                f"{shown(path)} holds no .las or .laz file"
                if os.path.isdir(path)
                else f"{shown(path)} does not exist and matches nothing"
            )
        files += found
        bases.append(base)
    return sorted(files), os.path.commonpath(bases)


def _expand(path: str) -> tuple[list[str], str]:
    full = os.path.abspath(path)
    if "\0" in path:
        return [], full
    if os.path.isdir(full):
        return _in_folder(full), full
    if os.path.lexists(full):
        return [full], os.path.dirname(full)
    found: list[str] = []
    for match in glob.glob(full, recursive=True):
        if os.path.isdir(match):
            if "**" not in full:
                found += _in_folder(match)
        elif _EXTENSION.search(match):
            found.append(match)
    base = full
    while glob.has_magic(base):
        base = os.path.dirname(base)
    return found, base


def _in_folder(folder: str) -> list[str]:
    return [
        os.path.join(parent, name) for parent, _, names in os.walk(folder) for name in names if _EXTENSION.search(name)
    ]


def output_names(files: Sequence[str], root: str) -> tuple[dict[str, str], list[Problem]]:
    """Give each file its name in the output.

    Parameters
    ----------
    files : sequence of str
        Absolute paths under `root`.
    root : str
        As from `find_files`.

    Returns
    -------
    names : dict of str to str
        Relative name ending in ``.laz`` by path; sub-folders are kept.
    problems : list of Problem
        Fatal ones: names that cannot be used, and files whose outputs would overwrite each other.
    """
    names: dict[str, str] = {}
    problems: list[Problem] = []
    owner: dict[str, str] = {}
    for path in files:
        if path in names:
            continue
        relative = os.path.relpath(path, root).replace(os.sep, "/")
        stem = _EXTENSION.sub("", relative)
        name = (stem if stem != relative else os.path.splitext(relative)[0]) + ".laz"
        fault = _name_fault(name)
        if fault:
            problems.append(Problem(path, "name", f"its name cannot be used in the output: {fault}", True))
        elif name in owner:
            message = f"its result would overwrite that of {shown(owner[name])} ({shown(name)}); rename one of them"
            problems.append(Problem(path, "collision", message, True))
        else:
            owner[name] = path
            names[path] = name
    return names, problems


def bounds_in_mm(
    mins: Sequence[float], maxs: Sequence[float], unit_xy: float, unit_z: float
) -> tuple[Rect, tuple[float, float]] | None:
    """Convert header bounds to the job grid.

    Parameters
    ----------
    mins, maxs : sequence of float, length 3
        In the file's units.
    unit_xy, unit_z : float
        Metres per unit.

    Returns
    -------
    tuple of Rect and (float, float), or None
        The rectangle, half-open around the points, and lowest and highest z in metres; None when the bounds cannot be
        true (NaN, inverted, further than a million km).

    Examples
    --------
    >>> bounds_in_mm((0.0, 0.0, 5.0), (1.0, 2.0, 6.0), 1.0, 1.0)
    (Rect(x0=0, y0=0, x1=1001, y1=2001), (5.0, 6.0))
    """
    low = [v * u for v, u in zip(mins, (unit_xy, unit_xy, unit_z), strict=True)]
    high = [v * u for v, u in zip(maxs, (unit_xy, unit_xy, unit_z), strict=True)]
    if not all(math.isfinite(v) and abs(v) < _FURTHEST for v in low + high):
        return None
    if any(a > b for a, b in zip(low, high, strict=True)):
        return None
    x0, y0, x1, y1 = (round(v * 1000) for v in (low[0], low[1], high[0], high[1]))
    return Rect(x0, y0, x1 + 1, y1 + 1), (low[2], high[2])


def problem_dict(problem: Problem) -> dict[str, Any]:
    """Return a problem as plain JSON types."""
    return asdict(problem)
