"""Maps as SVG text: rectangles in absolute millimetres to a string, for notebooks and reports. Pure."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from ppdf_dask.grid import ChunkGrid, Rect

if TYPE_CHECKING:
    from ppdf_dask.plan import Plan
    from ppdf_dask.result import Result

PALETTE: Mapping[str, str] = {
    "blue": "#0072B2",
    "orange": "#E69F00",
    "green": "#009E73",
    "red": "#D55E00",
    "pink": "#CC79A7",
    "sky": "#56B4E9",
    "yellow": "#F0E442",
    "grey": "#999999",
    "pale": "#E5E5E5",
}
"""Colours that people with any colour vision can tell apart (Okabe and Ito, 2008, Color Universal Design)."""

_MOST = 4000
_BINS = 64
_COLOUR = re.compile(r"#[0-9a-fA-F]{6}\Z")


@dataclass(frozen=True)
class Patch:
    """One rectangle of a map.

    Attributes
    ----------
    rect : Rect
        Absolute millimetres.
    label : str
        Shown when the pointer rests on it; any text, it is escaped.
    colour : str
        A name from `PALETTE` or ``#rrggbb``.
    """

    rect: Rect
    label: str
    colour: str = "blue"


def svg_map(
    patches: Sequence[Patch], *, width: int = 480, legend: Mapping[str, str] | None = None, opacity: float = 0.45
) -> str:
    """Draw rectangles, north up.

    Parameters
    ----------
    patches : sequence of Patch
        Drawn in this order. Above 4000 they are gathered into a mosaic of at most 64 x 64 squares, each in its most
        frequent colour, so that the text stays small.
    width : int
        Pixels; the height follows the extent, at most twice the width.
    legend : mapping of str to str, optional
        Text by colour.
    opacity : float
        Of the patches, and of the legend's; less than 1 where patches lie over each other.

    Returns
    -------
    str
        An ``<svg>`` element without scripts, links or style sheets; an empty string without patches.

    Examples
    --------
    >>> text = svg_map([Patch(Rect(0, 0, 1000, 500), "<a>")])
    >>> text.startswith("<svg"), "&lt;a&gt;" in text
    (True, True)
    """
    if not patches:
        return ""
    box = patches[0].rect
    for patch in patches:
        box = box.union(patch.rect)
    if len(patches) > _MOST:
        patches = _gather(patches, box)
    scale = min(width / max(box.width, 1), 2 * width / max(box.height, 1))
    height = max(1, round(box.height * scale))
    parts = []
    for patch in patches:
        r = patch.rect
        x, y = (r.x0 - box.x0) * scale, (box.y1 - r.y1) * scale
        w, h = max(r.width * scale, 1.0), max(r.height * scale, 1.0)
        parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}" fill="{_hex(patch.colour)}" '
            f'fill-opacity="{opacity:g}" stroke="#333333" stroke-width="0.5"><title>{_text(patch.label)}</title></rect>'
        )
    rows = []
    for k, (colour, text) in enumerate((legend or {}).items()):
        y = height + 8 + 18 * k
        rows.append(
            f'<rect x="2" y="{y}" width="12" height="12" fill="{_hex(colour)}" opacity="{opacity:g}" stroke="#333333"/>'
        )
        rows.append(f'<text x="20" y="{y + 11}" font-size="12" font-family="sans-serif">{_text(text)}</text>')
    total = height + (10 + 18 * len(legend) if legend else 0)
    view = f'viewBox="-2 -2 {width + 4} {total + 4}" width="{width + 4}" height="{total + 4}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {view} role="img">' + "".join(parts + rows) + "</svg>"


def plan_html(plan: Plan) -> str:
    """Return a plan as an HTML fragment: its chunks over its tiles, and its facts."""
    chunks = [Patch(c.core, f"{c.id}: about {c.points:,.0f} points", "sky") for c in plan.chunks]
    tiles = [Patch(t.bounds, f"{t.name}: {t.point_count:,} points", "grey") for t in plan.survey.tiles if t.point_count]
    return _fragment(svg_map(tiles + chunks, legend={"sky": "chunk", "grey": "tile"}), repr(plan))


def result_html(result: Result) -> str:
    """Return a finished run as an HTML fragment: its chunks, and its facts."""
    grid = ChunkGrid.from_metres(result.summary["plan"]["chunk_size_m"])
    chunks = [Patch(grid.parse(name).core, name, "green") for name in result.chunks]
    return _fragment(svg_map(chunks, legend={"green": "classified chunk"}), repr(result))


def _fragment(drawing: str, text: str) -> str:
    return f"<div>{drawing}<pre>{escape(text)}</pre></div>"


def _hex(colour: str) -> str:
    found = PALETTE.get(colour, colour)
    if not _COLOUR.match(found):
        raise ValueError(f"colour {colour!r} is neither #rrggbb nor one of {', '.join(PALETTE)}")
    return found


def _text(text: str) -> str:
    """Escape for XML, which has no place for control characters either."""
    return escape("".join(c if c.isprintable() else "�" for c in text), quote=True)


def _gather(patches: Sequence[Patch], box: Rect) -> list[Patch]:
    step = max(-(-max(box.width, box.height) // _BINS), 1)
    bins: dict[tuple[int, int], Counter[str]] = {}
    for patch in patches:
        r = patch.rect
        place = ((r.x0 + r.x1) // 2 - box.x0) // step, ((r.y0 + r.y1) // 2 - box.y0) // step
        bins.setdefault(place, Counter())[patch.colour] += 1
    out = []
    for (i, j), colours in sorted(bins.items()):
        x, y = box.x0 + i * step, box.y0 + j * step
        colour, _ = max(colours.items(), key=lambda item: (item[1], item[0]))
        out.append(Patch(Rect(x, y, min(x + step, box.x1), min(y + step, box.y1)), f"{colours.total()} here", colour))
    return out
