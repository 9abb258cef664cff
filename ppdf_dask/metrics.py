"""Type I, II and total error, kappa, precision and the height error of the terrain model.

Pure functions over arrays and counts; `ppdf_dask.evaluate` reads files. The letters are those of the PPDF paper: `c`
and `d` count the reference's ground and non-ground points, `a` the ground points taken for non-ground and `b` the
non-ground points taken for ground. (Sithole and Vosselman 2004 use a to d for the four cells of the cross matrix.)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ppdf_dask.errors import ParameterError


@dataclass(frozen=True)
class Scores:
    """Agreement of a ground mask with a reference, from four counts.

    A rate whose denominator is empty is NaN. All rates are shares between 0 and 1 (kappa between -1 and 1).

    Parameters
    ----------
    c, d : int
        Points that are ground, and that are not, in the reference.
    a : int
        Ground points labelled non-ground (at most `c`).
    b : int
        Non-ground points labelled ground (at most `d`).

    Raises
    ------
    ParameterError
        When the counts contradict each other.

    Notes
    -----
    Type I, type II and total error, precision: PPDF paper, section 3.2. Kappa: Cohen 1960.

    Examples
    --------
    >>> scores = Scores(c=1000, d=2000, a=0, b=15)
    >>> print(f"{scores.type_ii:.2%} {scores.total:.2%} {scores.precision:.2%} {scores.kappa:.2%}")
    0.75% 0.50% 98.52% 98.88%
    """

    c: int
    d: int
    a: int
    b: int

    RATES: ClassVar[tuple[str, ...]] = (
        "type_i",
        "type_ii",
        "total",
        "kappa",
        "precision",
        "recall",
        "f1",
        "iou_ground",
        "iou_non_ground",
        "oa",
    )
    """Names of the rates, in the order of the tables."""

    def __post_init__(self) -> None:
        if not (0 <= self.a <= self.c and 0 <= self.b <= self.d):
            raise ParameterError(
                f"counts c={self.c} d={self.d} a={self.a} b={self.b} contradict each other; "
                "0 <= a <= c (ground missed of ground) and 0 <= b <= d (taken for ground of non-ground) must hold"
            )

    @classmethod
    def from_masks(cls, reference: ArrayLike, found: ArrayLike, score: ArrayLike | None = None) -> Scores:
        """Count from boolean masks.

        Parameters
        ----------
        reference, found : array_like of bool, shape (N,)
            True where the reference, and the filter, say ground.
        score : array_like of bool, shape (N,), optional
            Only these points count; all by default.

        Returns
        -------
        Scores

        Raises
        ------
        ParameterError
            When the arrays differ in length or are not boolean.

        Examples
        --------
        >>> Scores.from_masks([True, True, False, False], [True, False, True, False], [True, True, True, False])
        Scores(c=2, d=1, a=1, b=1)
        """
        ref = _mask("reference", reference)
        got = _mask("found", found)
        use = np.ones(ref.shape, bool) if score is None else _mask("score", score)
        if not ref.shape == got.shape == use.shape:
            raise ParameterError(
                f"reference, found and score have {ref.size}, {got.size} and {use.size} points; they must be the same"
            )
        return cls(
            c=int(np.count_nonzero(ref & use)),
            d=int(np.count_nonzero(~ref & use)),
            a=int(np.count_nonzero(ref & ~got & use)),
            b=int(np.count_nonzero(~ref & got & use)),
        )

    def __add__(self, other: Scores) -> Scores:
        """Pool two sites: the counts add up."""
        return Scores(self.c + other.c, self.d + other.d, self.a + other.a, self.b + other.b)

    @property
    def n(self) -> int:
        """Number of points scored."""
        return self.c + self.d

    @property
    def type_i(self) -> float:
        """Share of the reference ground labelled non-ground, a/c."""
        return _ratio(self.a, self.c)

    @property
    def type_ii(self) -> float:
        """Share of the reference non-ground labelled ground, b/d."""
        return _ratio(self.b, self.d)

    @property
    def total(self) -> float:
        """Share of all points labelled wrongly, (a+b)/(c+d)."""
        return _ratio(self.a + self.b, self.n)

    @property
    def oa(self) -> float:
        """Overall accuracy, 1 - total."""
        return _ratio(self.n - self.a - self.b, self.n)

    @property
    def precision(self) -> float:
        """Share of the points labelled ground that are, (c-a)/(c-a+b)."""
        return _ratio(self.c - self.a, self.c - self.a + self.b)

    @property
    def recall(self) -> float:
        """Share of the reference ground found, 1 - type I."""
        return _ratio(self.c - self.a, self.c)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall, 2(c-a)/(2(c-a)+a+b)."""
        hits = 2 * (self.c - self.a)
        return _ratio(hits, hits + self.a + self.b)

    @property
    def iou_ground(self) -> float:
        """Intersection over union of the ground, (c-a)/(c+b)."""
        return _ratio(self.c - self.a, self.c + self.b)

    @property
    def iou_non_ground(self) -> float:
        """Intersection over union of everything else, (d-b)/(d+a)."""
        return _ratio(self.d - self.b, self.d + self.a)

    @property
    def kappa(self) -> float:
        """Cohen's kappa: agreement beyond chance; 1 when all points are one class in both."""
        if self.n == 0:
            return math.nan
        by_chance = self.c * (self.c - self.a + self.b) + self.d * (self.d - self.b + self.a)
        room = self.n * self.n - by_chance
        if room == 0:
            return 1.0
        return (self.n * (self.n - self.a - self.b) - by_chance) / room

    def as_dict(self) -> dict[str, float]:
        """Return counts and rates by name."""
        return dataclasses.asdict(self) | {name: getattr(self, name) for name in self.RATES}


@dataclass(frozen=True)
class MeanStd:
    """Mean and sample standard deviation (ddof = 1) of a rate over `n` sites."""

    mean: float
    std: float
    n: int


def mean_std(sites: Sequence[Scores]) -> dict[str, MeanStd]:
    """Average every rate over sites, each site with the same weight.

    Parameters
    ----------
    sites : sequence of Scores
        One per site.

    Returns
    -------
    dict of str to MeanStd
        One per name in `Scores.RATES`. Sites where the rate is not defined are left out and `n` says so; the
        standard deviation of fewer than two sites is NaN.

    Examples
    --------
    >>> mean_std([Scores(10, 10, 1, 0), Scores(10, 10, 3, 0)])["type_i"]
    MeanStd(mean=0.2, std=0.1414213562373095, n=2)
    """
    table = {}
    for name in Scores.RATES:
        values = np.array([getattr(s, name) for s in sites], dtype=np.float64)
        values = values[np.isfinite(values)]
        mean = float(values.mean()) if values.size else math.nan
        std = float(values.std(ddof=1)) if values.size > 1 else math.nan
        table[name] = MeanStd(mean, std, values.size)
    return table


def pooled(sites: Iterable[Scores]) -> Scores:
    """Return the scores of all sites taken as one cloud.

    Examples
    --------
    >>> pooled([Scores(10, 10, 1, 0), Scores(30, 10, 3, 2)])
    Scores(c=40, d=20, a=4, b=2)
    """
    return sum(sites, start=Scores(0, 0, 0, 0))


def tin_rmse(ground: ArrayLike, reference: ArrayLike) -> float:
    """Return the root mean square height error of the terrain model at the reference's ground points.

    Parameters
    ----------
    ground : array_like, shape (N, 3)
        Points classified as ground, metres. Of points with the same x and y the lowest counts.
    reference : array_like, shape (M, 3)
        Ground points of the reference, metres.

    Returns
    -------
    float
        RMSE in metres of the linear TIN's height less the reference's; outside the TIN's hull the nearest
        classified point gives the height. NaN when either cloud is empty.

    Raises
    ------
    ParameterError
        When an array has not the shape (N, 3) or holds NaN or infinite values.

    Examples
    --------
    >>> plane = np.array([(0, 0, 0), (10, 0, 1), (0, 10, 0), (10, 10, 1)], float)
    >>> round(tin_rmse(plane, [(5.0, 5.0, 0.7), (20.0, 10.0, 0.8)]), 9)
    0.2
    """
    known, asked = _cloud("ground", ground), _cloud("reference", reference)
    if known.size == 0 or asked.size == 0:
        return math.nan
    error = tin_heights(known, asked[:, :2]) - asked[:, 2]
    return float(np.sqrt(np.mean(error * error)))


def tin_heights(ground: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate the TIN of `ground` (N, 3) at `xy` (M, 2), metres; the nearest point's height outside its hull.

    Of points with the same x and y the lowest counts. See `ppdf_dask._tin.interpolate` for the exact edge of the hull.
    """
    from scipy.spatial import KDTree

    from ppdf_dask._tin import interpolate

    heights = interpolate(ground, xy)
    outside = np.isnan(heights)
    if outside.any():
        order = np.lexsort((ground[:, 2], ground[:, 1], ground[:, 0]))
        points = ground[order]
        first = np.ones(len(points), bool)
        first[1:] = np.any(points[1:, :2] != points[:-1, :2], axis=1)
        points = points[first]
        origin = np.floor(points[:, :2].min(axis=0))
        heights[outside] = points[KDTree(points[:, :2] - origin).query(xy[outside] - origin)[1], 2]
    return heights


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _mask(name: str, values: ArrayLike) -> NDArray[np.bool_]:
    mask = np.asarray(values)
    if mask.ndim != 1 or (mask.dtype != np.bool_ and mask.size):
        raise ParameterError(f"{name} must be a one-dimensional boolean array, not {mask.dtype} of shape {mask.shape}")
    return mask.astype(np.bool_)


def _cloud(name: str, values: ArrayLike) -> NDArray[np.float64]:
    cloud = np.asarray(values, dtype=np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ParameterError(f"{name} must have the shape (N, 3), not {cloud.shape}")
    if not np.isfinite(cloud).all():
        raise ParameterError(f"{name} holds NaN or infinite coordinates; remove these points first")
    return cloud
