"""What is odd about a file and shows only when its points pass by: noted, never a reason to stop."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

from ppdf_dask.grid import MM, Rect
from ppdf_dask.tiles import Problem, Tile


def oddities(tile: Tile, record: dict[str, Any], unit_xy: float) -> Iterator[Problem]:
    """Yield what is odd about a tile.

    Parameters
    ----------
    tile : Tile
        What its header says.
    record : dict
        What was measured while it was cut.
    unit_xy : float
        Metres per unit of the file.
    """
    if record["bounds"] is None:
        return
    # Headers are rounded to their scale at best.
    step = math.ceil(max(tile.scales[:2]) * unit_xy * MM) + 1
    found, said = Rect(*record["bounds"]), tile.bounds
    if not said.grow(step).contains(found):
        far = max(said.x0 - found.x0, found.x1 - said.x1, said.y0 - found.y0, found.y1 - said.y1) / MM
        message = f"has points up to {far:.2f} m outside the bounds of its header; the points count, not the header"
        yield Problem(tile.path, "bounds", message, False)
    if none := record["no_returns"]:
        message = f"has {none:,} points with return number 0 of 0, which count as only returns"
        yield Problem(tile.path, "returns", message, False)
    if odd := record["odd_returns"]:
        message = (
            f"has {odd:,} points with impossible return numbers (0 of n, or beyond n), which count as last returns"
        )
        yield Problem(tile.path, "returns-odd", message, False)


def in_short(problems: Iterable[Problem]) -> Iterator[str]:
    """Yield one line for each kind of oddity, however many files have it."""
    by_code: dict[str, list[Problem]] = {}
    for problem in problems:
        by_code.setdefault(problem.code, []).append(problem)
    for group in by_code.values():
        others = f" (and {len(group) - 1} more files like it, see run.json)" if len(group) > 1 else ""
        yield f"{group[0]}{others}"
