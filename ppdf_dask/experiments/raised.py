"""Raised terrain: how much of the ground on ridges and hilltops a filter finds (the paper's second claim)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ppdf_dask.experiments.drawing import COLOURS, own_axes, tidy
from ppdf_dask.experiments.labelled import Labelled, found_ground
from ppdf_dask.experiments.tables import markdown, number, plain
from ppdf_dask.experiments.variants import Variant
from ppdf_dask.filters.cloud import Bools
from ppdf_dask.metrics import tin_heights

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RADIUS = 10.0
"""Distance, m, over which a place is compared with its surroundings."""

PROMINENCE = 1.0
"""A place this much, m, above the mean of its surroundings is raised."""

DIRECTIONS = 16


@dataclass(frozen=True)
class Raised:
    """One variant on one cloud.

    Attributes
    ----------
    cloud, variant : str
        Names.
    raised, raised_missed : int
        Scored reference ground points on raised terrain, and those labelled non-ground.
    other, other_missed : int
        The same for all other ground.
    """

    cloud: str
    variant: str
    raised: int
    raised_missed: int
    other: int
    other_missed: int

    @property
    def type_i_raised(self) -> float:
        """Type I error on raised terrain."""
        return self.raised_missed / self.raised if self.raised else float("nan")

    @property
    def type_i_other(self) -> float:
        """Type I error elsewhere."""
        return self.other_missed / self.other if self.other else float("nan")


@dataclass(frozen=True)
class RaisedTable:
    """All of them, by cloud and variant."""

    rows: tuple[Raised, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            "radius_m": RADIUS,
            "prominence_m": PROMINENCE,
            "rows": [
                plain(vars(r) | {"type_i_raised": r.type_i_raised, "type_i_other": r.type_i_other}) for r in self.rows
            ],
        }

    def markdown(self) -> str:
        """Return a table: percent."""
        rows = [
            [
                r.cloud,
                r.variant,
                f"{r.raised:,}",
                number(r.raised / (r.raised + r.other), 1, 100),
                number(r.type_i_raised, 2, 100),
                number(r.type_i_other, 2, 100),
            ]
            for r in self.rows
        ]
        return markdown(["cloud", "filter", "raised points", "share %", "type I raised %", "type I elsewhere %"], rows)


def raised_ground(labelled: Labelled, radius: float = RADIUS, prominence: float = PROMINENCE) -> Bools:
    """Tell which reference ground points lie on ridges, hilltops and crests of terraces.

    Parameters
    ----------
    labelled : Labelled
        With reference ground.
    radius : float
        Distance at which the reference's TIN is looked up in 16 directions, m.
    prominence : float
        How much the point must exceed the mean of these heights, m.

    Returns
    -------
    ndarray of bool, shape (n,)

    Examples
    --------
    >>> import numpy as np
    >>> x, y = (v.ravel() for v in np.meshgrid(np.arange(0, 60_000, 1000), np.arange(0, 60_000, 1000)))
    >>> ridge = np.maximum(0, 8000 - np.abs(x - 30_000))
    >>> all_ = np.ones(len(x), bool)
    >>> found = raised_ground(Labelled("ridge", np.column_stack([x, y, ridge]), all_, all_, all_, all_))
    >>> set((x[found] // 1000).tolist()) == set(range(26, 35))
    True
    """
    ground = labelled.reference & labelled.usable
    xyz = labelled.metres(ground)
    mean = np.zeros(len(xyz))
    for k in range(DIRECTIONS):
        angle = 2 * np.pi * k / DIRECTIONS
        mean += tin_heights(xyz, xyz[:, :2] + radius * np.array([np.cos(angle), np.sin(angle)])) / DIRECTIONS
    out = np.zeros(labelled.n, np.bool_)
    out[ground] = xyz[:, 2] - mean > prominence
    return out


def raised_table(labelled: Labelled, variants: Sequence[Variant]) -> RaisedTable:
    """Score every variant on the raised and on the other ground of a cloud.

    Parameters
    ----------
    labelled : Labelled
        With ground and other points that count.
    variants : sequence of Variant
        Filters to try.

    Returns
    -------
    RaisedTable
    """
    labelled.check()
    high = raised_ground(labelled)
    ground = labelled.reference & labelled.scored
    rows = []
    for variant in variants:
        missed = ground & ~found_ground(labelled, variant.params)
        counts = [int(np.count_nonzero(m)) for m in (ground & high, missed & high, ground & ~high, missed & ~high)]
        rows.append(Raised(labelled.name, variant.name, *counts))
    return RaisedTable(tuple(rows))


def figure(found: RaisedTable, axes: Axes | None = None) -> Axes:
    """Draw type I errors on raised terrain and elsewhere, all clouds pooled.

    Parameters
    ----------
    found : RaisedTable
        At least one row.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
    """
    names = list(dict.fromkeys(r.variant for r in found.rows))
    axes = own_axes(axes, 7.2, 1.4 + 0.6 * len(names))
    picked = [[r for r in found.rows if r.variant == name] for name in names]
    kinds = {
        "ridges and hilltops": [(sum(r.raised_missed for r in p), sum(r.raised for r in p)) for p in picked],
        "elsewhere": [(sum(r.other_missed for r in p), sum(r.other for r in p)) for p in picked],
    }
    for k, (kind, counts) in enumerate(kinds.items()):
        shares = [100 * missed / n if n else 0.0 for missed, n in counts]
        bars = axes.barh(np.arange(len(names)) + (k - 0.5) * 0.4, shares, 0.37, color=COLOURS[k], label=kind)
        axes.bar_label(bars, fmt="%.1f", padding=3, fontsize=8)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.margins(x=0.1)
    axes.set_xlabel("ground labelled non-ground (type I), %")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    return tidy(axes)
