"""Tiles that belong together by mistake: the same file twice, bounds that overlap, the same points in two files."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ppdf_dask.checksums import sha256_of
from ppdf_dask.errors import SurveyError, TileError
from ppdf_dask.lasheader import Header
from ppdf_dask.repeats import PAIRS, SHARE, share_of_same_points
from ppdf_dask.tiles import Problem, Tile, named, shown

Duplicates = Literal["error", "keep", "first"]

_TOLERATED = 1  # mm by which neighbouring tiles may overlap: their writers round edges


@dataclass(frozen=True)
class Overlap:
    """Two tiles whose header bounds overlap; `share` is the overlap's part of the smaller one's area, 0 to 1."""

    first: str
    second: str
    share: float


def find_duplicates(headers: Mapping[str, Header]) -> list[list[str]]:
    """Return groups of paths with the same content; only files with equal headers are read for it."""
    suspects: dict[Any, list[str]] = defaultdict(list)
    for path, h in sorted(headers.items()):
        if h.point_count:
            suspects[h.size, h.point_count, repr(h.mins), repr(h.maxs), h.guid].append(path)
    groups = []
    for paths in suspects.values():
        if len(paths) > 1:
            same: dict[str, list[str]] = defaultdict(list)
            for path in paths:
                same[_digest(path)].append(path)
            groups += [group for group in same.values() if len(group) > 1]
    return groups


def _digest(path: str) -> str:
    try:
        return sha256_of(path)
    except OSError as error:
        raise SurveyError(f"{shown(path)} cannot be read: {error.strerror}") from None


def duplicate_problems(repeated: list[str], twins: list[list[str]], policy: Duplicates) -> list[Problem]:
    """Refuse tiles that are there twice, or say what is done with them, as the policy wants."""
    lines = [f"{shown(path)} is named twice" for path in repeated]
    lines += [f"{shown(other)} has the content of {shown(group[0])}" for group in twins for other in group[1:]]
    if lines and policy == "error":
        raise SurveyError(
            f"tiles are there twice and their points would count twice:\n{named(lines)}\n"
            "Remove one of each, or use --duplicates first (only the first by path) or keep (both)."
        )
    notes = [Problem(path, "duplicate", "is named twice; it is used once", False) for path in repeated]
    for group in twins:
        for other in group[1:]:
            what = "it is left out" if policy == "first" else "both are used"
            notes.append(Problem(other, "duplicate", f"has the content of {shown(group[0])}; {what}", False))
    return notes


def find_overlaps(tiles: Sequence[Tile]) -> tuple[Overlap, ...]:
    """Find pairs of tiles whose header bounds overlap by more than 1 mm in both directions.

    Parameters
    ----------
    tiles : sequence of Tile
        Those without points are passed over.

    Returns
    -------
    tuple of Overlap
        Sorted by path. The cost grows with the tiles that share an interval of one axis, not with the square of all.
    """
    placed = [t for t in tiles if t.point_count]
    if len(placed) < 2:
        return ()
    boxes = np.array([(t.bounds.x0, t.bounds.y0, t.bounds.x1, t.bounds.y1) for t in placed], np.int64)
    # Half-open boxes reach 1 mm beyond their last point.
    slack = _TOLERATED + 1
    axis = min((0, 1), key=lambda a: _candidates(boxes, a, slack))
    other = 1 - axis
    order = np.lexsort((np.arange(len(boxes)), boxes[:, axis]))
    boxes = boxes[order]
    ends = np.searchsorted(boxes[:, axis], boxes[:, axis + 2] - slack, side="left")
    found = []
    for i, end in enumerate(ends):
        near = boxes[i + 1 : end]
        across = np.minimum(near[:, other + 2], boxes[i, other + 2]) - np.maximum(near[:, other], boxes[i, other])
        for j in np.flatnonzero(across > slack):
            along = min(near[j, axis + 2], boxes[i, axis + 2]) - near[j, axis]
            if along > slack:
                found.append(_overlap(placed[order[i]], placed[order[i + 1 + j]], int(along) * int(across[j])))
    return tuple(sorted(found, key=lambda o: (o.first, o.second)))


def refuse_same_points(tiles: Sequence[Tile], overlaps: Sequence[Overlap], unit_xy: float, unit_z: float) -> None:
    """Refuse tiles that hold the same points: the pairs that overlap most are read for it, in part.

    Raises
    ------
    SurveyError
        Naming the pairs. A damaged file is passed over here; the run names it.
    """
    by_path, lines = {t.path: t for t in tiles}, []
    for pair in sorted(overlaps, key=lambda o: (-o.share, o.first, o.second))[:PAIRS]:
        try:
            share = share_of_same_points(by_path[pair.first], by_path[pair.second], unit_xy, unit_z)
        except TileError:
            continue
        if share >= SHARE:
            lines.append(
                f"{shown(pair.first)} and {shown(pair.second)} overlap by {pair.share:.1%} and have {share:.0%} "
                "of their points there in common"
            )
    if lines:
        more = f" ({len(overlaps)} pairs overlap, the {PAIRS} largest were looked at)" if len(overlaps) > PAIRS else ""
        raise SurveyError(
            f"tiles hold the same points, which would count twice{more}:\n{named(lines)}\n"
            "Remove the buffers or the older delivery, or use --duplicates keep: all points are kept, equal ones get "
            "one label."
        )


def _candidates(boxes: npt.NDArray[np.int64], axis: int, slack: int) -> int:
    """Return how many pairs share an interval of an axis."""
    starts = np.sort(boxes[:, axis])
    return int((np.searchsorted(starts, boxes[:, axis + 2] - slack) - np.searchsorted(starts, boxes[:, axis])).sum())


def _overlap(a: Tile, b: Tile, area: int) -> Overlap:
    smaller = min(a.bounds.width * a.bounds.height, b.bounds.width * b.bounds.height)
    first, second = sorted((a.path, b.path))
    return Overlap(first, second, min(1.0, area / smaller))
