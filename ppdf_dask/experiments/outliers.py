"""Low outliers injected below the ground, single and in groups: what they do to each filter (the paper's claim)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ppdf_dask.errors import ParameterError
from ppdf_dask.experiments.drawing import COLOURS, own_axes, tidy
from ppdf_dask.experiments.labelled import Labelled, found_ground
from ppdf_dask.experiments.tables import markdown, number, plain
from ppdf_dask.experiments.variants import Variant
from ppdf_dask.metrics import Scores

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHARE = 0.0005
"""Outliers per point of the cloud."""

GROUP_RADIUS = 500
"""Outliers of a group lie within this, mm, of its first one, horizontally and in height."""

DEPTHS = (2_000, 15_000)
"""Depth below a ground point, mm, uniform."""


@dataclass(frozen=True)
class Injection:
    """One variant on one cloud with outliers of one kind.

    Attributes
    ----------
    cloud, variant : str
        Names.
    group : int
        Outliers that lie together; 1 for single ones.
    outliers, accepted : int
        Injected, and taken for ground.
    before, after : Scores
        Of the cloud's own points without and with the outliers.
    """

    cloud: str
    variant: str
    group: int
    outliers: int
    accepted: int
    before: Scores
    after: Scores

    @property
    def rise(self) -> float:
        """Rise of the total error of the cloud's own points."""
        return self.after.total - self.before.total

    @property
    def accepted_share(self) -> float:
        """Share of the outliers taken for ground."""
        return self.accepted / self.outliers if self.outliers else float("nan")


@dataclass(frozen=True)
class Injections:
    """All of them, by cloud, variant and size of group."""

    rows: tuple[Injection, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        rows = [
            {
                "cloud": r.cloud,
                "variant": r.variant,
                "group": r.group,
                "outliers": r.outliers,
                "accepted": r.accepted,
                "accepted_share": r.accepted_share,
                "rise_of_total": r.rise,
                "before": r.before.as_dict(),
                "after": r.after.as_dict(),
            }
            for r in self.rows
        ]
        return {"rows": [plain(row) for row in rows]}

    def markdown(self) -> str:
        """Return a table: percent; the rise is in percentage points."""
        rows = [
            [
                r.cloud,
                r.variant,
                "single" if r.group == 1 else f"groups of {r.group}",
                f"{r.outliers}",
                number(r.accepted_share, 1, 100),
                number(r.before.total, 2, 100),
                number(r.rise, 2, 100),
            ]
            for r in self.rows
        ]
        return markdown(["cloud", "filter", "outliers", "injected", "accepted %", "total %", "rise, points"], rows)


def inject(labelled: Labelled, group: int, *, share: float = SHARE, seed: int = 0) -> Labelled:
    """Add outliers below random ground points; they stand at the end, are never scored and count as last returns.

    Parameters
    ----------
    labelled : Labelled
        With reference ground.
    group : int
        Outliers per place; 1: single ones.
    share : float
        Outliers per usable point, default 0.0005; at least one group.
    seed : int
        Of the random places and depths.

    Returns
    -------
    Labelled

    Examples
    --------
    >>> from ppdf_dask.experiments.labelled import from_points
    >>> from ppdf_dask.synthetic import SyntheticParams, points
    >>> cloud = from_points("small", points((0, 0, 30, 30), SyntheticParams(density=2.0)))
    >>> dirty = inject(cloud, 4)
    >>> dirty.n - cloud.n, bool(dirty.scored[cloud.n :].any())
    (4, False)
    """
    ground = np.flatnonzero(labelled.reference & labelled.usable)
    if group < 1 or len(ground) == 0:
        raise ParameterError(f"group = {group} must be 1 or more, and {labelled.name} needs ground points (class 2)")
    rng = np.random.default_rng(seed)
    groups = max(1, round(share * labelled.usable.sum() / group))
    places = labelled.mm[rng.choice(ground, groups)].copy()
    places[:, 2] -= rng.integers(*DEPTHS, groups)
    spread = rng.integers(-GROUP_RADIUS, GROUP_RADIUS + 1, (groups, group, 3))
    spread[:, 0] = 0
    added = (places[:, None] + spread).reshape(-1, 3)
    more, less = np.ones(len(added), np.bool_), np.zeros(len(added), np.bool_)
    return replace(
        labelled,
        mm=np.concatenate([labelled.mm, added]),
        reference=np.concatenate([labelled.reference, less]),
        scored=np.concatenate([labelled.scored, less]),
        usable=np.concatenate([labelled.usable, more]),
        last=np.concatenate([labelled.last, more]),
    )


def injections(
    labelled: Labelled,
    variants: Sequence[Variant],
    groups: Sequence[int] = (1, 4),
    *,
    share: float = SHARE,
    seed: int = 0,
) -> Injections:
    """Run every variant on a cloud without and with outliers.

    Parameters
    ----------
    labelled : Labelled
        With ground and other points that count.
    variants : sequence of Variant
        Filters to try.
    groups : sequence of int
        Sizes of groups, default single ones and groups of four within 0.5 m.
    share, seed
        See `inject`.

    Returns
    -------
    Injections
    """
    labelled.check()
    dirty = {group: inject(labelled, group, share=share, seed=seed) for group in groups}
    rows = []
    for variant in variants:
        before = Scores.from_masks(labelled.reference, found_ground(labelled, variant.params), labelled.scored)
        for group, cloud in dirty.items():
            found = found_ground(cloud, variant.params)
            after = Scores.from_masks(cloud.reference, found, cloud.scored)
            added = cloud.n - labelled.n
            accepted = int(found[labelled.n :].sum())
            rows.append(Injection(labelled.name, variant.name, group, added, accepted, before, after))
    return Injections(tuple(rows))


def figure(found: Injections, axes: Axes | None = None) -> Axes:
    """Draw the share of outliers taken for ground, per filter and kind of outlier, all clouds pooled.

    Parameters
    ----------
    found : Injections
        At least one.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
        Beside each bar: the mean rise of the total error in percentage points.
    """
    names = list(dict.fromkeys(r.variant for r in found.rows))
    groups = list(dict.fromkeys(r.group for r in found.rows))
    axes = own_axes(axes, 7.2, 1.4 + 0.3 * len(names) * len(groups))
    height = 0.8 / len(groups)
    for g, group in enumerate(groups):
        picked = [[r for r in found.rows if (r.variant, r.group) == (name, group)] for name in names]
        shares = [100 * sum(r.accepted for r in rows) / sum(r.outliers for r in rows) for rows in picked]
        rises = [100 * float(np.mean([r.rise for r in rows])) for rows in picked]
        at = np.arange(len(names)) + (g - (len(groups) - 1) / 2) * height
        text = "single outliers" if group == 1 else f"groups of {group}"
        bars = axes.barh(at, shares, height * 0.92, color=COLOURS[g], label=text)
        axes.bar_label(bars, [f"{s:.0f} %, total {r:+.2f}" for s, r in zip(shares, rises, strict=True)], padding=3,
                       fontsize=8)  # fmt: skip
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, 125)
    axes.set_xticks(range(0, 101, 20))
    axes.set_xlabel("outliers taken for ground, %  (total: change of the total error, percentage points)")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(groups), frameon=False)
    return tidy(axes)
