"""What each part of PPDF contributes: the paper's Figure 16, and the robust profile step by step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ppdf_dask.experiments.drawing import COLOURS, GREY, own_axes, tidy
from ppdf_dask.experiments.variants import Trials, Variant
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.filters.ppdf.robust.params import RobustParams

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROBUST_CHANGES: dict[str, dict[str, Any]] = {
    "growth without a slope term": {"growth_slope": 0.0},
    "growth in one pass": {"passes": 1},
    "growth in 20 passes": {"passes": 20},
    "no nearest-reference rule": {"growth_step": 0.0},
    "no share of inliers asked for": {"inlier_share": 0.0},
    "small patches are believed": {"smallest_patch": 0},
    "gentle borders count in full": {"border_gentle": 1.0},
    "tolerance blind to roughness": {"roughness": 0.0},
    "tolerance blind to slope": {"label_slope": 0.0},
    "search up to 10 m": {"search_radius": 10.0},
    "300 RANSAC trials": {"trials": 300},
}
"""Numeric thresholds of the robust profile at the value that switches a rule off, or beyond its default."""


def paper_variants(params: PaperParams | None = None) -> tuple[Variant, ...]:
    """Return the three variants of the paper's Figure 16.

    The first contribution is the multi-scale plane seeds, the second the growth from the nearest ground point of each
    quadrant. Without the first, seeds are the lowest points of `plane_size` windows; without the second, the four
    nearest ground points carry the reference plane (the paper gives no number).

    Examples
    --------
    >>> [v.name for v in paper_variants()]
    ['both contributions', 'only plane seeds', 'only quadrants']
    """
    base = params or PaperParams()
    return (
        Variant("both contributions", base),
        Variant("only plane seeds", base.replace(neighbours="nearest")),
        Variant("only quadrants", base.replace(seeds="local_minimum")),
    )


def robust_variants(params: RobustParams | None = None) -> tuple[Variant, ...]:
    """Return the robust profile, then each of its steps left out, then thresholds that switch single rules off.

    Examples
    --------
    >>> base, *others = robust_variants()
    >>> base.name, len(others) == len(base.params.steps) + len(ROBUST_CHANGES)
    ('robust profile', True)
    """
    base = params or RobustParams()
    without = (Variant(f"without {s}", base.replace(steps=tuple(t for t in base.steps if t != s))) for s in base.steps)
    changed = (Variant(name, base.replace(**change)) for name, change in ROBUST_CHANGES.items())
    return (Variant("robust profile", base), *without, *changed)


def paper_figure(found: Trials, axes: Axes | None = None) -> Axes:
    """Draw total error by site and variant as grouped bars (the paper's Figure 16); the last group is the mean.

    Parameters
    ----------
    found : Trials
        Of `paper_variants`.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
    """
    axes = own_axes(axes, max(6.4, 1.2 + 1.0 * (len(found.clouds) + 1)), 4.0)
    totals = np.vstack([found.totals(), found.totals().mean(axis=0)])
    width = 0.8 / len(found.variants)
    for k, variant in enumerate(found.variants):
        at = np.arange(len(totals)) + (k - (len(found.variants) - 1) / 2) * width
        bars = axes.bar(at, totals[:, k], width * 0.95, color=COLOURS[k], label=variant.name)
        axes.bar_label(bars, fmt="%.1f", padding=2, fontsize=7)
    axes.set_xticks(range(len(totals)), [*found.clouds, "mean"], rotation=20, ha="right")
    axes.set_ylabel("total error, %")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    return tidy(axes)


def robust_figure(found: Trials, axes: Axes | None = None) -> Axes:
    """Draw by how much each variant changes the mean total error, with each cloud's own change as a dot.

    Parameters
    ----------
    found : Trials
        The first variant is what the others are compared with.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
        The axis is linear near 0 and logarithmic beyond 1 percentage point, so that small effects remain visible.
    """
    axes = own_axes(axes, 7.2, 1.2 + 0.3 * len(found.variants))
    totals = found.totals()
    change = (totals - totals[:, :1])[:, 1:]
    at = np.arange(change.shape[1])
    mean = change.mean(axis=0)
    axes.barh(at, mean, 0.7, color=[COLOURS[1] if m > 0 else COLOURS[0] for m in mean], label="mean of the clouds")
    for row in change:
        axes.scatter(row, at, s=9, color=GREY, edgecolors="black", linewidths=0.4, zorder=3)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_xscale("symlog", linthresh=1.0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:+g}" if value else "0")
    axes.set_yticks(at, [v.name for v in found.variants[1:]])
    axes.invert_yaxis()
    axes.set_xlabel("change of the total error, percentage points (dots: single clouds)")
    axes.set_title(f"{found.variants[0].name}: mean total error {totals[:, 0].mean():.2f} %", fontsize=10, loc="left")
    return tidy(axes)
