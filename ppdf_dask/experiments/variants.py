"""Several parameter sets on several clouds: the base of ablation, sensitivity and raised terrain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ppdf_dask.experiments.labelled import Labelled, found_ground
from ppdf_dask.experiments.tables import markdown, number, plain
from ppdf_dask.metrics import MeanStd, Scores, mean_std
from ppdf_dask.params import Parameters


@dataclass(frozen=True)
class Variant:
    """A parameter set under test.

    Attributes
    ----------
    name : str
        What is different about it.
    params : Parameters
        Of any filter.
    """

    name: str
    params: Parameters


@dataclass(frozen=True)
class Trials:
    """Scores of every variant on every cloud.

    Attributes
    ----------
    variants : tuple of Variant
        The first one is what the others are compared with.
    clouds : tuple of str
        Names.
    scores : tuple of tuple of Scores
        By cloud, then by variant.
    """

    variants: tuple[Variant, ...]
    clouds: tuple[str, ...]
    scores: tuple[tuple[Scores, ...], ...]

    def of(self, variant: int) -> list[Scores]:
        """Return one variant's scores, one per cloud."""
        return [row[variant] for row in self.scores]

    def means(self, variant: int) -> dict[str, MeanStd]:
        """Return the means and deviations over the clouds of one variant."""
        return mean_std(self.of(variant))

    def totals(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return the total errors in percent, shape (clouds, variants)."""
        return 100 * np.array([[s.total for s in row] for row in self.scores], float).reshape(len(self.clouds), -1)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            "clouds": list(self.clouds),
            "variants": [
                {
                    "name": v.name,
                    "params": v.params.as_dict(),
                    "means": plain({k: {"mean": m.mean, "std": m.std} for k, m in self.means(i).items()}),
                    "scores": [plain(s.as_dict()) for s in self.of(i)],
                }
                for i, v in enumerate(self.variants)
            ],
        }

    def markdown(self) -> str:
        """Return a table: a row per variant with the means over the clouds in percent and the total of each cloud."""
        totals = self.totals()
        rows = []
        for i, v in enumerate(self.variants):
            m = self.means(i)
            rows.append(
                [
                    v.name,
                    number(m["total"].mean, 2, 100),
                    number(m["total"].std, 2, 100),
                    number(m["type_i"].mean, 2, 100),
                    number(m["type_ii"].mean, 2, 100),
                    number(m["kappa"].mean, 1, 100),
                    *(number(t) for t in totals[:, i]),
                ]
            )
        return markdown(["variant", "mean total %", "std", "type I %", "type II %", "kappa", *self.clouds], rows)


def score(labelled: Labelled, params: Parameters) -> Scores:
    """Score one parameter set on one cloud."""
    return Scores.from_masks(labelled.reference, found_ground(labelled, params), labelled.scored)
