"""Parameters chosen by grid search, leave one site out: each site is scored with what suits the other sites best."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ppdf_dask import filters
from ppdf_dask.errors import ParameterError
from ppdf_dask.params import Parameters


@dataclass(frozen=True)
class Grid:
    """The values that a filter is tuned over.

    Attributes
    ----------
    filter, profile : str
        Where the other values come from.
    axes : mapping of str to tuple
        Values per parameter; every combination is tried.
    """

    filter: str
    profile: str
    axes: Mapping[str, tuple[Any, ...]]

    @property
    def name(self) -> str:
        """What the tuned row is called: ``tuned``, or ``paper-tuned`` when it starts from another profile."""
        first = next(iter(filters.get(self.filter).profiles))
        return "tuned" if self.profile == first else f"{self.profile}-tuned"

    def candidates(self) -> list[Parameters]:
        """Return the parameter objects, the last axis fastest.

        Examples
        --------
        >>> Grid("smrf", "default", {"slope": (0.15, 0.3), "threshold": (0.5,)}).candidates()[1].slope
        0.3
        """
        base = filters.parameters(self.filter, self.profile)
        names = list(self.axes)
        return [
            base.replace(**dict(zip(names, values, strict=True))) for values in itertools.product(*self.axes.values())
        ]


GRIDS = (
    Grid("ppdf", "robust", {"tolerance": (0.1, 0.2, 0.4), "largest_building": (60.0, 120.0, 250.0)}),
    Grid("ppdf", "paper", {"classification_distance": (0.5, 1.0, 1.5, 2.0), "division_distance": (0.5, 1.0, 2.0)}),
    Grid("msf", "default", {"slope": (15.0, 20.0, 30.0, 45.0), "tolerance": (0.3, 0.6), "max_height": (3.0, 6.0)}),
    Grid("pmf", "default", {"slope": (15.0, 30.0, 45.0), "initial_height": (0.3, 0.5, 1.0), "window": (17.0, 33.0)}),
    Grid("csf", "default", {"rigidness": (1, 2, 3), "threshold": (0.3, 0.5, 1.0)}),
    Grid("ptdf", "default", {"iteration_angle": (10.0, 20.0, 30.0), "iteration_distance": (0.75, 1.5, 3.0)}),
    Grid("smrf", "default", {"slope": (0.15, 0.3, 0.6, 1.0), "threshold": (0.25, 0.5, 1.0)}),
    Grid("voxel", "default", {"points_per_column": (1.0, 4.0, 16.0, 64.0)}),
    Grid("pcom", "default", {"points_per_column": (4.0, 16.0, 64.0), "tolerance": (2.5, 5.0)}),
)
"""The grids: about ten combinations a filter, its own defaults among them, on the parameters that its authors call the
important ones. CSF's are those of its paper; the cloth stays at 1 m, a finer one takes minutes per site."""


def grids(names: Sequence[str]) -> list[Grid]:
    """Return the grids of these filters, in the order of the names."""
    return [grid for name in names for grid in GRIDS if grid.filter == name]


def leave_one_out(totals: Mapping[str, Sequence[float]]) -> dict[str, int]:
    """Choose for each site the candidate with the lowest mean total error over all other sites.

    Parameters
    ----------
    totals : mapping of str to sequence of float
        Total errors of all candidates, in the same order, per site.

    Returns
    -------
    dict of str to int
        Index of the chosen candidate per site; of equally good ones the first.

    Raises
    ------
    ParameterError
        With fewer than two sites.

    Examples
    --------
    The first candidate is best on two sites, and is therefore taken where it is not:

    >>> leave_one_out({"a": [0.1, 0.2], "b": [0.1, 0.3], "c": [0.9, 0.0]})
    {'a': 1, 'b': 1, 'c': 0}
    """
    if len(totals) < 2:
        raise ParameterError("tuning leaves one site out and needs at least two; give more tiles, or no --tune")
    count = len(next(iter(totals.values())))
    return {
        site: min(range(count), key=lambda k: math.fsum(errors[k] for name, errors in totals.items() if name != site))
        for site in totals
    }
