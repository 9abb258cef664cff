"""The accuracy of a filter over a folder of labelled clouds: one parameter object for all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ppdf_dask.experiments.labelled import Labelled, found_ground
from ppdf_dask.experiments.tables import markdown, number, plain
from ppdf_dask.metrics import Scores, mean_std, tin_heights, tin_rmse
from ppdf_dask.params import Parameters

NEAR = 0.3
"""A point this near to the reference ground's TIN, m, would be ground in most producers' eyes."""

THINNED = 0.5
"""Above this `r30` the reference's ground class is thinned."""


@dataclass(frozen=True)
class Accuracy:
    """One filter on one cloud.

    Attributes
    ----------
    cloud : str
        Its name.
    points, offered : int
        All points, and those that the filter was offered.
    r30 : float
        Non-ground points within 0.3 m of the TIN of the reference's ground, per ground point; see `r30_of`.
    scores : Scores
        Counts and rates of the scored points.
    rmse : float
        Height error of the TIN of the found ground at the scored ground points of the reference, m.
    """

    cloud: str
    points: int
    offered: int
    r30: float
    scores: Scores
    rmse: float

    @property
    def thinned(self) -> bool:
        """True when the reference's ground class is thinned, so that a type II error and a kappa mean nothing."""
        return self.r30 > THINNED

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types; what means nothing on a thinned reference is None."""
        hidden = {"type_ii", "kappa", "precision", "f1", "iou_ground", "iou_non_ground"} if self.thinned else set()
        rates = {k: None if k in hidden else v for k, v in self.scores.as_dict().items()}
        head = {"cloud": self.cloud, "points": self.points, "offered": self.offered, "r30": self.r30}
        out: dict[str, Any] = plain(head | {"thinned": self.thinned, **rates, "rmse": self.rmse})
        return out


@dataclass(frozen=True)
class AccuracyTable:
    """One filter on several clouds.

    Attributes
    ----------
    params : Parameters
        Of the filter, the same for all clouds.
    rows : tuple of Accuracy
        One per cloud.
    """

    params: Parameters
    rows: tuple[Accuracy, ...]

    @property
    def complete(self) -> tuple[Accuracy, ...]:
        """The clouds whose reference is complete; means are taken over these."""
        return tuple(row for row in self.rows if not row.thinned)

    def means(self) -> dict[str, float]:
        """Return the means over the complete clouds, each with the same weight; NaN when there are none."""
        rates = mean_std([row.scores for row in self.complete])
        errors = [row.rmse for row in self.complete if math.isfinite(row.rmse)]
        return {name: rate.mean for name, rate in rates.items()} | {
            "rmse": float(np.mean(errors)) if errors else math.nan
        }

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types: the parameters, a record per cloud, the means over the complete ones."""
        return {
            "params": self.params.as_dict(),
            "clouds": [row.as_dict() for row in self.rows],
            "complete": [row.cloud for row in self.complete],
            "means": plain(self.means()),
        }

    def markdown(self) -> str:
        """Return the table: percent, RMSE in metres; complete clouds, their mean, then the thinned ones."""
        head = ["cloud", "points", "r30", "total %", "type I %", "type II %", "kappa", "RMSE m"]
        means = self.means()
        rates = [number(means[k], 2 if k != "kappa" else 1, 100) for k in ("total", "type_i", "type_ii", "kappa")]
        mean = [f"mean of {len(self.complete)} complete", "", "", *rates, number(means["rmse"], 3)]
        thinned = [_cells(row) for row in self.rows if row.thinned]
        return markdown(head, [*map(_cells, self.complete), mean, *thinned])


def _cells(row: Accuracy) -> list[str]:
    s = row.scores
    two = ["thinned", ""] if row.thinned else [number(s.type_ii, 2, 100), number(s.kappa, 1, 100)]
    return [
        row.cloud,
        f"{row.points:,}",
        number(row.r30),
        number(s.total, 2, 100),
        number(s.type_i, 2, 100),
        *two,
        number(row.rmse, 3),
    ]


def r30_of(labelled: Labelled) -> float:
    """Return the non-ground points within 0.3 m of the TIN of the reference's ground, per ground point.

    Parameters
    ----------
    labelled : Labelled
        All usable points count, whether they are scored or not: a score expression often leaves out just these points.

    Returns
    -------
    float
        Near 0 when the reference is complete; above 0.5 its ground class is thinned: much of the ground is labelled
        otherwise. NaN without reference ground.
    """
    ground = labelled.metres(labelled.usable & labelled.reference)
    other = labelled.metres(labelled.usable & ~labelled.reference)
    if len(ground) == 0:
        return math.nan
    if len(other) == 0:
        return 0.0
    near = np.abs(tin_heights(ground, other[:, :2]) - other[:, 2]) < NEAR
    return float(np.count_nonzero(near)) / len(ground)


def measure(labelled: Labelled, params: Parameters) -> Accuracy:
    """Run a filter on a cloud and score it.

    Parameters
    ----------
    labelled : Labelled
        With ground and other points that count.
    params : Parameters
        Parameter object of any filter.

    Returns
    -------
    Accuracy

    Raises
    ------
    SurveyError
        When the reference has no scored ground, or nothing else.
    """
    labelled.check()
    found = found_ground(labelled, params)
    rmse = tin_rmse(labelled.metres(found), labelled.metres(labelled.reference & labelled.scored))
    return Accuracy(
        labelled.name,
        labelled.n,
        int(labelled.seen(params).sum()),
        r30_of(labelled),
        Scores.from_masks(labelled.reference, found, labelled.scored),
        rmse,
    )


def table(clouds: Sequence[Labelled], params: Parameters) -> AccuracyTable:
    """Measure one filter on several clouds.

    Examples
    --------
    >>> from ppdf_dask import filters
    >>> from ppdf_dask.experiments.labelled import from_points
    >>> from ppdf_dask.synthetic import SyntheticParams, points
    >>> cloud = from_points("small", points((0, 0, 40, 40), SyntheticParams(density=2.0)))
    >>> found = table([cloud], filters.parameters("ppdf"))
    >>> found.rows[0].cloud, found.rows[0].thinned, found.means()["total"] == found.rows[0].scores.total
    ('small', False, True)
    """
    return AccuracyTable(params, tuple(measure(cloud, params) for cloud in clouds))
