"""Commands about seams and size: seams, and what `benchmark scale` and `benchmark proof` run."""

from __future__ import annotations

import tempfile
from contextlib import nullcontext
from pathlib import Path

import click

from ppdf_dask.cli.show import json_option, plot_option, save, show, ticking


def numbers(ctx: click.Context, param: click.Parameter, value: str) -> list[float]:
    """Return the positive numbers of a list with commas."""
    try:
        found = [float(part) for part in value.split(",")]
    except ValueError:
        raise click.BadParameter(f"{value!r} is not a list of numbers such as 10,40") from None
    if min(found) <= 0:
        raise click.BadParameter(f"{value!r} must be positive")
    return found


@click.command()
@click.option("--points", callback=numbers, default="10,40", show_default=True, help="Sizes, million points.")
@click.option("--workers", callback=numbers, default="2", show_default=True, help="Numbers of workers, such as 1,2.")
@click.option("--simulate", type=click.IntRange(1), metavar="CHUNKS", help="Plan and schedule only, with empty tasks.")
@click.option(
    "--keep", type=click.Path(file_okay=False, path_type=Path), help="Keep tiles and runs here, and use tiles found."
)
@json_option
def scale(points: list[float], workers: list[float], simulate: int | None, keep: Path | None, as_json: bool) -> None:
    """Run whole jobs on synthetic surveys beside a plain copy of the same files; start-up does not count.

    \b
    ppdf-dask benchmark scale --points 10,40,160 --keep DIR
    ppdf-dask benchmark scale --points 40 --workers 1,2 --json
    ppdf-dask benchmark scale --simulate 20000
    """
    from ppdf_dask.params import RunParams

    with tempfile.TemporaryDirectory() if keep is None else nullcontext(str(keep)) as folder:
        if simulate is not None:
            from ppdf_dask.experiments.simulate import simulate as pretend

            show(pretend(simulate, Path(folder), int(workers[0])), as_json=as_json)
            return
        from ppdf_dask.experiments.scale import study

        with ticking(len(points) * len(workers), "scale") as tick:
            sizes = [p * 1e6 for p in points]
            found = study(sizes, [int(w) for w in workers], Path(folder), RunParams(), tick)
        show(found, as_json=as_json)


@click.command()
@click.argument("tiles", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path), metavar="TILES...")
@click.option(
    "--chunk-size",
    "sizes",
    multiple=True,
    type=click.FloatRange(min=5),
    default=(150.0,),
    show_default=True,
    help="Edge of the chunks, m, beside the planner's choice; may be repeated.",
)
@click.option("--profile", type=click.Choice(["robust", "paper"]), default="robust", show_default=True)
@click.option("--repeat", type=click.IntRange(1), default=5, show_default=True, help="Rounds with and without the bit.")
@json_option
def proof(tiles: tuple[Path, ...], sizes: tuple[float, ...], profile: str, repeat: int, as_json: bool) -> None:
    """Measure what exact seams cost: the proof bit in the filter, buffers, and clouds classified again.

    \b
    ppdf-dask benchmark proof tile.laz
    ppdf-dask benchmark proof DIR/tiles --chunk-size 150
    """
    from ppdf_dask.experiments import proof as study
    from ppdf_dask.survey import scan

    found = [Path(tile.path) for tile in scan([str(t) for t in tiles]).tiles]
    with ticking(2 + len(sizes), "proof") as tick:
        show(study.measure(found, [None, *sizes], profile, repeat, tick), as_json=as_json)


@click.command()
@click.argument("run", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="RUN")
@json_option
@plot_option
def seams(run: Path, as_json: bool, plot: Path | None) -> None:
    """Measure how far neighbouring chunks disagree where both have an answer: 0 for ppdf, by proof.

    \b
    ppdf-dask seams RUN
    ppdf-dask seams RUN --plot seams
    """
    from ppdf_dask.result import Result
    from ppdf_dask.seams import measure

    with ticking(Result(run).counts["chunks"], "seams") as tick:
        found = measure(run, tick)
    show(found, as_json=as_json)
    if plot is not None:
        save(found.figure(), plot)
