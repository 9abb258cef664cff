"""Checksums that came with a delivery: which file should have which, and whether it does."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ppdf_dask.errors import SurveyError, TileError
from ppdf_dask.tiles import Problem, Tile, shown

_LINE = re.compile(r"([0-9a-fA-F]{64})[ \t]+\*?(.+)")
_TILE = re.compile(r".*\.la[sz]", re.IGNORECASE)
_MOST = 64 << 20  # bytes: about half a million tiles


def sha256_of(path: str) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_checksums(tiles: Sequence[Tile], path: str | os.PathLike[str]) -> tuple[tuple[Tile, ...], list[Problem]]:
    """Give each tile the checksum that a list has for it.

    Parameters
    ----------
    tiles : sequence of Tile
        As scanned.
    path : path-like
        A text file as ``sha256sum`` writes it, with names relative to its own folder or absolute.

    Returns
    -------
    tiles : tuple of Tile
        The same, with `Tile.sha256`; it is compared when a tile is cut, by the worker that reads it anyway.
    problems : list of Problem
        Tiles the list does not have, and listed files that are not there.

    Raises
    ------
    SurveyError
        When the list cannot be read or understood.
    """
    listed = dict(_read(Path(path)))
    given = tuple(replace(t, sha256=listed.pop(os.path.abspath(t.path), None)) for t in tiles)
    problems = [
        Problem(t.path, "unlisted", f"has no checksum in {shown(str(path))}", False) for t in given if t.sha256 is None
    ]
    for name in sorted(listed):
        if _TILE.fullmatch(name) and not os.path.exists(name):
            problems.append(Problem(name, "missing", f"is listed in {shown(str(path))} and is not there", False))
    return given, problems


def _read(path: Path) -> Iterator[tuple[str, str]]:
    try:
        if path.stat().st_size > _MOST:
            raise SurveyError(f"{path} has {path.stat().st_size:,} bytes; a list of checksums is not as long as that")
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise SurveyError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SurveyError(f"{path} is not text; pass a list as `sha256sum *.laz` writes it") from None
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        found = _LINE.fullmatch(line)
        if found is None:
            raise SurveyError(
                f"{path}, line {number}: {shown(line[:80])!r} is not a SHA-256 and a name; pass a list as "
                "`sha256sum *.laz` writes it"
            )
        yield os.path.abspath(path.parent / found[2]), found[1].lower()


def check_sha256(tile: Tile) -> None:
    """Refuse a file that is not what its checksum says.

    Raises
    ------
    TileError
        Naming the file and both sums.
    """
    if tile.sha256 is None:
        return
    try:
        found = sha256_of(tile.path)
    except OSError as error:
        raise TileError(f"{shown(tile.path)} cannot be read: {error.strerror}") from None
    if found != tile.sha256:
        raise TileError(
            f"{shown(tile.path)} has the SHA-256 {found}, its list says {tile.sha256}: it was damaged or replaced "
            "on its way; fetch it again"
        )
