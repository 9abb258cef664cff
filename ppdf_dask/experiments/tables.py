"""Tables of results: aligned Markdown and plain JSON types."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


def markdown(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an aligned Markdown table; the first column is text, the others are numbers.

    Parameters
    ----------
    headers : sequence of str
        Names of the columns.
    rows : sequence of sequence of str
        Cells, as many per row as there are headers.

    Returns
    -------
    str
        Lines joined by newlines, without one at the end.

    Examples
    --------
    >>> print(markdown(["cloud", "total"], [["a", "3.1"], ["long", "12.0"]]))
    | cloud | total |
    |:------|------:|
    | a     |   3.1 |
    | long  |  12.0 |
    """
    widths = [max(len(str(line[k])) for line in [headers, *rows]) for k in range(len(headers))]
    lines = [_line(headers, widths), "|:" + "-" * (widths[0] + 1)]
    lines[1] += "".join("|" + "-" * (w + 1) + ":" for w in widths[1:]) + "|"
    return "\n".join(lines + [_line(row, widths) for row in rows])


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = (str(c) for c in cells)
    return f"| {first:<{widths[0]}} |" + "".join(f" {c:>{w}} |" for c, w in zip(others, widths[1:], strict=True))


def number(value: float, digits: int = 2, scale: float = 1.0) -> str:
    """Write `value` times `scale`; a rate that is not defined is a dash.

    Examples
    --------
    >>> number(0.03421, 2, 100), number(float("nan"))
    ('3.42', '-')
    """
    return "-" if math.isnan(value) else f"{value * scale:.{digits}f}"


def plain(value: Any) -> Any:
    """Return JSON types: NaN and infinities become None, tuples lists, at any depth.

    Examples
    --------
    >>> plain({"a": (1.5, float("nan"))})
    {'a': [1.5, None]}
    """
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
