"""Commands that study: evaluate, and the experiments of the PPDF paper on any labelled cloud."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ppdf_dask.cli.show import clouds_argument, json_option, plot_option, save, score_option, show, sources, ticking

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ppdf_dask.experiments.labelled import Labelled
    from ppdf_dask.experiments.variants import Trials, Variant

profile_option = click.option(
    "--profile",
    type=click.Choice(["robust", "paper"]),
    default="paper",
    show_default=True,
    help="Which of PPDF's profiles.",
)


@click.command()
@click.argument("reference", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("classified", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@score_option
@json_option
def evaluate(reference: Path, classified: Path, score: str | None, as_json: bool) -> None:
    """Compare a classified tile with its reference, point by point.

    \b
    ppdf-dask evaluate reference.laz classified.laz
    ppdf-dask evaluate reference.laz classified.laz --score "user_data==0" --json
    """
    from ppdf_dask.evaluate import evaluate as compare

    found = compare(reference, classified, score)
    if as_json:
        click.echo(json.dumps(found.as_dict(), indent=1))
        return
    s = found.scores
    click.echo(f"{found.scored:,} points scored, {found.left_out:,} left out")
    click.echo(f"total error {s.total:.2%}   type I {s.type_i:.2%}   type II {s.type_ii:.2%}   kappa {s.kappa:.1%}")
    click.echo(f"precision {s.precision:.2%}   recall {s.recall:.2%}   F1 {s.f1:.2%}")
    click.echo(f"height error of the ground TIN {found.dtm_rmse:.3f} (RMSE, units of the file)")


@click.command()
@clouds_argument
@profile_option
@json_option
@plot_option
def ablation(profile: str, as_json: bool, plot: Path | None, **given: Any) -> None:
    """Leave out parts of PPDF and score the rest, on labelled clouds or on six synthetic sites.

    paper: both contributions, only the plane seeds, only the quadrants (the paper's Figure 16). robust: the default,
    each of its steps left out, single rules switched off.

    \b
    ppdf-dask ablation --plot figure16
    ppdf-dask ablation DATA --score "user_data==0" --profile robust --json
    """
    from ppdf_dask.experiments import ablation as study

    variants = study.paper_variants() if profile == "paper" else study.robust_variants()
    found = _trials(sources(**given), variants)
    if plot is not None:
        _save(study.paper_figure(found) if profile == "paper" else study.robust_figure(found), plot)
    show(found, as_json=as_json)


@click.command()
@clouds_argument
@profile_option
@json_option
@plot_option
def sensitivity(profile: str, as_json: bool, plot: Path | None, **given: Any) -> None:
    """Change one parameter at a time (the paper's Figure 17), on labelled clouds or on six synthetic sites.

    \b
    ppdf-dask sensitivity --plot figure17
    ppdf-dask sensitivity tile.laz --profile robust --json
    """
    from ppdf_dask import filters
    from ppdf_dask.experiments import sensitivity as study

    base, values = filters.parameters("ppdf", profile), study.RANGES[profile]
    found = study.Sensitivity(base, values, _trials(sources(**given), study.variants_of(base, values)))
    if plot is not None:
        save(study.figure(found), plot)
    show(found, as_json=as_json)


@click.command()
@clouds_argument
@json_option
@plot_option
def stages(as_json: bool, plot: Path | None, **given: Any) -> None:
    """Show what each step of the published method finds (the paper's Figures 6, 7, 9 and 10).

    Points under the canopy; planes coloured by size; seeds against local minima; points found only thanks to
    quadrants. Labels are used where there are any. One figure per cloud, NAME-CLOUD.

    \b
    ppdf-dask stages tile.laz --plot stages
    """
    from ppdf_dask.experiments import stages as study

    made = []
    with ticking(len(loaders := sources(**given)), "stages") as tick:
        for load in loaders:
            found = study.study(load())
            if plot is not None:
                save(study.figure(found), plot.with_name(f"{plot.stem}-{found.name}"))
            made.append((found.as_dict(), found.markdown()))
            tick(found.name)
    click.echo(json.dumps([m[0] for m in made], indent=1) if as_json else "\n\n".join(m[1] for m in made))


@click.command()
@clouds_argument
@click.option("--filter", "names", multiple=True, metavar="NAME[:PROFILE]", help="Filters to add; may be repeated.")
@click.option("--share", type=click.FloatRange(0, 0.1), default=0.0005, show_default=True, help="Outliers per point.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of their places and depths.")
@json_option
@plot_option
def outliers(names: tuple[str, ...], share: float, seed: int, as_json: bool, plot: Path | None, **given: Any) -> None:
    """Inject outliers 2 to 15 m below ground, single and in groups of four, and see what they do.

    \b
    ppdf-dask outliers --plot outliers
    ppdf-dask outliers DATA --score "user_data==0" --filter smrf --json
    """
    from ppdf_dask.experiments import outliers as study

    found = _each(sources(**given), lambda cloud, variant: study.injections(cloud, [variant], share=share, seed=seed),
                  _ppdf_and(names), "outliers")  # fmt: skip
    table = study.Injections(tuple(row for part in found for row in part.rows))
    if plot is not None:
        _save(study.figure(table), plot)
    show(table, as_json=as_json)


@click.command()
@clouds_argument
@click.option("--filter", "names", multiple=True, metavar="NAME[:PROFILE]", help="Filters to add; may be repeated.")
@json_option
@plot_option
def raised(names: tuple[str, ...], as_json: bool, plot: Path | None, **given: Any) -> None:
    """Score the ground on ridges, hilltops and crests apart from the rest.

    A ground point is on raised terrain when it lies more than 1 m above the mean of the reference's TIN 10 m around it.

    \b
    ppdf-dask raised --plot raised
    ppdf-dask raised DATA --score "user_data==0" --filter smrf --json
    """
    from ppdf_dask.experiments import ablation
    from ppdf_dask.experiments import raised as study

    extra = ablation.paper_variants()[1:]
    found = _each(sources(**given), lambda cloud, variant: study.raised_table(cloud, [variant]),
                  [*_ppdf_and(names), *extra], "raised terrain")  # fmt: skip
    table = study.RaisedTable(tuple(row for part in found for row in part.rows))
    if plot is not None:
        _save(study.figure(table), plot)
    show(table, as_json=as_json)


def _ppdf_and(names: Sequence[str]) -> list[Variant]:
    """Return both profiles of PPDF and the filters that were asked for."""
    from ppdf_dask.experiments.speed import Choice
    from ppdf_dask.experiments.variants import Variant

    choices = [choice for name in ("ppdf:robust", "ppdf:paper", *names) for choice in Choice.of(name)]
    return [Variant(choice.name, choice.params) for choice in choices]


def _each(
    loaders: Sequence[Callable[[], Labelled]],
    measure: Callable[[Labelled, Variant], Any],
    variants: Sequence[Variant],
    title: str,
) -> list[Any]:
    """Measure every variant on every cloud, one cloud in memory at a time."""
    found = []
    with ticking(len(loaders) * len(variants), title) as tick:
        for load in loaders:
            cloud = load()
            for variant in variants:
                found.append(measure(cloud, variant))
                tick(f"{cloud.name}, {variant.name}")
    return found


def _trials(loaders: Sequence[Callable[[], Labelled]], variants: Sequence[Variant]) -> Trials:
    from ppdf_dask.experiments.variants import Trials, score

    rows, names = [], []
    with ticking(len(loaders) * len(variants), "score") as tick:
        for load in loaders:
            cloud = load().check()
            names.append(cloud.name)
            scores = []
            for variant in variants:
                scores.append(score(cloud, variant.params))
                tick(f"{cloud.name}, {variant.name}")
            rows.append(tuple(scores))
    return Trials(tuple(variants), tuple(names), tuple(rows))


def _save(axes: Axes, plot: Path) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    save(figure, plot)
