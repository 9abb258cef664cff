"""Compare a classified LAS or LAZ file with its reference, point by point."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppdf_dask.errors import ParameterError, SurveyError
from ppdf_dask.metrics import Scores, tin_rmse

_STEP = 1_000_000
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_COMPARISON = re.compile(
    r"\s*([A-Za-z_][A-Za-z0-9_ ]*?)\s*(==|!=|<=|>=|<|>)\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*"
)


@dataclass(frozen=True)
class Comparison:
    """One comparison of a score expression: `dimension` `sign` `number`."""

    dimension: str
    sign: str
    number: float

    def __call__(self, points: Any) -> NDArray[np.bool_]:
        """Return the mask of the points of a laspy record that fulfil the comparison."""
        return np.asarray(_OPERATORS[self.sign](np.asarray(points[self.dimension]), self.number), dtype=np.bool_)


def parse_score(expression: str) -> tuple[Comparison, ...]:
    """Parse ``dimension op number``, several joined by ``and``; nothing else is understood or executed.

    Parameters
    ----------
    expression : str
        For instance ``"user_data==0"`` or ``"user_data == 0 and number_of_returns > 1"``; operators
        ``== != < <= > >=``.

    Returns
    -------
    tuple of Comparison

    Raises
    ------
    ParameterError
        When a part is not such a comparison.

    Examples
    --------
    >>> [(c.dimension, c.sign, c.number) for c in parse_score("user_data==0 and intensity >= 1.5e2")]
    [('user_data', '==', 0.0), ('intensity', '>=', 150.0)]
    """
    comparisons = []
    for part in re.split(r"\band\b", expression):
        match = _COMPARISON.fullmatch(part)
        if match is None:
            raise ParameterError(
                f"score = {expression!r}: {part.strip()!r} is not a comparison; write a dimension, one of "
                "== != < <= > >= and a number, such as user_data==0, and join several with 'and'"
            )
        comparisons.append(Comparison(match[1], match[2], float(match[3])))
    return tuple(comparisons)


@dataclass(frozen=True)
class Evaluation:
    """What `evaluate` found.

    Parameters
    ----------
    reference, classified : str
        The two files.
    scores : Scores
        Counts and rates of the scored points.
    dtm_rmse : float
        Height error in the files' unit of the TIN of the classified ground at the scored ground points of the
        reference; NaN when one of them is empty.
    scored, left_out : int
        Points that counted, and points the score expression left out.
    """

    reference: str
    classified: str
    scores: Scores
    dtm_rmse: float
    scored: int
    left_out: int

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON types; a rate that is not defined is None."""
        rates = {k: None if math.isnan(v) else v for k, v in self.scores.as_dict().items()}
        return {
            "reference": self.reference,
            "classified": self.classified,
            "scored": self.scored,
            "left_out": self.left_out,
            **rates,
            "dtm_rmse": None if math.isnan(self.dtm_rmse) else self.dtm_rmse,
        }


def evaluate(
    reference: str | Path, classified: str | Path, score: str | None = None, *, ground_class: int = 2
) -> Evaluation:
    """Compare two files that hold the same points in the same order.

    Parameters
    ----------
    reference, classified : str or Path
        LAS or LAZ files; class 2 is ground in the reference.
    score : str, optional
        Which points count, as a comparison of the reference's dimensions (see `parse_score`); all by default.
    ground_class : int
        The class that means ground in `classified`; default 2, ASPRS ground.

    Returns
    -------
    Evaluation

    Raises
    ------
    SurveyError
        When a file cannot be read, or the two differ in number of points or coordinates.
    ParameterError
        When the expression is not understood or names a dimension the reference does not have.
    """
    rules = parse_score(score) if score is not None else ()
    with _opened(reference) as ref, _opened(classified) as got:
        _check_same_survey(reference, ref.header, classified, got.header, rules)
        tolerance = 0.5 * np.maximum(ref.header.scales, got.header.scales)
        scores, known, asked = Scores(0, 0, 0, 0), [], []
        read = 0
        for r, g in zip(_steps(reference, ref), _steps(classified, got), strict=True):
            r_xyz, g_xyz = _xyz(r), _xyz(g)
            apart = np.any(np.abs(r_xyz - g_xyz) > tolerance, axis=1)
            if apart.any():
                i = int(np.argmax(apart))
                raise SurveyError(
                    f"point {read + i} is at {_place(r_xyz[i])} in {reference} but at {_place(g_xyz[i])} in "
                    f"{classified}; compare files with the same points in the same order"
                )
            use = np.ones(len(r_xyz), bool)
            for rule in rules:
                use &= rule(r)
            is_ground = np.asarray(r.classification) == 2
            found = np.asarray(g.classification) == ground_class
            scores += Scores.from_masks(is_ground, found, use)
            known.append(g_xyz[found])
            asked.append(r_xyz[is_ground & use])
            read += len(r_xyz)
    empty = np.empty((0, 3))
    rmse = tin_rmse(np.concatenate([empty, *known]), np.concatenate([empty, *asked]))
    return Evaluation(str(reference), str(classified), scores, rmse, scores.n, read - scores.n)


def _opened(path: str | Path) -> Any:
    import laspy
    import lazrs

    if not Path(path).is_file():
        raise SurveyError(f"{path} does not exist or is not a file; check the path")
    try:
        return laspy.open(path, laz_backend=laspy.LazBackend.Lazrs)
    except (laspy.LaspyException, lazrs.LazrsError, ValueError, OSError) as error:
        raise SurveyError(f"{path} cannot be read as LAS or LAZ ({error}); check or re-deliver the file") from error


def _steps(path: str | Path, reader: Any) -> Iterator[Any]:
    import lazrs

    try:
        yield from reader.chunk_iterator(_STEP)
    except (lazrs.LazrsError, ValueError, OSError) as error:
        raise SurveyError(f"{path} breaks off or is damaged ({error}); re-deliver the file") from error


def _check_same_survey(
    reference: str | Path, ref: Any, classified: str | Path, got: Any, rules: tuple[Comparison, ...]
) -> None:
    if ref.point_count != got.point_count:
        raise SurveyError(
            f"{reference} holds {ref.point_count} points and {classified} {got.point_count}; "
            "compare files with the same points in the same order"
        )
    names = list(ref.point_format.dimension_names)
    for rule in rules:
        if rule.dimension not in names:
            raise ParameterError(f"score: {reference} has no dimension {rule.dimension!r}; it has {', '.join(names)}")


def _xyz(points: Any) -> NDArray[np.float64]:
    return np.column_stack([np.asarray(points.x), np.asarray(points.y), np.asarray(points.z)]).astype(np.float64)


def _place(xyz: NDArray[np.float64]) -> str:
    return f"({xyz[0]:.3f}, {xyz[1]:.3f}, {xyz[2]:.3f})"
