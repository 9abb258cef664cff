"""PCOM against the voxel filter of 3D Forest on terrestrial plots with known ground, in the layout of the thesis.

The thesis compares both "optimized", each with the parameters that suit the data set best. Here both are tuned alike:
the same resolutions, the same criterion (total error), on plots that are not scored afterwards.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import pcom, voxel
from ppdf_dask.filters.cloud import Bools, Cloud, cloud_from_xyz
from ppdf_dask.filters.pcom import PcomParams
from ppdf_dask.filters.voxel import VoxelParams
from ppdf_dask.metrics import Scores, mean_std, pooled
from ppdf_dask.synthetic.terrestrial import THINGS, Kind, terrestrial_things

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Plot = Callable[[Kind, int], tuple[npt.NDArray[np.float64], npt.NDArray[np.int8]]]
"""``plot(kind, seed)``: points (n, 3) in metres and what each belongs to, its number in `THINGS`; 0 is ground."""

KINDS: tuple[Kind, ...] = ("flat", "slope", "complex")
RESOLUTIONS = (0.04, 0.06, 0.1, 0.16, 0.24)
MIN_AREAS = (0.1, 0.25, 0.5, 1.0)
TOLERANCES = (1.5, 2.5, 3.5, 5.0)

COLUMNS = {"P": "precision", "T.I": "type_i", "T.II": "type_ii", "T.E.": "total", "kappa": "kappa"}
"""The columns of the thesis' Table 1 and the names of the rates."""

METHODS = {"PCOM": PcomParams, "3D Forest": VoxelParams}

COLOURS = {"PCOM": "#0072B2", "3D Forest": "#E69F00"}
"""Okabe and Ito's blue and orange: told apart with any colour vision, and in grey."""


@dataclass(frozen=True)
class Tuned:
    """One method on one kind of plot.

    Attributes
    ----------
    kind, method : str
        One of `KINDS` and one of `METHODS`.
    params : VoxelParams
        The best of the grid on the tuning plot.
    scores : Scores
        With these, all scored plots of the kind pooled.
    kept : mapping of str to (int, int)
        For each of `THINGS`: how many of its points the method takes for ground, and how many it has.
    """

    kind: Kind
    method: str
    params: VoxelParams
    scores: Scores
    kept: Mapping[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class ThesisTable:
    """The comparison in the layout of the thesis' Table 1.

    Attributes
    ----------
    rows : tuple of Tuned
        By kind, then by method.
    tuning_seed : int
        Seed of the plots that the parameters were chosen on.
    seeds : tuple of int
        Seeds of the plots that were scored.
    """

    rows: tuple[Tuned, ...]
    tuning_seed: int
    seeds: tuple[int, ...]

    def row(self, kind: Kind, method: str) -> Tuned:
        """Return one method on one kind of plot."""
        return next(r for r in self.rows if (r.kind, r.method) == (kind, method))

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of plots, in order."""
        return tuple(dict.fromkeys(r.kind for r in self.rows))

    def lines(self) -> dict[str, dict[str, dict[str, float]]]:
        """Return line, method, column: percent. The last two lines are the mean and the sample deviation over kinds."""
        table: dict[str, dict[str, dict[str, float]]] = {
            kind.capitalize(): {
                method: {c: 100 * getattr(self.row(kind, method).scores, rate) for c, rate in COLUMNS.items()}
                for method in METHODS
            }
            for kind in self.kinds
        }
        over = {method: mean_std([self.row(kind, method).scores for kind in self.kinds]) for method in METHODS}
        for line, which in (("Avg.", "mean"), ("Std.", "std")):
            table[line] = {
                method: {c: 100 * getattr(over[method][rate], which) for c, rate in COLUMNS.items()}
                for method in METHODS
            }
        return table

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types: the lines in percent, the counts, the chosen parameters, the grid and the seeds."""
        return {
            "percent": self.lines(),
            "counts": {f"{r.kind} {r.method}": {k: getattr(r.scores, k) for k in "cdab"} for r in self.rows},
            "params": {f"{r.kind} {r.method}": r.params.as_dict() for r in self.rows},
            "kept": {f"{r.kind} {r.method}": {k: list(v) for k, v in r.kept.items()} for r in self.rows},
            "grid": {
                "resolution": list(RESOLUTIONS),
                "min_area": list(MIN_AREAS),
                "tolerance": list(TOLERANCES),
            },
            "tuning_seed": self.tuning_seed,
            "seeds": list(self.seeds),
        }

    def markdown(self) -> str:
        """Return the table with its caption."""
        head = ["Data", *(f"{method} {column}" for method in METHODS for column in COLUMNS)]
        out = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
        for line, methods in self.lines().items():
            cells = [f"{methods[m][c]:.2f}" for m in METHODS for c in COLUMNS]
            out.append("| " + " | ".join([line, *cells]) + " |")
        chosen = "; ".join(f"{r.kind} {r.method}: {_described(r.params)}" for r in self.rows)
        out += [
            "",
            f"All in percent, pooled over the plots of seeds {', '.join(map(str, self.seeds))}; Avg. and Std. (n - 1) "
            f"over the lines. Parameters with the lowest total error on the plot of seed {self.tuning_seed} among "
            f"resolutions {_listed(RESOLUTIONS)} m (both), smallest areas {_listed(MIN_AREAS)} m2 and tolerances "
            f"{_listed(TOLERANCES)} voxels (PCOM). Chosen: {chosen}.",
            "",
            *self._kept(),
        ]
        return "\n".join(out)

    def _kept(self) -> list[str]:
        """Return a table of the share of each thing's points that each method takes for ground."""
        things = list(self.rows[0].kept)
        if not things:
            return []
        out = ["| Taken for ground, % | " + " | ".join(things) + " |", "|---" + "|---:" * len(things) + "|"]
        for r in self.rows:
            shares = (f"{100 * kept / n:.2f}" if n else "-" for kept, n in r.kept.values())
            out.append(f"| {r.kind.capitalize()}, {r.method} | " + " | ".join(shares) + " |")
        return out


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _described(params: VoxelParams) -> str:
    text = f"r {params.resolution:g} m"
    if isinstance(params, PcomParams):
        text += f", area {params.min_area:g} m2, tolerance {params.tolerance:g}"
    return text


def candidates(method: str) -> list[VoxelParams]:
    """Return the parameter objects of the grid search.

    Parameters
    ----------
    method : str
        One of `METHODS`.

    Returns
    -------
    list of VoxelParams
        The defaults with each combination of the grid's values.

    Examples
    --------
    >>> len(candidates("3D Forest")), len(candidates("PCOM"))
    (5, 80)
    """
    if method not in METHODS:
        raise ParameterError(f"method = {method!r} is unknown; choose one of {', '.join(METHODS)}")
    if method == "3D Forest":
        return [VoxelParams(resolution=r) for r in RESOLUTIONS]
    return [
        PcomParams(resolution=r, min_area=a, tolerance=t)
        for r, a, t in itertools.product(RESOLUTIONS, MIN_AREAS, TOLERANCES)
    ]


def classify(cloud: Cloud, params: VoxelParams) -> Bools:
    """Run PCOM or the voxel filter with these parameters as they are, whatever the density."""
    chosen = pcom if isinstance(params, PcomParams) else voxel
    ground: Bools = chosen.classify(cloud, params).ground
    return ground


def thesis_table(
    seeds: Sequence[int] = (1, 2, 3), *, tuning_seed: int = 0, plot: Plot = terrestrial_things
) -> ThesisTable:
    """Compare PCOM with 3D Forest's voxel filter on plots with known ground.

    Parameters
    ----------
    seeds : sequence of int
        Plots to score, pooled per kind.
    tuning_seed : int
        Plot to choose the parameters on; not one of `seeds`, so that no method is scored on what it was tuned on.
    plot : callable
        ``plot(kind, seed)``: points (n, 3) and what they belong to, for each kind in `KINDS`; default: the synthetic
        plots.

    Returns
    -------
    ThesisTable
        A row per kind and method.

    Raises
    ------
    ParameterError
        When `seeds` is empty or holds `tuning_seed`.

    Notes
    -----
    Source of the layout: J. Li's thesis (see `ppdf_dask.filters.pcom`), Table 1. Its own numbers are no reference: in
    all ten rows they fit a comparison of the sizes of the two ground clouds, not of their points.
    """
    if not seeds or tuning_seed in seeds:
        raise ParameterError(
            f"seeds = {list(seeds)} must name at least one plot and leave out the tuning plot, {tuning_seed}"
        )
    rows = []
    for kind in KINDS:
        xyz, thing = plot(kind, tuning_seed)
        tuning = cloud_from_xyz(xyz)
        best = {m: _best(tuning, thing == 0, candidates(m)) for m in METHODS}
        scores: dict[str, list[Scores]] = {m: [] for m in METHODS}
        kept = {m: np.zeros((len(THINGS), 2), np.int64) for m in METHODS}
        for seed in seeds:
            xyz, thing = plot(kind, seed)
            cloud = cloud_from_xyz(xyz)
            for m in METHODS:
                found = classify(cloud, best[m])
                scores[m].append(Scores.from_masks(thing == 0, found))
                for column, mask in enumerate((found, np.ones_like(found))):
                    kept[m][:, column] += np.bincount(thing[mask], minlength=len(THINGS))
        rows += [Tuned(kind, m, best[m], pooled(scores[m]), _by_thing(kept[m])) for m in METHODS]
    return ThesisTable(tuple(rows), tuning_seed, tuple(seeds))


def _by_thing(counts: npt.NDArray[np.int64]) -> dict[str, tuple[int, int]]:
    return {name: (int(kept), int(n)) for name, (kept, n) in zip(THINGS, counts, strict=True)}


def _best(cloud: Cloud, truth: Bools, choice: list[VoxelParams]) -> VoxelParams:
    """Return the first of those with the lowest total error."""
    return min(choice, key=lambda params: Scores.from_masks(truth, classify(cloud, params)).total)


def total_error_figure(table: ThesisTable, axes: Axes | None = None) -> Axes:
    """Draw the total errors as grouped bars (the thesis' Figure 3).

    Parameters
    ----------
    table : ThesisTable
        What `thesis_table` returned.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
        ``axes.figure.savefig(...)`` saves it.
    """
    axes = _axes(axes, (6.4, 4.0))
    lines = table.lines()
    names = [name for name in lines if name != "Std."]
    width = 0.8 / len(METHODS)
    for k, method in enumerate(METHODS):
        heights = [lines[name][method]["T.E."] for name in names]
        at = np.arange(len(names)) + (k - (len(METHODS) - 1) / 2) * width
        bars = axes.bar(at, heights, width * 0.95, label=method, color=COLOURS[method])
        axes.bar_label(bars, fmt="%.2f", padding=2, fontsize=8)
    axes.set_xticks(range(len(names)), names)
    axes.set_ylabel("total error, %")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(METHODS), frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def removed_figure(
    xyz: npt.NDArray[np.float64],
    truth: Bools,
    voxel_params: VoxelParams,
    pcom_params: VoxelParams,
    axes: Axes | None = None,
) -> Axes:
    """Draw from above what PCOM removes that the plain voxel filter keeps.

    Parameters
    ----------
    xyz : ndarray, shape (n, 3)
        A plot's points, metres.
    truth : ndarray of bool, shape (n,)
        Which of them are ground.
    voxel_params, pcom_params : VoxelParams
        Parameters of the two filters; the latter's a `PcomParams`.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
        Grey: kept by both. Blue: removed by PCOM, and not ground. Orange: removed by PCOM, though ground. Black: not
        ground, kept by both.
    """
    axes = _axes(axes, (6.4, 6.4))
    cloud = cloud_from_xyz(xyz)
    plain, clustered = classify(cloud, voxel_params), classify(cloud, pcom_params)
    groups = (
        ("ground kept by both", plain & clustered & truth, "#C8C8C8", 0.3),
        ("not ground, kept by both", plain & clustered & ~truth, "#000000", 1.0),
        ("ground, removed by PCOM", plain & ~clustered & truth, "#E69F00", 1.0),
        ("not ground, removed by PCOM", plain & ~clustered & ~truth, "#0072B2", 1.0),
    )
    for label, mask, colour, size in groups:
        axes.scatter(
            xyz[mask, 0], xyz[mask, 1], s=size, c=colour, linewidths=0, label=f"{label}: {mask.sum()}", rasterized=True
        )
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, frameon=False, markerscale=6, fontsize=8)
    return axes


def _axes(axes: Axes | None, size: tuple[float, float]) -> Axes:
    if axes is not None:
        return axes
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained").add_subplot()
