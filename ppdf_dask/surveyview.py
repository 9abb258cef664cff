"""A survey as text and as HTML, every name escaped."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from ppdf_dask.crs import unit_name
from ppdf_dask.maps import Patch, svg_map
from ppdf_dask.survey import Survey
from ppdf_dask.tiles import Problem, Tile, shown

_ROWS = 20
_HEADS = ("tile", "LAS", "format", "points", "points/m2", "width m", "height m", "MB")


def as_text(survey: Survey) -> str:
    """Return a table for the terminal: the survey's facts, its first tiles, its problems."""
    rows = [_HEADS, *(_row(t) for t in survey.tiles[:_ROWS])]
    widths = [max(len(row[k]) for row in rows) for k in range(len(_HEADS))]
    lines = [f"{name}: {value}" for name, value in _facts(survey)]
    lines.append("")
    for row in rows:
        first = row[0].ljust(widths[0])
        lines.append("  ".join([first, *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))]))
    if len(survey.tiles) > _ROWS:
        lines.append(f"... and {len(survey.tiles) - _ROWS} more tiles")
    lines += [*_problem_lines(survey.problems)]
    return "\n".join(lines)


def as_html(survey: Survey) -> str:
    """Return an HTML fragment: map, facts, table and problems."""
    bad = {o.first for o in survey.overlaps} | {o.second for o in survey.overlaps}
    patches = [
        Patch(t.bounds, f"{t.name}: {t.point_count} points", "orange" if t.path in bad else "blue")
        for t in survey.tiles
        if t.point_count
    ]
    legend = {"blue": "tile", "orange": "overlaps another tile"} if bad else {"blue": "tile"}
    facts = "".join(f"<tr><th>{escape(n)}</th><td>{escape(v)}</td></tr>" for n, v in _facts(survey))
    heads = "".join(f"<th>{escape(h)}</th>" for h in _HEADS)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in _row(t)) + "</tr>" for t in survey.tiles[:_ROWS]
    )
    more = f"<p>and {len(survey.tiles) - _ROWS} more tiles</p>" if len(survey.tiles) > _ROWS else ""
    problems = "".join(f"<li>{escape(line)}</li>" for line in _problem_lines(survey.problems))
    return (
        f"<div><table>{facts}</table>{svg_map(patches, legend=legend)}"
        f"<table><tr>{heads}</tr>{body}</table>{more}{f'<ul>{problems}</ul>' if problems else ''}</div>"
    )


def _facts(survey: Survey) -> list[tuple[str, str]]:
    facts = [
        ("tiles", f"{len(survey.tiles):,}"),
        ("points", f"{survey.point_count:,}"),
        ("size", f"{sum(t.size for t in survey.tiles) / 1e6:,.1f} MB"),
        ("crs", survey.crs_name),
        ("units", f"{unit_name(survey.unit_xy)} (x, y), {unit_name(survey.unit_z)} (z)"),
    ]
    if survey.bounds is not None:
        x0, y0, x1, y1 = survey.bounds.metres()
        facts.append(("extent", f"{x1 - x0:,.0f} x {y1 - y0:,.0f} m"))
    if survey.overlaps:
        largest = max(survey.overlaps, key=lambda o: o.share)
        pair = f"{shown(largest.first)} and {shown(largest.second)}"
        facts.append(("overlaps", f"{len(survey.overlaps):,} pairs of tiles, the largest {largest.share:.1%}: {pair}"))
    return facts


def _row(tile: Tile) -> tuple[str, ...]:
    density = "-" if tile.density is None else f"{tile.density:.2f}"
    kind = tile.version + (" COPC" if tile.copc else " LAZ" if tile.compressed else "")
    return (
        shown(tile.name),
        kind,
        str(tile.point_format),
        f"{tile.point_count:,}",
        density,
        f"{tile.bounds.width / 1000:,.1f}",
        f"{tile.bounds.height / 1000:,.1f}",
        f"{tile.size / 1e6:,.1f}",
    )


def _problem_lines(problems: Iterable[Problem]) -> list[str]:
    every = [f"{'left out' if p.fatal else 'note'}: {p}" for p in problems]
    return every[:_ROWS] + ([f"... and {len(every) - _ROWS} more"] if len(every) > _ROWS else [])
