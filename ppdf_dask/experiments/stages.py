"""The published method step by step, in pictures: the paper's Figures 6, 7, 9 and 10."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.experiments.drawing import COLOURS, GREY, new_figure, own_axes, tidy
from ppdf_dask.experiments.labelled import Floats, Labelled
from ppdf_dask.experiments.tables import markdown, number
from ppdf_dask.filters.cloud import Bools
from ppdf_dask.filters.ppdf.paper.classify import Stages as Steps
from ppdf_dask.filters.ppdf.paper.classify import stages as run
from ppdf_dask.filters.ppdf.paper.params import PaperParams

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_DRAWN = 150_000
"""More points than this are thinned before they are drawn."""


@dataclass(frozen=True)
class StageStudy:
    """What each step of the published method found on one cloud.

    Attributes
    ----------
    name : str
        Of the cloud.
    xyz : ndarray of float64, shape (n, 3)
        The points offered, metres, relative to `origin`.
    origin : tuple of float
        Of x and y, metres.
    truth : ndarray of bool, shape (n,), or None
        Reference ground; None where the cloud has none.
    both, nearest, local_minimum : Stages
        The published method; the same with the four nearest neighbours instead of quadrants; the same with the lowest
        point of each window as seeds.
    """

    name: str
    xyz: Floats
    origin: tuple[float, float]
    truth: Bools | None
    both: Steps
    nearest: Steps
    local_minimum: Steps

    @property
    def only_quadrants(self) -> Bools:
        """Points found with quadrants and not with the nearest neighbours."""
        out: Bools = self.both.ground & ~self.nearest.ground
        return out

    def groups(self) -> dict[str, Bools]:
        """Return the sets of points that the figures show, by name."""
        return {
            "under canopy": self.both.under_canopy,
            "seeds from planes": self.both.seeds,
            "seeds from local minima": self.local_minimum.seeds,
            "ground": self.both.ground,
            "found only thanks to quadrants": self.only_quadrants,
        }

    def sizes(self) -> dict[float, int]:
        """Return the number of planes by the edge of their square, m, largest first."""
        edges, counts = np.unique(self.both.planes.size, return_counts=True)
        return {float(e): int(c) for e, c in zip(edges[::-1], counts[::-1], strict=True)}

    def _row(self, mask: Bools) -> tuple[int, float]:
        right = float("nan") if self.truth is None or not mask.any() else float(self.truth[mask].mean())
        return int(mask.sum()), right

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        groups = {name: self._row(mask) for name, mask in self.groups().items()}
        return {
            "cloud": self.name,
            "points": len(self.xyz),
            "passes": self.both.passes,
            "planes_by_size_m": {f"{edge:g}": count for edge, count in self.sizes().items()},
            "groups": {
                name: {"points": n, "truly_ground": None if np.isnan(right) else right}
                for name, (n, right) in groups.items()
            },
        }

    def markdown(self) -> str:
        """Return two tables: the sets of points and how many of them are ground, and the planes by size."""
        rows = [
            [name, f"{n:,}", number(n / max(1, len(self.xyz)), 1, 100), number(right, 1, 100)]
            for name, (n, right) in ((name, self._row(mask)) for name, mask in self.groups().items())
        ]
        head = [f"{self.name}, {len(self.xyz):,} points", "points", "share %", "truly ground %"]
        sizes = [[f"{edge:g} m", f"{count:,}"] for edge, count in self.sizes().items()]
        return markdown(head, rows) + "\n\n" + markdown(["planes by edge of their square", "planes"], sizes)


def study(labelled: Labelled, params: PaperParams | None = None) -> StageStudy:
    """Run the published method and its two ablations on a cloud and keep every step.

    Parameters
    ----------
    labelled : Labelled
        Labels are used where there are any.
    params : PaperParams, optional
        Default: the published values.

    Returns
    -------
    StageStudy

    Raises
    ------
    ParameterError
        When the cloud has no point to show.
    """
    base = params or PaperParams()
    seen = labelled.seen(base)
    cloud = labelled.cloud(seen)
    if cloud.n == 0:
        raise ParameterError(f"{labelled.name} has no point that the filter would see")
    truth = labelled.reference[seen] if labelled.reference.any() else None
    made = [run(cloud, base.replace(**c)) for c in ({}, {"neighbours": "nearest"}, {"seeds": "local_minimum"})]
    x0, y0 = (o / 1000 for o in cloud.origin)
    return StageStudy(labelled.name, cloud.metres(), (x0, y0), truth, *made)


def figure(found: StageStudy) -> Figure:
    """Draw the four pictures on one page."""
    made = new_figure(11.0, 10.0)
    panels = made.subplots(2, 2)
    under_canopy(found, panels[0, 0])
    planes(found, panels[0, 1])
    seeds(found, panels[1, 0])
    only_quadrants(found, panels[1, 1])
    made.suptitle(found.name)
    return made


def under_canopy(found: StageStudy, axes: Axes | None = None) -> Axes:
    """Draw a cross-section of points under the canopy and above (Figure 6)."""
    axes = own_axes(axes, 6.4, 4.0)
    strip = _strip(found.xyz)
    under = found.both.under_canopy
    _dots(axes, found.xyz[:, [0, 2]], strip & ~under, GREY, "above", 1.5)
    _dots(axes, found.xyz[:, [0, 2]], strip & under, COLOURS[0], "under the canopy", 2.5)
    axes.set_ylabel("height, m")
    return _finish(axes, "Points under the canopy (cross-section)")


def planes(found: StageStudy, axes: Axes | None = None) -> Axes:
    """Draw the squares of the accepted planes from above, coloured by size (Figure 7)."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Patch, Rectangle

    axes = own_axes(axes, 6.4, 6.4)
    squares, handles = found.both.planes, []
    for k, (edge, count) in enumerate(found.sizes().items()):
        corners = squares.corner[squares.size == edge] - found.origin
        colour = COLOURS[k % len(COLOURS)]
        boxes = [Rectangle((float(x), float(y)), edge, edge) for x, y in corners]
        axes.add_collection(PatchCollection(boxes, facecolor=colour, edgecolor="white", linewidth=0.2))
        handles.append(Patch(color=colour, label=f"{edge:g} m: {count}"))
    axes.set_xlim(found.xyz[:, 0].min(), found.xyz[:, 0].max())
    axes.set_ylim(found.xyz[:, 1].min(), found.xyz[:, 1].max())
    axes.set_aspect("equal")
    axes.set_ylabel("y, m")
    axes.set_xlabel("x, m")
    axes.set_title("Planes by the edge of their square", fontsize=10, loc="left")
    if handles:
        axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, -0.12), ncols=2, frameon=False, fontsize=8)
    return tidy(axes)


def seeds(found: StageStudy, axes: Axes | None = None) -> Axes:
    """Draw a cross-section of the seeds from planes against those from local minima (Figure 9)."""
    axes = own_axes(axes, 6.4, 4.0)
    strip = _strip(found.xyz)
    at = found.xyz[:, [0, 2]]
    _dots(axes, at, strip, GREY, "points", 1.0)
    _dots(axes, at, strip & found.both.seeds, COLOURS[0], "seeds from planes", 3.0)
    # One window in a strip's width has a lowest point: a wider strip, or hardly any would be seen.
    _dots(axes, at, _strip(found.xyz, 5.0) & found.local_minimum.seeds, COLOURS[5], "local minima", 22.0, marker="v")
    axes.set_ylabel("height, m")
    return _finish(axes, "Seeds from planes against local minima (cross-section)")


def only_quadrants(found: StageStudy, axes: Axes | None = None) -> Axes:
    """Draw from above the points found only thanks to quadrants (Figure 10), over all ground."""
    axes = own_axes(axes, 6.4, 6.4)
    extra, at = found.only_quadrants, found.xyz[:, :2]
    _dots(axes, at, found.both.ground & ~extra, "#DDDDDD", "ground found either way", 0.5)
    if found.truth is None:
        _dots(axes, at, extra, COLOURS[0], "only thanks to quadrants", 3.0)
    else:
        _dots(axes, at, extra & ~found.truth, COLOURS[1], "only with quadrants, not ground", 3.0)
        _dots(axes, at, extra & found.truth, COLOURS[0], "only with quadrants, ground", 3.0)
    axes.set_aspect("equal")
    axes.set_ylabel("y, m")
    return _finish(axes, "Points found only thanks to quadrants")


def _strip(xyz: Floats, at_least: float = 1.0) -> Bools:
    """Return the points of a strip along x through the middle: 2 m wide, wider where 1500 points need it."""
    y = xyz[:, 1]
    middle = float(np.median(y))
    half = max(at_least, 0.5 * float(np.ptp(y)) * min(1.0, 1_500 / len(y)))
    out: Bools = np.abs(y - middle) <= half
    return out


def _dots(
    axes: Axes, at: npt.NDArray[np.float64], mask: Bools, colour: str, label: str, size: float, marker: str = "o"
) -> None:
    index = np.flatnonzero(mask)
    shown = index[:: max(1, -(-len(index) // MOST_DRAWN))]
    axes.scatter(
        at[shown, 0],
        at[shown, 1],
        s=size,
        c=colour,
        marker=marker,
        linewidths=0,
        rasterized=True,
        label=f"{label}: {len(index):,}",
    )


def _finish(axes: Axes, title: str) -> Axes:
    axes.set_xlabel("x, m")
    axes.set_title(title, fontsize=10, loc="left")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.12), frameon=False, fontsize=8, markerscale=2)
    return tidy(axes)
