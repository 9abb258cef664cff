"""What the studies' figures share: colours that any colour vision tells apart, plain axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#000000", "#F0E442")
"""Okabe and Ito's colours."""

GREY = "#B8B8B8"
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
"""So that lines are told apart in grey, too."""


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches; no window, no global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def own_axes(axes: Axes | None, width: float, height: float) -> Axes:
    """Return `axes`, or those of a new figure."""
    return new_figure(width, height).add_subplot() if axes is None else axes


def tidy(axes: Axes) -> Axes:
    """Remove the frame's upper and right side."""
    axes.spines[["top", "right"]].set_visible(False)
    return axes
