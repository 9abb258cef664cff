"""How much the result depends on single parameters: the paper's Figure 17."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ppdf_dask.experiments.drawing import COLOURS, GREY, MARKERS, new_figure, tidy
from ppdf_dask.experiments.tables import markdown, number
from ppdf_dask.experiments.variants import Trials, Variant
from ppdf_dask.params import Parameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Values = tuple[float, ...]

RANGES: dict[str, dict[str, Values]] = {
    "paper": {
        "plane_size": (5, 10, 15, 20, 30, 40, 50),
        "min_inliers": (5, 10, 15, 20, 30, 40, 50),
        "division_distance": (0.25, 0.5, 1, 1.5, 2, 3),
        "classification_distance": (0.5, 0.75, 1, 1.5, 2, 2.5, 3),
    },
    "robust": {
        "cell_size": (1, 1.5, 2, 2.5, 3, 4, 5),
        "inlier_share": (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        "tolerance": (0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 1.0),
    },
}
"""Values by profile and parameter: initial plane size, inliers, division distance and classification distance, and
their counterparts in the robust profile, whose plane squares are 16 cells wide and know no division distance. The
paper's own ranges are not readable; these span its defaults."""


@dataclass(frozen=True)
class Sensitivity:
    """One parameter at a time, the others at their default.

    Attributes
    ----------
    base : Parameters
        The defaults.
    values : dict of str to tuple of float
        Parameter to the values tried.
    trials : Trials
        Of `variants_of`, in its order.
    """

    base: Parameters
    values: dict[str, Values]
    trials: Trials

    def totals(self, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return the total errors in percent of one parameter's values, shape (clouds, values)."""
        start = 1
        for other, values in self.values.items():
            if other == name:
                return self.trials.totals()[:, start : start + len(values)]
            start += len(values)
        raise KeyError(name)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types: total errors in percent by parameter, cloud and value."""
        return {
            "params": self.base.as_dict(),
            "clouds": list(self.trials.clouds),
            "default": self.trials.totals()[:, 0].tolist(),
            "parameters": {
                name: {"values": list(values), "total": self.totals(name).tolist()}
                for name, values in self.values.items()
            },
        }

    def markdown(self) -> str:
        """Return a table per parameter: total errors in percent, a row per cloud and the mean."""
        parts = []
        for name, values in self.values.items():
            totals = self.totals(name)
            rows = [
                [cloud, *(number(t) for t in row)]
                for cloud, row in zip([*self.trials.clouds, "mean"], [*totals, totals.mean(axis=0)], strict=True)
            ]
            parts.append(markdown([label(self.base, name), *(f"{v:g}" for v in values)], rows))
        return "\n\n".join(parts)


def label(params: Parameters, name: str) -> str:
    """Return a parameter's name with its unit.

    Examples
    --------
    >>> from ppdf_dask.filters.ppdf.paper.params import PaperParams
    >>> label(PaperParams(), "plane_size")
    'plane_size, m'
    """
    unit = next(f for f in fields(params) if f.name == name).metadata["unit"]
    return name if unit == "1" else f"{name}, {unit}"


def variants_of(base: Parameters, values: dict[str, Values]) -> tuple[Variant, ...]:
    """Return the defaults, then one variant per parameter and value.

    Examples
    --------
    >>> from ppdf_dask.filters.ppdf.paper.params import PaperParams
    >>> [v.name for v in variants_of(PaperParams(), {"min_inliers": (5, 20)})]
    ['default', 'min_inliers = 5', 'min_inliers = 20']
    """
    changed = (
        Variant(f"{name} = {value:g}", base.replace(**{name: value}))
        for name, tried in values.items()
        for value in tried
    )
    return (Variant("default", base), *changed)


def figure(found: Sensitivity) -> Figure:
    """Draw total error against each parameter, a line per cloud (the paper's Figure 17).

    Returns
    -------
    matplotlib.figure.Figure
        One panel per parameter with a common vertical axis; a dashed line marks the default, or, where that follows
        from the density, nothing.
    """
    rows = -(-len(found.values) // 2)
    made = new_figure(9.6, 3.2 * rows)
    panels = made.subplots(rows, 2, sharey=True, squeeze=False).ravel()
    for axes, name in zip(panels, found.values, strict=False):
        panel(found, name, axes)
    for axes in panels[len(found.values) :]:
        axes.remove()
    for axes in panels[::2]:
        axes.set_ylabel("total error, %")
    made.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return made


def panel(found: Sensitivity, name: str, axes: Axes) -> Axes:
    """Draw one parameter's lines, and their mean in black."""
    values, totals = found.values[name], found.totals(name)
    default = getattr(found.base, name)
    if default is not None:
        axes.axvline(default, color=GREY, linestyle="--", linewidth=1)
    for k, (cloud, row) in enumerate(zip(found.trials.clouds, totals, strict=True)):
        axes.plot(
            values,
            row,
            color=COLOURS[k % 6],
            marker=MARKERS[k % len(MARKERS)],
            markersize=4,
            linewidth=1,
            linestyle="-" if k < 6 else ":",
            label=cloud,
        )
    if len(totals) > 1:
        axes.plot(values, totals.mean(axis=0), color="black", linewidth=2.2, label="mean")
    axes.set_xlabel(label(found.base, name))
    axes.set_ylim(bottom=0)
    return tidy(axes)
