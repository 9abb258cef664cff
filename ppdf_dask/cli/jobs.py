"""The main job's commands: demo, scan, plan, run, classify."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ppdf_dask.cli.options import filter_options, run_options, run_params, survey_options, tiles_argument

if TYPE_CHECKING:
    from distributed import Client

    from ppdf_dask.plan import Plan
    from ppdf_dask.result import Result
    from ppdf_dask.survey import Survey

json_option = click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")

cluster_options = [
    click.option("--workers", type=click.IntRange(1), metavar="N", help="Local worker processes [default: all CPUs]."),
    click.option("--scheduler", metavar="ADDRESS", help="Use this Dask scheduler instead of a local cluster."),
    click.option("--insecure", is_flag=True, help="Allow an unencrypted scheduler on another machine."),
    click.option("--quiet", is_flag=True, help="No progress."),
    click.option("--json-log", type=click.Path(dir_okay=False, path_type=Path), help="Append events as JSON lines."),
]


def _cluster(function: Any) -> Any:
    for option in reversed(cluster_options):
        function = option(function)
    return function


@click.command()
@tiles_argument
@survey_options
@json_option
def scan(tiles: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """Say what is there, from headers alone: tiles, CRS, units, density, overlaps, problems.

    \b
    ppdf-dask scan tiles/
    ppdf-dask scan 'north/*.laz' south/ --json
    """
    survey = _scan(tiles, options)
    click.echo(json.dumps(survey.as_dict(), indent=1) if as_json else repr(survey))


@click.command()
@tiles_argument
@survey_options
@filter_options
@run_options
@json_option
def plan(tiles: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """Say what a run will take: chunks, points, memory, disk. Touches no points.

    \b
    ppdf-dask plan tiles/
    ppdf-dask plan tiles/ --chunk-size 500
    """
    from ppdf_dask.plan import plan as make_plan

    params = run_params(options)
    made = make_plan(_scan(tiles, options), params)
    click.echo(json.dumps(made.facts(), indent=1) if as_json else repr(made))
    made.check()


@click.command()
@tiles_argument
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder of the run.")
@survey_options
@filter_options
@run_options
@_cluster
@click.option("--overwrite", is_flag=True, help="Start anew where a run exists.")
@click.option("--accept-changes", is_flag=True, help="Go on with changed inputs or parameters; redo what they touch.")
@click.option("--force-unlock", is_flag=True, help="Take the folder's lock from a run that is surely gone.")
@click.option("--drop-intermediate", is_flag=True, help="Remove the intermediate points once all is done.")
def run(
    tiles: tuple[str, ...],
    out: Path,
    overwrite: bool,
    accept_changes: bool,
    force_unlock: bool,
    drop_intermediate: bool,
    **options: Any,
) -> None:
    """Classify a survey: tiles in, classified tiles and a terrain model out. Run it again to resume.

    \b
    ppdf-dask run tiles/ --out RUN
    ppdf-dask run tiles/ --out RUN --workers 8 --resolution 0.5
    ppdf-dask run tiles/ --out RUN --scheduler tls://10.0.0.1:8786
    """
    from ppdf_dask.plan import plan as make_plan

    cluster = {k: options.pop(k) for k in ("workers", "scheduler", "insecure", "quiet", "json_log")}
    params = run_params(options)
    memory = _memory(cluster)
    made = make_plan(_scan(tiles, options, quiet=cluster["quiet"]), params, out=out, memory=memory)
    made.check()
    if not cluster["quiet"]:
        click.echo(repr(made), err=True)
    result = _run(made, cluster, overwrite=overwrite, accept_changes=accept_changes, force_unlock=force_unlock)
    if drop_intermediate:
        result.drop_intermediate()
    if not cluster["quiet"]:
        click.echo(repr(result))


@click.command()
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("demo"),
    show_default=True,
    help="Folder for the survey and the run.",
)
@_cluster
def demo(out: Path, **cluster: Any) -> None:
    """Make a small synthetic survey with known ground, run everything, print the errors.

    \b
    ppdf-dask demo
    """
    from rich.console import Console

    from ppdf_dask.demo import evaluate_demo, make_demo
    from ppdf_dask.plan import plan as make_plan
    from ppdf_dask.survey import scan as scan_tiles

    console = Console(stderr=True, quiet=cluster["quiet"])
    with console.status("making the synthetic survey"):
        tiles = make_demo(out)
    survey = scan_tiles([tiles])
    if not cluster["quiet"]:
        click.echo(repr(survey), err=True)
    result = _run(make_plan(survey, out=out / "run"), cluster, overwrite=False, accept_changes=True)
    with console.status("comparing with the known ground"):
        errors = evaluate_demo(out, result)
    click.echo(repr(result))
    click.echo(errors)


@click.command()
@click.argument("source", type=click.Path(exists=True, dir_okay=False, path_type=Path), metavar="IN")
@click.argument("target", type=click.Path(dir_okay=False, path_type=Path), metavar="OUT")
@survey_options
@filter_options
def classify(source: Path, target: Path, **options: Any) -> None:
    """Classify one tile in memory: no store, no cluster, the same result as `run` on it.

    \b
    ppdf-dask classify in.laz out.laz
    ppdf-dask classify in.laz out.laz --profile paper
    """
    from ppdf_dask.single import classify_tile

    params = run_params(options)
    counts = classify_tile(_scan((str(source),), options), target, params)
    share = counts["ground"] / max(counts["points"], 1)
    click.echo(f"{target}: {counts['points']:,} points, {counts['ground']:,} ground ({share:.1%})")


def _scan(tiles: tuple[str, ...], options: dict[str, Any], *, quiet: bool = False) -> Survey:
    from rich.console import Console

    from ppdf_dask.survey import scan as scan_tiles

    with Console(stderr=True, quiet=quiet).status("reading headers"):
        survey = scan_tiles(list(tiles), **options)
    for problem in survey.problems:
        click.echo(f"{problem.path}: {problem.message}", err=True)
    return survey


def _connect(cluster: dict[str, Any]) -> AbstractContextManager[Client]:
    from ppdf_dask import cluster as clusters

    if cluster["scheduler"]:
        return clusters.connect(cluster["scheduler"], insecure=cluster["insecure"])
    return clusters.local_cluster(cluster["workers"])


def _memory(cluster: dict[str, Any]) -> float:
    from ppdf_dask.cluster import default_workers, memory_per_worker
    from ppdf_dask.preflight import worker_memory

    if not cluster["scheduler"]:
        return memory_per_worker(cluster["workers"] or default_workers())
    with _connect(cluster) as client:
        return worker_memory(client)


def _run(made: Plan, cluster: dict[str, Any], **how: bool) -> Result:
    from rich.console import Console

    from ppdf_dask.cluster import dashboard
    from ppdf_dask.progress import listen

    console = Console(stderr=True)
    with _connect(cluster) as client, listen(console, quiet=cluster["quiet"], json_log=cluster["json_log"]) as listener:
        if not cluster["quiet"]:
            for line in dashboard(client):
                console.print(line, highlight=False, markup=False)
        return made.run(client, on_event=listener, **how)
