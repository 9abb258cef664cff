"""Runtime against density: one cloud, thinned in steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from ppdf_dask import filters
from ppdf_dask.errors import ParameterError
from ppdf_dask.experiments.clock import interleaved, timings
from ppdf_dask.experiments.drawing import COLOURS, MARKERS, own_axes, tidy
from ppdf_dask.experiments.labelled import Labelled
from ppdf_dask.experiments.tables import markdown, number
from ppdf_dask.experiments.variants import Variant
from ppdf_dask.filters.cloud import density

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HALVINGS = 7
"""Steps of the default series: all points, then half of them, and so on."""


@dataclass(frozen=True)
class Runtime:
    """One variant on one thinned cloud.

    Attributes
    ----------
    variant : str
        Name.
    points : int
        That the filter was offered.
    density : float
        Of these, per m2 of occupied 5 m cells.
    seconds : float
        Median processor time.
    """

    variant: str
    points: int
    density: float
    seconds: float

    @property
    def microseconds_per_point(self) -> float:
        """Processor time per offered point."""
        return 1e6 * self.seconds / self.points


@dataclass(frozen=True)
class Runtimes:
    """All of them, densest first, by variant."""

    cloud: str
    rows: tuple[Runtime, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            "cloud": self.cloud,
            "rows": [vars(r) | {"us_per_point": r.microseconds_per_point} for r in self.rows],
        }

    def markdown(self) -> str:
        """Return a table."""
        rows = [
            [
                r.variant,
                f"{r.points:,}",
                number(r.density),
                number(r.seconds, 3),
                number(r.microseconds_per_point, 3),
                number(1 / r.microseconds_per_point),
            ]
            for r in self.rows
        ]
        return markdown([self.cloud, "offered", "points/m2", "CPU s", "us/point", "Mpts/s"], rows)


def thinned(labelled: Labelled, halvings: int, seed: int = 0) -> Labelled:
    """Keep each point with probability 2**-halvings; a thinner cloud's points are all in the denser ones.

    Examples
    --------
    >>> all_ = np.ones(1000, bool)
    >>> cloud = Labelled("a", np.zeros((1000, 3), np.int64), all_, all_, all_, all_)
    >>> 80 < thinned(cloud, 3).n < 170
    True
    """
    keep = np.random.default_rng(seed).random(labelled.n) < 0.5**halvings
    columns = {name: getattr(labelled, name)[keep] for name in ("mm", "reference", "scored", "usable", "last")}
    return replace(labelled, **columns)


def runtimes(
    labelled: Labelled,
    variants: Sequence[Variant],
    *,
    halvings: int = HALVINGS,
    repeat: int = 3,
    tick: Callable[[str], None] = lambda name: None,
) -> Runtimes:
    """Time the variants on ever thinner versions of a cloud.

    Parameters
    ----------
    labelled : Labelled
        Any cloud; labels are not needed.
    variants : sequence of Variant
        Filters to time.
    halvings : int
        Number of densities.
    repeat : int
        Rounds per density; medians are reported.
    tick : callable
        Told the variant's name after each of ``(repeat + 1) * len(variants) * halvings`` runs.

    Returns
    -------
    Runtimes

    Raises
    ------
    ParameterError
        When the thinnest cloud has fewer than 100 points.
    """
    rows = []
    for k in range(halvings):
        part = thinned(labelled, k)
        work: dict[str, Callable[[], object]] = {}
        facts = {}
        for v in variants:
            cloud = part.cloud(part.seen(v.params))
            if cloud.n < 100:
                raise ParameterError(f"{labelled.name} has only {cloud.n} points left after {k} halvings; take fewer")
            chosen = filters.of(v.params)
            work[v.name] = partial(chosen.classify, cloud, chosen.resolve(v.params, density(cloud)))
            facts[v.name] = (cloud.n, density(cloud).per_m2)
            work[v.name]()
            tick(v.name)
        measured = []
        for step in interleaved(work, repeat):
            measured.append(step)
            tick(step[0])
        rows += [Runtime(name, *facts[name], median(t.cpu)) for name, t in timings(measured).items()]
    return Runtimes(labelled.name, tuple(sorted(rows, key=lambda r: (r.variant, -r.density))))


def figure(found: Runtimes, axes: Axes | None = None) -> Axes:
    """Draw processor time per point against density, both axes logarithmic.

    Parameters
    ----------
    found : Runtimes
        At least one row.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
    """
    axes = own_axes(axes, 6.4, 4.0)
    for k, name in enumerate(dict.fromkeys(r.variant for r in found.rows)):
        rows = [r for r in found.rows if r.variant == name]
        axes.plot(
            [r.density for r in rows],
            [r.microseconds_per_point for r in rows],
            color=COLOURS[k % 7],
            marker=MARKERS[k % len(MARKERS)],
            label=name,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    axes.set_xlabel("offered points per m²")
    axes.set_ylabel("processor time per point, µs")
    axes.grid(which="both", color="#E6E6E6", linewidth=0.6)
    axes.legend(frameon=False)
    return tidy(axes)
