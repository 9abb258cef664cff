"""Commands that measure the product itself: how right, how fast."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ppdf_dask.cli.scale import proof, scale
from ppdf_dask.cli.show import (
    chosen,
    chosen_filter,
    json_option,
    plot_option,
    save,
    score_option,
    show,
    ticking,
    tracked,
)


@click.group()
def benchmark() -> None:
    """Measure accuracy on labelled clouds, speed, and runtime against density.

    \b
    ppdf-dask benchmark accuracy DATA --score "user_data==0"
    ppdf-dask benchmark speed cloud.laz
    """


@benchmark.command()
@click.argument("data", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="DATA_DIR")
@score_option
@click.option(
    "--turn",
    type=float,
    default=0.0,
    metavar="DEGREES",
    help="Turn the clouds about their middle first, which moves every cell: how much of a figure is luck.",
)
@chosen_filter
@json_option
def accuracy(data: Path, score: str | None, turn: float, as_json: bool, **options: Any) -> None:
    """Score one filter, with one set of parameters, on every labelled cloud of a folder.

    Class 2 is the reference ground. DATA_DIR's subfolder als is taken if there is one. Where the reference's ground is
    thinned (r30 above 0.5: seen from the data), type II and kappa mean nothing and the cloud is not in the means.

    \b
    ppdf-dask benchmark accuracy DATA --score "user_data==0"
    ppdf-dask benchmark accuracy DATA --score "user_data==0" --profile paper --json
    ppdf-dask benchmark accuracy DATA --filter smrf --set threshold=0.3
    ppdf-dask benchmark accuracy DATA --score "user_data==0" --turn 31
    """
    from ppdf_dask.experiments.accuracy import AccuracyTable, measure
    from ppdf_dask.experiments.labelled import files_in, read

    params = chosen(**options)
    rows = [measure(read(path, score).turned(turn), params) for path in tracked(files_in(data), "clouds")]
    show(AccuracyTable(params, tuple(rows)), as_json=as_json)


@benchmark.command()
@click.argument("files", nargs=-1, type=click.Path(exists=True, dir_okay=False, path_type=Path), metavar="[FILES]...")
@click.option(
    "--filter",
    "names",
    multiple=True,
    default=("ppdf:robust", "ppdf:paper"),
    show_default=True,
    metavar="NAME[:PROFILE]",
    help="What to measure; may be repeated; all: every registered filter's default profile.",
)
@click.option("--repeat", type=click.IntRange(1), default=3, show_default=True, help="Rounds; medians are reported.")
@click.option("--memory/--no-memory", default=True, show_default=True, help="Measure memory too.")
@click.option("--compilation", is_flag=True, help="Measure compilation too, with a cold and a warm cache.")
@json_option
def speed(
    files: tuple[Path, ...], names: tuple[str, ...], repeat: int, memory: bool, compilation: bool, as_json: bool
) -> None:
    """Time decoding, copying, the filters alone and the whole of classify, in processor seconds of one core.

    Rounds are interleaved, so that ratios hold even on a busy machine. Without FILES: two synthetic tiles.

    \b
    ppdf-dask benchmark speed tile.laz
    ppdf-dask benchmark speed dense.laz sparse.laz --filter all --json
    """
    import tempfile

    from ppdf_dask.experiments import speed as study

    choices = [choice for name in names for choice in study.Choice.of(name)]
    with tempfile.TemporaryDirectory() as folder:
        paths = list(files) or study.synthetic_files(Path(folder))
        steps = 1 + (2 + 2 * len(choices)) * repeat + len(choices)
        with ticking(steps * len(paths), "measure") as tick:
            found = tuple(study.measure(path, choices, repeat=repeat, memory=memory, tick=tick) for path in paths)
    compiled = {c.name: study.compilation(c) for c in tracked(choices, "compile")} if compilation else {}
    show(study.SpeedTable(found, compiled), as_json=as_json)


benchmark.add_command(scale)
benchmark.add_command(proof)


@benchmark.command("density")
@click.argument("cloud", required=False, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--filter",
    "names",
    multiple=True,
    default=("ppdf:robust", "ppdf:paper"),
    show_default=True,
    metavar="NAME[:PROFILE]",
    help="What to time; may be repeated.",
)
@click.option(
    "--steps", type=click.IntRange(1, 20), default=7, show_default=True, help="Densities, each half the last."
)
@click.option("--repeat", type=click.IntRange(1), default=3, show_default=True, help="Rounds; medians are reported.")
@json_option
@plot_option
def runtime(
    cloud: Path | None, names: tuple[str, ...], steps: int, repeat: int, as_json: bool, plot: Path | None
) -> None:
    """Time filters on a cloud that is thinned in steps; without CLOUD the densest synthetic site.

    \b
    ppdf-dask benchmark density --plot density
    ppdf-dask benchmark density tile.laz --filter ppdf --filter smrf --json
    """
    from ppdf_dask.experiments import thinning as study
    from ppdf_dask.experiments.labelled import read, site
    from ppdf_dask.experiments.speed import Choice
    from ppdf_dask.experiments.variants import Variant
    from ppdf_dask.synthetic import six_sites

    variants = [Variant(choice.name, choice.params) for name in names for choice in Choice.of(name)]
    with ticking((repeat + 1) * len(variants) * steps, "time") as tick:
        labelled = site(six_sites()[0]) if cloud is None else read(cloud)
        found = study.runtimes(labelled, variants, halvings=steps, repeat=repeat, tick=tick)
    if plot is not None:
        made = study.figure(found).get_figure(root=True)
        assert made is not None
        save(made, plot)
    show(found, as_json=as_json)
