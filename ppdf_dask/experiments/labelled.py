"""A cloud in memory with its reference labels, and what a filter makes of it: the base of the studies."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask import filters
from ppdf_dask.classes import GROUND, Dims, eligible
from ppdf_dask.errors import ParameterError, SurveyError
from ppdf_dask.evaluate import parse_score
from ppdf_dask.filters.cloud import Bools, Cloud, cloud_from_grid, density, to_grid
from ppdf_dask.grid import MM
from ppdf_dask.params import ClassRules, Parameters
from ppdf_dask.reader import Decoder
from ppdf_dask.synthetic import Site, points

Longs = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

SUFFIXES = (".las", ".laz")


@dataclass(frozen=True)
class Labelled:
    """All points of a cloud, in the order of the file.

    Attributes
    ----------
    name : str
        The file's name without its suffix, or the site's.
    mm : ndarray of int64, shape (n, 3)
        Absolute coordinates on the job grid.
    reference : ndarray of bool, shape (n,)
        True where the reference says ground (class 2).
    scored : ndarray of bool, shape (n,)
        Points that count.
    usable : ndarray of bool, shape (n,)
        All returns without noise, water, virtual, synthetic and withheld points (design table of `ppdf_dask.classes`).
    last : ndarray of bool, shape (n,)
        Last and only returns among them.
    """

    name: str
    mm: Longs
    reference: Bools
    scored: Bools
    usable: Bools
    last: Bools

    @property
    def n(self) -> int:
        """Number of points."""
        return len(self.mm)

    def seen(self, params: Parameters) -> Bools:
        """Return the points that a filter is offered: last returns or all, as its parameters want by default."""
        return self.last if params.RETURNS == "last" else self.usable

    def cloud(self, mask: Bools) -> Cloud:
        """Return the marked points as a fully known cloud, in the same order."""
        x, y, z = (np.ascontiguousarray(column) for column in self.mm[mask].T)
        return cloud_from_grid(x, y, z)

    def metres(self, mask: Bools) -> Floats:
        """Return the marked points as float64 metres, shape (m, 3)."""
        out: Floats = self.mm[mask] / MM
        return out

    def turned(self, degrees: float) -> Labelled:
        """Return the cloud turned about its middle, its points rounded to the job grid again.

        A filter that works on cells meets other cells: the spread of its errors over several angles is what of them is
        luck.

        Examples
        --------
        >>> made = from_points(
        ...     "two",
        ...     {
        ...         "x": np.array([0.0, 2.0]),
        ...         "y": np.array([0.0, 0.0]),
        ...         "z": np.array([5.0, 6.0]),
        ...         "return_number": np.ones(2, np.uint8),
        ...         "number_of_returns": np.ones(2, np.uint8),
        ...         "classification": np.array([2, 1], np.uint8),
        ...     },
        ... )
        >>> made.turned(90).mm.tolist()
        [[1000, -1000, 5000], [1000, 1000, 6000]]
        """
        if degrees == 0:
            return self
        middle = (self.mm[:, :2].min(axis=0) + self.mm[:, :2].max(axis=0)) // 2
        x, y = (self.mm[:, :2] - middle).astype(np.float64).T
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        xy = np.rint(np.column_stack([c * x - s * y, s * x + c * y])).astype(np.int64) + middle
        return replace(self, mm=np.column_stack([xy, self.mm[:, 2]]))

    def check(self) -> Labelled:
        """Return the cloud itself; raise SurveyError when it has no scored ground or nothing else."""
        ground = int((self.reference & self.scored).sum())
        if ground == 0 or ground == int(self.scored.sum()):
            raise SurveyError(
                f"{self.name} has {ground} ground points (class 2) among {int(self.scored.sum())} points that count; "
                "a reference needs ground and other points: check the classes and --score"
            )
        return self


def files_in(folder: str | Path) -> list[Path]:
    """Return the clouds of a data folder: those of its subfolder ``als`` if there is one, else its own, by name.

    Raises
    ------
    SurveyError
        When there are none.
    """
    root = Path(folder)
    place = root / "als" if (root / "als").is_dir() else root
    found = sorted(p for p in place.iterdir() if p.suffix.lower() in SUFFIXES) if place.is_dir() else []
    if not found:
        raise SurveyError(f"{place} holds no .las or .laz file; give the folder of the labelled clouds")
    return found


def read(path: str | Path, score: str | None = None) -> Labelled:
    """Read a classified file; class 2 is the reference ground.

    Parameters
    ----------
    path : str or Path
        LAS or LAZ.
    score : str, optional
        Which points count (see `ppdf_dask.evaluate.parse_score`); default: all that are `Labelled.usable`.

    Returns
    -------
    Labelled

    Raises
    ------
    SurveyError
        When the file cannot be read.
    ParameterError
        When the expression is not understood or names a dimension the file does not have.
    """
    import laspy
    import lazrs

    from ppdf_dask.survey import scan

    rules = parse_score(score) if score is not None else None
    survey = scan([path])
    tile = survey.tiles[0]
    try:
        las = laspy.read(path, laz_backend=laspy.LazBackend.Lazrs)
    except (laspy.LaspyException, lazrs.LazrsError, ValueError, OSError) as error:
        raise SurveyError(f"{path} cannot be read as LAS or LAZ ({error}); check or re-deliver the file") from error
    batch, last = (
        Decoder.of(tile, survey.unit_xy, survey.unit_z, ClassRules(), returns).measure(las.points.array, 0)
        for returns in ("all", "last")
    )
    scored = batch.eligible
    if rules is not None:
        scored = np.ones(batch.n, np.bool_)
        names = list(las.point_format.dimension_names)
        for rule in rules:
            if rule.dimension not in names:
                raise ParameterError(f"score: {path} has no dimension {rule.dimension!r}; it has {', '.join(names)}")
            scored &= rule(las)
    mm = np.stack([batch.x, batch.y, batch.z], axis=1)
    return Labelled(Path(path).stem, mm, batch.classification == GROUND, scored, batch.eligible, last.eligible)


def site(made: Site) -> Labelled:
    """Make a synthetic site; every usable point counts."""
    return from_points(made.name, points(made.extent, made.params))


def from_points(name: str, columns: dict[str, npt.NDArray[Any]]) -> Labelled:
    """Wrap what `ppdf_dask.synthetic.points` returns.

    Examples
    --------
    >>> from ppdf_dask.synthetic import SyntheticParams
    >>> cloud = from_points("small", points((0, 0, 20, 20), SyntheticParams(density=1.0)))
    >>> cloud.n > 300, bool(cloud.reference.any()), bool((cloud.last & ~cloud.usable).any())
    (True, True, False)
    """
    none = np.zeros(len(columns["x"]), np.bool_)
    dims = Dims(columns["return_number"], columns["number_of_returns"], columns["classification"], none, none, none)
    usable, last = (eligible(dims, ClassRules(), returns, 6) for returns in ("all", "last"))
    mm = np.stack([to_grid(columns[axis]) for axis in "xyz"], axis=1)
    return Labelled(name, mm, columns["classification"] == GROUND, usable, usable, last)


def found_ground(labelled: Labelled, params: Parameters) -> Bools:
    """Run a filter on the points it is offered by default.

    Parameters
    ----------
    labelled : Labelled
        The cloud.
    params : Parameters
        Parameter object of any filter; what follows from the density is derived from the offered points.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where ground; False where the filter was not offered the point.
    """
    seen = labelled.seen(params)
    cloud = labelled.cloud(seen)
    chosen = filters.of(params)
    ground = np.zeros(labelled.n, np.bool_)
    ground[seen] = chosen.classify(cloud, chosen.resolve(params, density(cloud))).ground
    return ground
